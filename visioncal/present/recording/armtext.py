"""The calibrated arm, as text: its levels, its parameters, and what the stops tell of it."""

from collections.abc import Iterator
from dataclasses import dataclass

import rerun as rr

from visioncal.core.number_format import decimals_for, fixed, signed, significant
from visioncal.present.recording import paths
from visioncal.present.recording.elastic import Elastic
from visioncal.present.recording.kinematics import Kinematics, Level, Parameter, joint_words
from visioncal.present.recording.notes import plain
from visioncal.results import Calibration

_MOST_WORTH = 5
# Without a sigma: about a hundredth of what an arm repeats to.
_DECIMALS = {"mm": 3, "\N{DEGREE SIGN}": 4}


@dataclass(frozen=True)
class ParameterRow:
    """A number of the arm's model, as text; `sure` where its change is beyond chance."""

    symbol: str
    unit: str
    nominal: str
    identified: str
    change: str
    sigma: str
    sure: bool


def log_static(stream: rr.RecordingStream, calibration: Calibration) -> None:
    """Logs what is to be said of the arm, where levels of it were tried."""
    found, springs = Kinematics.of(calibration), Elastic.of(calibration)
    if found is not None:
        words = markdown(found) + ("" if springs is None else "\n".join(_springs(springs)))
        text = rr.TextDocument(words, media_type=rr.MediaType.MARKDOWN)
        stream.log(paths.ARM_NOTE, text, static=True)


def markdown(found: Kinematics) -> str:
    """Which level was taken and why, and what is known of the arm then."""
    return "\n".join(
        [
            "# The arm",
            "",
            plain(found.reason),
            "",
            *_levels(found),
            *_worth_over_workspace(found),
            *_parameters(found),
            *_told(found),
            *_stops(found),
        ]
    )


def _levels(found: Kinematics) -> Iterator[str]:
    yield "| what is free | values | fit mm | fit deg | left out mm | left out deg | ratio |"
    yield "|---|---:|---:|---:|---:|---:|---:|"
    for it in found.levels:
        yield _level(it, taken=it.name == found.level)
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


def _level(level: Level, *, taken: bool) -> str:
    words = f"**{plain(level.words)}**" if taken else plain(level.words)
    figures = (level.rms_mm, level.rms_deg, level.held_out_mm, level.held_out_deg)
    cells = [words, str(level.unknowns), *("" if it is None else f"{it:.2g}" for it in figures)]
    return f"| {' | '.join([*cells, f'{level.likelihood_ratio:.0f}'])} |"


def _springs(found: Elastic) -> Iterator[str]:
    yield from ("", "", "## Joints that bend", "")
    yield "| joint | stiffness kN m/rad | sigma | torque N m |"
    yield "|---|---:|---:|---:|"
    for it in found.springs:
        told = it.stiffness is not None and it.stiffness_sigma is not None
        stiffness = f"{1e-3 * it.stiffness:.4g}" if it.stiffness is not None else "taken for rigid"
        sigma = significant(1e-3 * it.stiffness_sigma) if told and it.stiffness_sigma else ""
        low, high = (f"{round(torque, 1) + 0.0:g}" for torque in it.torque_nm)
        yield f"| {plain(joint_words(it.joint))} | {stiffness} | {sigma} | {low} to {high} |"
    median, most = map(significant, found.sag_mm)
    yield ""
    yield f"The loads of the stops move the flange by {median} mm in the median, {most} mm at most."


def _worth_over_workspace(found: Kinematics) -> Iterator[str]:
    if found.workspace_mm is not None:
        median, p95 = found.workspace_mm
        yield ""
        yield (
            f"All over the workspace a tool's place is predicted with a sigma of {median:.2g} mm "
            f"(median; 95 % of the places: under {p95:.2g} mm)."
        )


def _parameters(found: Kinematics) -> Iterator[str]:
    if found.parameters:
        yield from ("", "## Parameters", "")
        yield "| joint | | nominal | identified | change | sigma | |"
        yield "|---|---|---:|---:|---:|---:|---|"
    for joint, rows in found.grouped().items():
        for place, it in enumerate(rows):
            name = "" if place else plain(joint_words(joint))
            yield _parameter_line(name, parameter_row(it))


def parameter_row(it: Parameter) -> ParameterRow:
    """Writes a number of the arm's model with as many digits as its change is known to."""
    decimals = decimals_for(it.sigma) if it.sigma else _DECIMALS.get(it.unit, 5)
    return ParameterRow(
        it.symbol,
        it.unit,
        # As stated, whatever is known of it now.
        f"{it.nominal + 0.0:.7g}",
        fixed(it.identified, decimals),
        signed(it.change, decimals),
        f"\N{PLUS-MINUS SIGN} {significant(it.sigma)}" if it.sigma else "",
        it.is_sure,
    )


def _parameter_line(joint: str, row: ParameterRow) -> str:
    change = f"**{row.change}**" if row.sure else row.change
    cells = (joint, plain(row.symbol), row.nominal, row.identified, change, row.sigma, row.unit)
    return f"| {' | '.join(cells)} |"


def _told(found: Kinematics) -> Iterator[str]:
    known = found.observability
    if "told" in known:
        most = int(known.get("identifiable", known["told"]))
        yield from ("", "## What the stops tell", "")
        yield f"{int(known['told'])} of {most} directions that any stops could tell."
    for it in found.not_told:
        yield f"- {plain(it)}"


def _stops(found: Kinematics) -> Iterator[str]:
    if found.worth:
        yield from ("", "## What each stop is worth", "")
        yield "By how much the mean variance over the workspace would grow without it:"
        yield ""
    for view, share in (*found.worth[:_MOST_WORTH], *found.worth[_MOST_WORTH:][-1:]):
        yield f"- view {view}: {100 * share:.2g} %"
