"""What a recording says of the calibrated arm and of an aligned cell, in Markdown."""

from collections.abc import Iterator, Sequence

import rerun as rr

from visioncal.core.number_format import significant
from visioncal.present.facts import arm_sentences, identifiability_facts, spring_facts
from visioncal.present.recording import paths
from visioncal.present.recording.notes import (
    edge_line,
    fact_lines,
    further_lines,
    plain,
    step_lines,
    verdict_lines,
)
from visioncal.present.words import (
    ParameterRow,
    by_joint,
    joint_words,
    level_words,
    parameter_row,
    spring_words,
)
from visioncal.results import Alignment, Calibration, Sight
from visioncal.results.arm import ArmLevel, ArmResult, ElasticResult
from visioncal.session import View

_MOST_INFLUENTIAL = 5


def log_static(stream: rr.RecordingStream, calibration: Calibration) -> None:
    """Logs what is to be said of the arm, where levels of it were tried."""
    found, springs = calibration.arm, calibration.elastic
    if found is not None:
        words = markdown(found) + ("" if springs is None else "\n".join(_springs(springs)))
        text = rr.TextDocument(words, media_type=rr.MediaType.MARKDOWN)
        stream.log(paths.ARM_NOTE, text, static=True)


def markdown(found: ArmResult) -> str:
    """Which level was taken and why, and what is known of the arm then."""
    return "\n".join(
        [
            "# The arm",
            "",
            *(f"{plain(it)}\n" for it in arm_sentences(found)),
            *_levels(found),
            *_parameters(found),
            *_identifiability(found),
            *_stops(found),
        ]
    )


def _levels(found: ArmResult) -> Iterator[str]:
    yield "| what is free | values | fit mm | fit deg | left out mm | left out deg | ratio |"
    yield "|---|---:|---:|---:|---:|---:|---:|"
    for it in found.levels:
        yield _level(it, taken=it.level == found.level)
    yield ""
    yield "Ratio: twice the gain in log-likelihood over the arm as stated."
    if found.left_out:
        yield ""
        yield (
            "The plots show the views that were left out in turn, and as diamonds those that the "
            "session holds back: in orange by the arm as stated, in blue by the calibrated one. "
            "The orange line in the cell is the arm as stated, its departure magnified as its "
            "entity says."
        )


def _level(level: ArmLevel, *, taken: bool) -> str:
    words = plain(level_words(level.level))
    words = f"**{words}**" if taken else words
    figures = (level.rms_mm, level.rms_deg, level.held_out_mm, level.held_out_deg)
    cells = [words, str(level.unknowns), *("" if it is None else f"{it:.2g}" for it in figures)]
    return f"| {' | '.join([*cells, f'{level.likelihood_ratio:.0f}'])} |"


def _springs(found: ElasticResult) -> Iterator[str]:
    yield from ("", "", "## Joints that bend", "")
    yield "| joint | stiffness kN m/rad | sigma | torque N m |"
    yield "|---|---:|---:|---:|"
    for it in found.joints:
        yield f"| {plain(joint_words(it.joint))} | {' | '.join(spring_words(it))} |"
    yield from ("", *fact_lines(spring_facts(found)))


def _parameters(found: ArmResult) -> Iterator[str]:
    if found.parameters:
        yield from ("", "## Parameters", "")
        yield "| joint | | nominal | identified | change | sigma | |"
        yield "|---|---|---:|---:|---:|---:|---|"
    for joint, rows in by_joint(found).items():
        for place, it in enumerate(rows):
            name = "" if place else plain(joint_words(joint))
            yield _parameter_line(name, parameter_row(it))


def _parameter_line(joint: str, row: ParameterRow) -> str:
    change = f"**{row.change}**" if row.sure else row.change
    cells = (joint, plain(row.symbol), row.nominal, row.identified, change, row.sigma, row.unit)
    return f"| {' | '.join(cells)} |"


def _identifiability(found: ArmResult) -> Iterator[str]:
    if found.observability is not None:
        yield from ("", "## What the stops determine", "")
        yield from fact_lines(identifiability_facts(found))
    for it in found.not_determined or ():
        yield f"- {plain(it)}"


def _stops(found: ArmResult) -> Iterator[str]:
    if found.stops:
        yield from ("", "## Influence of each stop", "")
        yield "By how much the mean variance over the workspace would grow without it:"
        yield ""
    for it in (*found.stops[:_MOST_INFLUENTIAL], *found.stops[_MOST_INFLUENTIAL:][-1:]):
        yield f"- view {it.view}: {100 * it.influence:.2g} %"


def verdict_markdown(found: Alignment) -> str:
    """The verdict with its reasons, the transforms, and the observations that were left out."""
    verdict = found.verdict
    lines = [*verdict_lines(verdict), *step_lines(verdict.next_steps), *further_lines(verdict)]
    lines += ["", plain(found.weakest), ""]
    lines += [f"- {plain(it.frame)} is not tied. {plain(it.remedy)}" for it in found.untied]
    lines += [f"The frame of the cell is that of {plain(found.reference)}.", ""]
    lines += ["| transform | x, y, z [mm] | rotation vector [deg] | sigma |", "|---|---|---|---|"]
    lines += [f"| {plain(name)} {edge_line(it)}" for name, it in found.edges.items()]
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
