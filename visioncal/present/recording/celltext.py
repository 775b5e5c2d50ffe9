"""What a recording says of an aligned cell, in Markdown."""

from collections.abc import Sequence

from visioncal.core.number_format import significant
from visioncal.present.recording.notes import (
    edge_line,
    further_lines,
    plain,
    step_lines,
    verdict_lines,
)
from visioncal.results import Alignment, Sight
from visioncal.session import View


def verdict_markdown(found: Alignment) -> str:
    """The verdict with its reasons, the transforms, and the observations that were left out."""
    verdict = found.verdict
    lines = [*verdict_lines(verdict), *step_lines(verdict.next_steps), *further_lines(verdict)]
    lines += ["", plain(found.weakest), ""]
    lines += [f"- {plain(it.frame)} is not tied. {plain(it.remedy)}" for it in found.untied]
    lines += [f"The frame of the cell is that of {plain(found.reference)}.", ""]
    lines += ["| transform | x, y, z [mm] | rotation vector [deg] | sigma |", "|---|---|---|---|"]
    lines += [
        f"| {plain(name)} {edge_line(it, oriented=it.oriented)}" for name, it in found.edges.items()
    ]
    left_out = [it for it in found.sights if not it.used]
    used = len(found.sights) - len(left_out)
    lines += ["", f"{used} of {len(found.sights)} observations used."]
    lines += [f"- View {it.view}, {plain(it.seer)}: {plain(it.reason)}" for it in left_out]
    return "\n".join(lines)


def sight_markdown(view: View, sight: Sight | None, unposed: Sequence[str]) -> str:
    """One view: who saw whom, and what became of it.

    Args:
        view: The view.
        sight: What it observed; None where it is of the lens or of a robot alone.
        unposed: The robots without a pose at its stop.
    """
    if sight is None:
        what = "for the lens alone" if view.is_of_lens else "it has a robot's pose alone"
        return f"**View {view.number}**: {what}."
    lines = [
        f"**View {sight.view}**, stop {sight.stop}: {plain(sight.seer)} saw {plain(sight.seen)}"
    ]
    off = ""
    if sight.residual_mm is not None:
        turned = "" if sight.residual_deg is None else f", {significant(sight.residual_deg)} deg"
        off = f"Off by {significant(sight.residual_mm)} mm{turned}. "
    lines.append(off + ("Used." if sight.used else f"Not used: {plain(sight.reason)}"))
    if unposed and not view.is_of_lens:
        names = ", ".join(map(plain, unposed))
        lines.append(f"The pose of {names} is not known at this stop: drawn as it was last.")
    return "\n\n".join(lines)
