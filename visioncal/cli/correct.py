"""`visioncal correct`."""

from collections.abc import Iterator, Mapping, Sequence
from difflib import unified_diff
from functools import partial
from pathlib import Path

import numpy as np
import typer

from visioncal.cli.console import check_usable, print_json, say, warn
from visioncal.cli.result_options import CorrectOptions
from visioncal.core.conventions import controller_form
from visioncal.core.errors import DataError
from visioncal.core.files import check_free, read_bytes, write_atomically
from visioncal.core.number_format import did_you_mean, figure, mm_and_deg
from visioncal.core.parsing import numbers_in
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray, IntArray
from visioncal.interchange.formats import PoseImportOptions
from visioncal.interchange.formats.touches import read_typed
from visioncal.interchange.programs import Dialect, correct_program, dialect_of
from visioncal.interchange.result_files import load_calibration
from visioncal.results import Calibration
from visioncal.results.compensation.correction import (
    CalibratedArm,
    Corrected,
    correct,
    predicted_sigma_mm,
    unseen,
)
from visioncal.results.compensation.table import (
    Targets,
    columns_to_send,
    read_targets,
    table_to_send,
)
from visioncal.robot import Loads
from visioncal.session.columns import column_of
from visioncal.session.selecting import ARM, EYE

_MOST_SHOWN = 10  # Targets that are named.
_TOOLS = "flange_from_"


def correct_command(
    options: CorrectOptions, moved: tuple[FloatArray, FloatArray] | None = None
) -> None:
    """Corrects a table of targets, and writes and prints the result.

    Args:
        options: The options.
        moved: Motions (4, 4) of the targets before that, on the left and on the right; an arm that
            is not calibrated is then taken as nominal. None for no motion.

    Raises:
        DataError: Something cannot be read or written, or targets are out of reach.
        VerdictError: The calibration, or the tool, is bad.
    """
    if (dialect := dialect_of(options.targets.suffix)) is not None and moved is None:
        _correct_program(options, dialect)
    else:
        _correct_table(options, moved)


def _correct_table(options: CorrectOptions, moved: tuple[FloatArray, FloatArray] | None) -> None:
    # None where the table is printed.
    file = None if options.out == Path("-") else options.out
    needs = EYE if options.tool is not None and options.tool.removeprefix(_TOOLS) == "cam" else ARM
    loaded = load_calibration(options.calibration, options, needs)
    bad = check_usable(loaded.verdict, "the calibration", force=options.force)
    calibration, links_c = _at_temperatures(loaded, options.temperatures)
    arm = CalibratedArm.of(calibration, or_nominal=moved is not None)
    if file is not None:
        check_free(file, force=options.force)
    usual, stated = calibration.controller(), controller_form("", options.robot_form)
    form = stated or usual
    given = PoseImportOptions(form=options.robot_form, usual=None if form is None else form.name)
    typed = None if form is None else read_typed(options.targets, given)
    targets = read_targets(options.targets, arm.real, typed)
    flange_from_tool = _tool(calibration, options.tool)
    before, after = moved or (np.eye(4), np.eye(4))
    base_from_flange = before @ targets.base_from_tool @ invert(flange_from_tool) @ after
    loads = Loads.alike(
        len(base_from_flange), options.payload_kg, options.payload_m, (0.0, 0.0, 0.0)
    )
    seeds, widest_rad = _seeds(targets.q_seed, options.seed_joints), np.deg2rad(options.widest_deg)
    corrected = correct(arm, base_from_flange, seeds, widest_rad=widest_rad, loads=loads)
    unreachable = []
    for row in np.flatnonzero(~corrected.reached):
        left = mm_and_deg(1e3 * corrected.off_m[row], np.rad2deg(corrected.off_rad[row]))
        why = f"out of reach within the joints' limits: the nearest posture leaves {left}"
        unreachable.append((targets.places[row], why))
    rows = np.flatnonzero(corrected.reached)
    if unreachable and not (options.skip and len(rows)):
        count = len(targets)
        lines = [f"{place}: {why}." for place, why in unreachable[:_MOST_SHOWN]]
        if len(unreachable) > _MOST_SHOWN:
            lines.append(f"And {len(unreachable) - _MOST_SHOWN} more of the kind.")
        raise DataError(
            "\n".join([f"{len(unreachable)} of {count} targets cannot be reached.", *lines]),
            culprits=[place for place, _ in unreachable],
            next_step="Move them, or write the others with --skip-unreachable."
            if len(unreachable) < count
            else "Targets are base_from_flange in metres; of a tool, name it with --tool.",
        )
    places = base_from_flange[:, :3, 3]
    sigma_mm = predicted_sigma_mm(calibration, places, corrected.q, loads=loads, links_c=links_c)
    base_from_tool = corrected.base_from_flange @ flange_from_tool
    columns = columns_to_send(targets, corrected, base_from_tool, sigma_mm, form)
    warnings = [*bad, *_warn_turns(arm, targets, corrected, options.widest_deg)]
    warnings += unseen(calibration, corrected.q[rows], loads.chosen(rows), links_c)
    if options.payload_kg and not arm.compliance.any():
        warnings.append(
            f"--payload-kg {options.payload_kg:g} changes nothing: the calibration has no joints "
            "that bend (level elastic)."
        )
    if file is not None:
        write_atomically(file, table_to_send(targets, columns, rows))
    if options.as_json:
        kept = [column for column in targets.table.columns if column not in columns]
        cells = [dict(zip(targets.table.columns, row, strict=True)) for row in targets.table.rows]
        sent = [
            {
                "place": targets.places[row],
                **{name: cells[row][name] for name in kept},
                **{name: float(numbers[row]) for name, numbers in columns.items()},
            }
            for row in rows
        ]
        left_out = [{"place": place, "reason": why} for place, why in unreachable]
        print_json({"targets": sent, "unreachable": left_out, "warnings": warnings})
        return
    if file is None:
        typer.echo(table_to_send(targets, columns, rows), nl=False)
    _report(columns, rows, unreachable, warnings, is_answer=file is not None)
    if file is not None:
        say(f"wrote {file}")


