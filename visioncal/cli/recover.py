"""`visioncal recover`: one act, which can be ended after each step, and gone on with."""

import shlex
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import numpy as np
import typer

from visioncal.calibration.run import Run
from visioncal.cli.console import (
    EXIT_BAD,
    EXIT_NO_RESULT,
    answer,
    exit_status,
    report_written,
    say,
    warn,
    with_run_paths,
)
from visioncal.cli.correct import correct_command
from visioncal.cli.export import export_command
from visioncal.cli.history import enter
from visioncal.cli.plan import plan_command
from visioncal.cli.progress import shown_progress
from visioncal.cli.result_options import CorrectOptions, ExportOptions, RecoverOptions
from visioncal.cli.session_options import PlanOptions
from visioncal.cli.summary import print_conditions, print_steps, print_verdict
from visioncal.core.codec import REST, read, write
from visioncal.core.documents.jsons import parse_stored
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes, write_json
from visioncal.core.verdict import Verdict
from visioncal.interchange.outputs import STOPS, write_outputs
from visioncal.interchange.result_files import load_result
from visioncal.present.recording.timeline import record_check
from visioncal.results import Calibration, select_matching
from visioncal.results.history import entries_of
from visioncal.session import Session
from visioncal.verification import Check, recovery, verdict_of, verify
from visioncal.verification.recovery import causes_found, moved_along, parted, recover

_ACT, _TABLE, _TARGETS = "recover.json", "views.csv", "targets.csv"


@dataclass(kw_only=True)
class _Act:
    """Content of recover.json; it grows with each step."""

    schema: Literal[1] = 1
    against: tuple[str, str]  # Digest of the earlier calibration's session, and when it was made.
    minutes: dict[str, float]  # Of each step that is done.
    stated: tuple[str, ...]  # Causes.
    record: str | None = None  # The command that records the planned stops; None before the plan.
    # Notes of a newer version, unchanged.
    further: Annotated[Mapping[str, Any], REST] = field(default_factory=dict)

    def __post_init__(self) -> None:
        words = shlex.split(self.record or "visioncal record")
        # Whoever edited the file has no say in what is typed.
        if words[:2] != ["visioncal", "record"] or self.record not in (None, shlex.join(words)):
            raise ValueError(f"record is {self.record!r}, but must be a visioncal record")


def _opened(options: RecoverOptions, old: Calibration) -> _Act:
    """The state of a recovery by recover.json, or its begin; raises DataError."""
    folder, taught = options.folder, options.targets
    if taught is not None and taught.resolve() == (folder / _TARGETS).resolve():
        raise DataError(
            f"--targets {taught} is where the converted targets are written: taught ones are kept.",
            culprits=["--targets"],
            next_step="Give the taught targets another name, or put them elsewhere.",
        )
    against, file = (old.session_sha256, old.created), folder / _ACT
    act = _Act(against=against, minutes={}, stated=())
    if file.is_file():
        act = read(_Act, parse_stored(read_bytes(file), str(file)), str(file))
    if act.against != against:
        raise DataError(
            f"{folder} is the recovery of another calibration than that of "
            f"{old.session_name!r}, {old.created}.",
            culprits=[str(folder), "--against"],
            next_step="Name that one, or another folder.",
        )
    act.stated = tuple(options.cause or act.stated)
    if old.cell is None and old.mount == "instrument":
        raise DataError(
            f"{options.against} was measured by an instrument, and recover works by what a camera "
            "sees.",
            culprits=["--against"],
            next_step="Calibrate anew: visioncal calibrate SESSION -o OUT",
        )
    if old.cell is None:
        recovery.parts_changed(old, act.stated)
    return act


@contextmanager
def _step(options: RecoverOptions, act: _Act, name: str) -> Iterator[None]:
    """Writes down how long a step took, once it is done."""
    begun = time.monotonic()
    yield
    act.minutes[name] = round((time.monotonic() - begun) / 60.0, 3)
    options.folder.mkdir(parents=True, exist_ok=True)
    write_json(options.folder / _ACT, write(_Act, act))


