"""Reads, corrects, writes and reports the targets of `visioncal correct`."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import typer
from rich.markup import escape

from visioncal.cli.console import answers, messages, print_json, say, warn
from visioncal.cli.correct import CorrectOptions
from visioncal.cli.parsing import numbers_in
from visioncal.core.errors import DataError
from visioncal.core.files import check_free, write_atomically
from visioncal.core.number_format import did_you_mean, figure, mm_and_deg, some_of
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.interchange.result_files import load_calibration
from visioncal.results import Calibration
from visioncal.results.compensation.correction import (
    CalibratedArm,
    Corrected,
    correct,
    predicted_sigma_mm,
)
from visioncal.results.compensation.table import (
    Targets,
    columns_to_send,
    read_targets,
    table_to_send,
)
from visioncal.robot import Loads
from visioncal.session.choosing import ARM, EYE
from visioncal.session.columns import no_celsius

_SHOWN = 10
_MOST_DEG = 720.0
# Away from singularities a millimetre turns joints by some tenths of a degree at most; beyond the
# second limit the exact value does not matter.
_SINGULAR_DEG, _MOST_TURN_DEG = 5.0, 90.0
_TOOLS = "flange_from_"


def correct_table(asked: CorrectOptions) -> None:
    """Corrects a table of targets, and writes and prints the result.

    Raises:
        DataError: Something cannot be read or written, or targets are out of reach.
    """
    needs = EYE if asked.tool is not None and asked.tool.removeprefix(_TOOLS) == "cam" else ARM
    chosen = load_calibration(asked.calibration, asked.part.choice, needs)
    known = _warm(chosen, asked.temperatures)
    arm = CalibratedArm.of(known)
    if asked.file is not None:
        check_free(asked.file, force=asked.force)
    wanted = read_targets(asked.targets, arm.real)
    flange_from_tool = _tool(known, asked.tool)
    base_from_flange = wanted.base_from_tool @ invert(flange_from_tool)
    corrected = correct(
        known,
        base_from_flange,
        _seeds(wanted.q_seed, asked.seed_joints),
        widest_rad=np.deg2rad(_widest(asked.widest_deg)),
        loads=_loads(len(base_from_flange), asked.payload_kg, asked.payload_m),
    )
    lost = tuple(_unreachable(wanted, corrected))
    rows = np.flatnonzero(corrected.reached)
    if lost and not (asked.skip and len(rows)):
        raise _refusal(lost, len(wanted))
    sigma_mm = predicted_sigma_mm(known, base_from_flange[:, :3, 3], corrected.q)
    base_from_tool = corrected.base_from_flange @ flange_from_tool
    columns = columns_to_send(wanted, corrected, base_from_tool, sigma_mm)
    warnings = [
        *_doubts(known),
        *_rigid(arm, asked.payload_kg),
        *_turns(arm, wanted, corrected, asked.widest_deg),
        *_singular(arm, wanted, corrected.q, rows),
    ]
    if asked.file is not None:
        write_atomically(asked.file, table_to_send(wanted, columns, rows))
    if asked.as_json:
        document = _document(wanted, columns, rows, lost) | {"warnings": warnings}
        print_json(document)
        return
    if asked.file is None:
        typer.echo(table_to_send(wanted, columns, rows), nl=False)
    _report(columns, rows, lost, warnings, is_answer=asked.file is not None)
    if np.isnan(wanted.q_seed).all() and asked.seed_joints is None:
        say(_posture(arm, corrected.q[rows[0]]))
    if asked.file is not None:
        say(f"wrote {asked.file}")


def _warm(calibration: Calibration, words: str | None) -> Calibration:
    """The calibration at the stated temperatures."""
    if words is None:
        return calibration
    count = calibration.drift.joint_count
    form = ",".join(f"T{index}" for index in range(1, count + 1))
    temperatures = np.array(numbers_in(words, "--temperatures", form))
    wrong = no_celsius(temperatures)
    if wrong:
        raise DataError(f"--temperatures: {wrong}.", culprits=["--temperatures"])
    return calibration.at_temperatures(temperatures)


def _widest(degrees: float) -> float:
    if not 0.0 < degrees <= _MOST_DEG:
        raise DataError(
            f"--widest-deg is {degrees:g}; degrees above 0 and up to {_MOST_DEG:g} are needed.",
            culprits=["--widest-deg"],
        )
    return degrees


def _loads(count: int, payload_kg: float, payload_m: str) -> Loads:
    centre = numbers_in(payload_m, "--payload-m", "x,y,z")
    return Loads.alike(count, payload_kg, centre, (0.0, 0.0, 0.0))


def _rigid(arm: CalibratedArm, payload_kg: float) -> Iterator[str]:
    """Warns where a payload has no effect."""
    if payload_kg and not arm.compliance.any():
        yield (
            f"--payload-kg {payload_kg:g} changes nothing: the calibration has no joints that bend "
            "(level elastic)."
        )


def _tool(calibration: Calibration, name: str | None) -> FloatArray:
    """(4, 4) `flange_from_tool` [m]; the identity where the targets are of the flange."""
    if name is None:
        return np.eye(4)
    placed = calibration.placed
    transform = name if name.startswith(_TOOLS) else f"{_TOOLS}{name}"
    if transform not in placed:
        known = [word.removeprefix(_TOOLS) for word in placed if word.startswith(_TOOLS)]
        raise DataError(
            f"--tool {name}: calibration {calibration.session_name!r} has no {transform}; on its "
            f"flange are {', '.join(known) or 'no tools'}.",
            culprits=["--tool"],
            next_step=did_you_mean(name, known) or "A tool joins it by visioncal tcp.",
        )
    return placed[transform].matrix


def _seeds(own: FloatArray, words: str | None) -> FloatArray:
    """Seeds of the rows (m, n); the first takes that of the option where it has none."""
    if words is None:
        return own
    form = ",".join(f"q{index}" for index in range(1, own.shape[1] + 1))
    seed = np.array(numbers_in(words, "--seed-joints", form))
    if np.isnan(own[0, 0]):
        own = own.copy()
        own[0] = seed
    return own


def _unreachable(targets: Targets, corrected: Corrected) -> Iterator[tuple[str, str]]:
    """Rows that cannot be reached, with the reason."""
    for row in np.flatnonzero(~corrected.reached):
        off_mm, off_deg = 1e3 * corrected.off_m[row], np.rad2deg(corrected.off_rad[row])
        near = f"the nearest posture leaves {mm_and_deg(off_mm, off_deg)}"
        beyond = corrected.beyond[row]
        why = (
            f"reached only with {some_of(beyond)} beyond its limits; within them "
            if beyond
            else "out of reach: "
        )
        yield targets.places[row], why + near


def _refusal(lost: Sequence[tuple[str, str]], count: int) -> DataError:
    lines = [f"{place}: {why}." for place, why in lost[:_SHOWN]]
    if len(lost) > _SHOWN:
        lines.append(f"And {len(lost) - _SHOWN} more of the kind.")
    return DataError(
        "\n".join([f"{len(lost)} of {count} targets cannot be reached.", *lines]),
        culprits=[place for place, _ in lost],
        next_step="Move them, or write the others with --skip-unreachable."
        if len(lost) < count
        else "Targets are base_from_flange in metres; of a tool, name it with --tool.",
    )


def _doubts(calibration: Calibration) -> Iterator[str]:
    verdict = calibration.verdict
    if verdict.status == "bad":
        yield f"The calibration's verdict is bad: {' '.join(verdict.reasons[:1])}"


def _turns(
    arm: CalibratedArm, targets: Targets, corrected: Corrected, widest_deg: float
) -> Iterator[str]:
    """Warns where joints turned far from the seed, possibly onto another branch."""
    turned = np.rad2deg(corrected.turned_rad)
    wide = np.flatnonzero(corrected.reached & (turned.max(axis=1) > widest_deg))
    for row in wide[:_SHOWN]:
        joint = int(np.argmax(turned[row]))
        yield (
            f"{targets.places[row]}: {arm.real.joint_names[joint]} turns by "
            f"{turned[row, joint]:.0f} deg from where this target was looked for; no posture "
            "nearer was found."
        )
    if len(wide) > _SHOWN:
        yield f"And {len(wide) - _SHOWN} more targets of the kind."


def _singular(arm: CalibratedArm, targets: Targets, q: FloatArray, rows: IntArray) -> Iterator[str]:
    """Warns near singularities, where a correction of a millimetre turns a joint far."""
    turns = arm.turns_deg_per_mm(q[rows])
    near = np.flatnonzero(turns.max(axis=1) > _SINGULAR_DEG)
    if not len(near):
        return
    worst = near[int(np.argmax(turns[near].max(axis=1)))]
    joint = int(np.argmax(turns[worst]))
    most = float(turns[worst, joint])
    far = f"{most:.0f}" if most < _MOST_TURN_DEG else f"over {_MOST_TURN_DEG:.0f}"
    yield (
        f"{some_of([targets.places[rows[index]] for index in near])}: nearly singular; at "
        f"{targets.places[rows[worst]]} a millimetre turns {arm.real.joint_names[joint]} by "
        f"{far} deg. Move slowly there, or keep away from it."
    )


def _posture(arm: CalibratedArm, q: FloatArray) -> str:
    """States the initial posture of targets without seeds."""
    turning = ~arm.real.chain.prismatic
    words = [
        f"{np.rad2deg(value):.0f}" if turns else f"{1e3 * value:.0f} mm"
        for value, turns in zip(q, turning, strict=True)
    ]
    return (
        f"the first is reached in the posture nearest to the middle of the joints' limits, "
        f"({', '.join(words)}) deg; --seed-joints begins in another"
    )


def _report(
    columns: Mapping[str, FloatArray],
    rows: IntArray,
    lost: Sequence[tuple[str, str]],
    warnings: Sequence[str],
    *,
    is_answer: bool,
) -> None:
    console = messages()
    mm, deg = columns["moved_mm"][rows], columns["moved_deg"][rows]
    words = (
        f"{len(rows)} of {len(rows) + len(lost)} targets corrected: moved by "
        f"{mm_and_deg(float(np.median(mm)), float(np.median(deg)))} (median), by "
        f"up to {mm_and_deg(float(mm.max()), float(deg.max()))}"
    )
    if "sigma_mm" in columns:
        words += f"; predicted sigma {figure(float(np.median(columns['sigma_mm'][rows])))} mm"
    # Where stdout has no table, this is the command's answer.
    (answers() if is_answer else console).print(escape(words))
    for place, why in lost[:_SHOWN]:
        console.print(f"[bold yellow]left out:[/] {escape(f'{place}: {why}')}")
    if len(lost) > _SHOWN:
        console.print(f"  and {len(lost) - _SHOWN} more")
    for warning in warnings:
        warn(warning)


def _document(
    targets: Targets,
    columns: Mapping[str, FloatArray],
    rows: IntArray,
    lost: Sequence[tuple[str, str]],
) -> dict[str, Any]:
    kept = [column for column in targets.table.columns if column not in columns]
    cells = [dict(zip(targets.table.columns, row, strict=True)) for row in targets.table.rows]
    return {
        "targets": [
            {
                "place": targets.places[row],
                **{name: cells[row][name] for name in kept},
                **{name: float(numbers[row]) for name, numbers in columns.items()},
            }
            for row in rows
        ],
        "unreachable": [{"place": place, "reason": why} for place, why in lost],
    }