def _program_frame(calibration: Calibration, tool: str | None, name: str) -> FloatArray | None:
    """A tool or a base of the calibration by its name in a program; the stated one without."""
    kind, _, label = name.partition(" ")
    if kind == "tool" and tool is not None and not label:
        return np.eye(4) if tool == "none" else _tool(calibration, tool)
    parent = _TOOLS if kind == "tool" else "base_from_"
    placed = {key.lower(): edge.matrix for key, edge in calibration.placed.items()}
    return placed.get(f"{parent}{label.lower()}")


def _correct_program(options: CorrectOptions, dialect: Dialect) -> None:
    """Corrects a program's literal targets into a folder, and prints what changes as a diff."""
    if options.out is None or options.out == Path("-"):
        raise DataError(
            f"{options.targets.name} is a program ({dialect.name}), and -o FOLDER is missing for "
            "the corrected one.",
            culprits=["-o"],
        )
    folder, calibration = options.out, load_calibration(options.calibration, options, ARM)
    bad = check_usable(calibration.verdict, "the calibration", force=options.force)
    calibration, links_c = _at_temperatures(calibration, options.temperatures)
    arm = CalibratedArm.of(calibration)
    others = options.targets.parent.glob(f"{options.targets.stem}.*")
    files = [options.targets, *(at for at in others if at.suffix.lower() == dialect.companion)]
    texts = {file.name: read_bytes(file).decode("latin-1") for file in files}
    for name in texts:
        check_free(folder / name, force=options.force)

    nothing = np.full((1, arm.real.joint_count), np.nan)
    seed = _seeds(nothing, options.seed_joints)[0]
    load = (options.payload_kg, options.payload_m)
    frames = partial(_program_frame, calibration, options.tool)
    done = correct_program(dialect, texts, arm, frames, loads=load, seed=seed)
    diff = [
        line
        for name, text in texts.items()
        for line in unified_diff(
            text.splitlines(), done.texts[name].splitlines(), name, name, n=0, lineterm=""
        )
    ]
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in done.texts.items():
        write_atomically(folder / name, text.encode("latin-1"))
    if options.as_json:
        print_json({"changed": list(done.changed), "left": list(done.left), "diff": diff})
        return
    for line in diff:
        typer.echo(line)
    most = f", by up to {figure(float(done.moved_mm.max()))} mm" if len(done.moved_mm) else ""
    say(f"{len(done.changed)} targets corrected{most}; {len(done.left)} motions stay")
    for words in dict.fromkeys(done.left):
        say(words, "left as it is: ", "bold yellow")
    loads = Loads.alike(len(done.q), *load, (0.0, 0.0, 0.0))
    for words in (*bad, *unseen(calibration, done.q, loads, links_c)):
        warn(words)
    for name in texts:
        say(f"wrote {folder / name}")