def recover_command(options: RecoverOptions) -> None:
    """Runs `visioncal recover`.

    Raises:
        DataError: Something cannot be read or written, or a step is impossible.
        VerdictError: The recovered calibration is bad, and was to be exported.
    """
    loaded, result = load_result(options.against), options.folder / "result"
    path = options.stops or options.folder / "stops"
    act = _opened(options, loaded)
    stated = causes = act.stated
    session, old = select_matching(_recorded(options, act, path), loaded, options)
    with (
        _step(options, act, "result"),
        shown_progress(quiet=False) as progress,
        with_run_paths(path),
    ):
        check = None
        if old.joint_fit is not None:
            check = verify(parted(session)[0], old, progress=progress)
            for words in check.predicted.warnings:
                warn(words)
            verdict = verdict_of(check).with_paths(path, options.against, _again())
            options.folder.mkdir(parents=True, exist_ok=True)
            record_check(options.folder / "check.rrd", check, verdict)
            if check.passed and not stated:
                answer(f"nothing has changed: {options.against} holds. {verdict.top[0]}")
                raise typer.Exit
            causes = causes or causes_found(check)
            if (check.explained or check.misread is not None) and not causes:
                _ask_cause(check, verdict)
            if not stated:
                _ask_side(options, old, causes)
        if not causes:
            say("no single change explains the stops: they are calibrated on their own")
        new = recover(session, old, causes, check)
        progress("write", 0, 1)
        written = write_outputs(result, session, Run(new, ()))
    entries = (replace(entry, cell=old.session_name) for entry in entries_of(new))
    enter(options, path, entries, result, old.session_sha256)
    print_verdict(new.verdict, str(result))
    print_conditions(new)
    # A zero of the controller is set by a proven angle alone, and where nothing else changed.
    if len(causes) == 1 and causes[0].startswith("joint") and new.verdict.status != "bad":
        answer(
            f"Or master {causes[0]} on the controller, by the angle above: then {options.against} "
            f"holds again, and {result} does not. It is for the controller as it is now."
        )
    base_moved, flange_moved = moved_along(old, new, causes)
    if options.targets is not None:
        with _step(options, act, "targets"):
            names = ("targets", "tool", "payload_kg", "payload_m", "temperatures", "force")
            given = {name: getattr(options, name) for name in names}
            out = _cleared(options.folder / _TARGETS)
            to_correct = CorrectOptions(**given, calibration=result, out=out)
            # A tool's targets find its new mount in the result.
            by_flange = flange_moved if options.tool is None else np.eye(4)
            correct_command(to_correct, (base_moved, by_flange))
    for name in options.to or ():
        with _step(options, act, f"export {name}"):
            out = _cleared(options.folder / "exports" / name)
            export_command(ExportOptions(source=result, to=name, out=out, force=options.force))
    steps = ", ".join(f"{name} {value:.2f}" for name, value in act.minutes.items())
    answer(f"{steps}; {sum(act.minutes.values()):.2f} in all", "minutes: ")
    report_written(written, status=exit_status(new.verdict))


def _cleared(file: Path) -> Path:
    """A file of the act, without what an earlier command wrote."""
    file.parent.mkdir(exist_ok=True)
    file.unlink(missing_ok=True)
    return file


def _recorded(options: RecoverOptions, act: _Act, path: Path) -> Session:
    """The recorded stops; without them, plans them, says how to record, and exits."""
    table, planned = path if path.suffix == ".rrd" else path / _TABLE, options.folder / "plan"
    session = Session.load(path) if table.is_file() else None
    if session is not None and len(session.views) >= options.count:
        if options.stops is None and planned.is_dir():
            taken_s = table.stat().st_mtime - planned.stat().st_mtime
            act.minutes["stops"] = round(max(taken_s, 0.0) / 60.0, 3)
        return session
    if options.stops is None and act.record is None:
        plan_options = PlanOptions(
            **{name: getattr(options, name) for name in ("camera", "robot", "target")},
            source=str(options.against),
            to_verify=True,
            stops=options.count,
            out=planned,
        )
        with _step(options, act, "plan"):
            try:
                act.record = plan_command(plan_options, path)
            except DataError as error:
                warn(f"no stops are planned: {error.message}")
    taken, places = 0 if session is None else len(session.views), planned / STOPS
    # The plan's command records into the act's own folder.
    planned_record = act.record if options.stops is None else None
    record = planned_record or f"visioncal record --page -o {shlex.quote(str(path))}"
    reason = f"{taken} of {options.count} stops are in {path}."
    how = (
        "Keep clear: an arm whose joint slipped stands elsewhere than it reads. Drive to those"
        f"{f' of {places}' if places.is_file() else ''} that are missing, record them, and type "
        f"the same command again (with fewer: --count):\n  {record}{' --resume' if taken else ''}"
    )
    if options.stops is not None:
        raise DataError(reason, culprits=[str(path)], next_step=how)
    say(f"{reason} {how}")
    raise typer.Exit(EXIT_NO_RESULT)


def _ask_cause(check: Check, verdict: Verdict) -> NoReturn:
    """Names causes that are not separated, or not recovered, and exits."""
    kinds = ("camera", "board", "joint")
    alike = [[change.name] for change in check.named if change.cause.kind in kinds]
    how = "Look which of them it is, and say so:"
    for line in ("what to recover is not known:", *verdict.top):
        answer(line)
    if len(check.named) == 1 or not alike:
        print_steps(verdict.next_steps)
        alike, how = [], "Or record more stops, as --count 30, or name each --cause."
    for line in (how, *map(_with_causes, alike)):
        answer(line)
    raise typer.Exit(EXIT_BAD)


def _ask_side(options: RecoverOptions, old: Calibration, causes: Sequence[str]) -> None:
    """Asks whether all else moved along with a camera or board, where targets or tools may."""
    along = recovery.along(old, causes)
    if (*causes,) != along and (options.targets or old.frames):
        raise DataError(
            f"{' and '.join(causes)} moved: alone, or with the robot's base or the tool's mount, "
            "so that targets, tools and fixtures of that side have to follow?",
            culprits=["--cause"],
            next_step="\n".join(["Say so, as", *map(_with_causes, (causes, along))]),
        )


def _with_causes(causes: Sequence[str]) -> str:
    """The typed command with causes."""
    options = chain.from_iterable(("--cause", cause) for cause in causes)
    return f"  {shlex.join([*_again(), *options])}"


def _again() -> list[str]:
    """The typed command."""
    return ["visioncal", *sys.argv[1:]]