def _at_temperatures(
    calibration: Calibration, words: str | None
) -> tuple[Calibration, FloatArray | None]:
    """The calibration at the stated temperatures, and these, (n,) [deg C]; None for none."""
    if words is None:
        return calibration, None
    form = ",".join(f"T{index + 1}" for index in range(calibration.drift.joint_count))
    temperatures = np.array(numbers_in(words, "--temperatures", form))
    wrong = next(filter(None, map(column_of("ambient_c").fault, temperatures.tolist())), "")
    if wrong:
        raise DataError(f"--temperatures: {wrong}.", culprits=["--temperatures"])
    return calibration.at_temperatures(temperatures), temperatures


def _tool(calibration: Calibration, name: str | None) -> FloatArray:
    """(4, 4) `flange_from_tool` [m]; the identity where the targets are of the flange."""
    if name is None:
        return np.eye(4)
    placed = calibration.placed
    transform = name if name.startswith(_TOOLS) else f"{_TOOLS}{name}"
    if transform not in placed:
        tools = [word.removeprefix(_TOOLS) for word in placed if word.startswith(_TOOLS)]
        raise DataError(
            f"--tool {name}: calibration {calibration.session_name!r} has no {transform}; on its "
            f"flange are {', '.join(tools) or 'no tools'}.",
            culprits=["--tool"],
            next_step=did_you_mean(name, tools) or "A tool joins it by visioncal tcp.",
        )
    return placed[transform].matrix


def _seeds(seeds: FloatArray, words: str | None) -> FloatArray:
    """Seeds of the rows (m, n); the first takes that of the option where it has none."""
    if words is None:
        return seeds
    form = ",".join(f"q{index}" for index in range(1, seeds.shape[1] + 1))
    first = np.array(numbers_in(words, "--seed-joints", form))
    if np.isnan(seeds[0, 0]):
        seeds = seeds.copy()
        seeds[0] = first
    return seeds


def _warn_turns(
    arm: CalibratedArm, targets: Targets, corrected: Corrected, widest_deg: float
) -> Iterator[str]:
    """Warns where joints turned far from the seed, possibly onto another branch."""
    turned = np.rad2deg(corrected.turned_rad)
    rows = np.flatnonzero(corrected.reached & (turned.max(axis=1) > widest_deg))
    for row in rows[:_MOST_SHOWN]:
        joint = int(np.argmax(turned[row]))
        yield (
            f"{targets.places[row]}: {arm.real.joint_names[joint]} turns by "
            f"{turned[row, joint]:.0f} deg from where this target was looked for; no posture "
            "nearer was found."
        )
    if len(rows) > _MOST_SHOWN:
        yield f"And {len(rows) - _MOST_SHOWN} more targets of the kind."


def _report(
    columns: Mapping[str, FloatArray],
    rows: IntArray,
    unreachable: Sequence[tuple[str, str]],
    warnings: Sequence[str],
    *,
    is_answer: bool,
) -> None:
    mm, deg = columns["moved_mm"][rows], columns["moved_deg"][rows]
    words = (
        f"{len(rows)} of {len(rows) + len(unreachable)} targets corrected: moved by "
        f"{mm_and_deg(float(np.median(mm)), float(np.median(deg)))} (median), by "
        f"up to {mm_and_deg(float(mm.max()), float(deg.max()))}"
    )
    if "sigma_mm" in columns:
        words += f"; predicted sigma {figure(float(np.median(columns['sigma_mm'][rows])))} mm"
    # Where stdout has no table, this is the command's answer.
    say(words, is_answer=is_answer)
    for place, why in unreachable[:_MOST_SHOWN]:
        say(f"{place}: {why}", "left out: ", "bold yellow")
    if len(unreachable) > _MOST_SHOWN:
        say(f"  and {len(unreachable) - _MOST_SHOWN} more")
    for warning in warnings:
        warn(warning)
