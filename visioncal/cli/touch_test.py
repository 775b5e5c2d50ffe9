"""`visioncal touch-test`."""

import shlex
import sys
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from visioncal.cli.console import (
    EXIT_BAD,
    answers,
    asked,
    check_usable,
    messages,
    print_json,
    report_error,
    report_written,
    say,
    warn,
)
from visioncal.cli.options import AsJson, ForceBad, SessionArgument, Yes
from visioncal.cli.parsing import named_result, numbers_in, refuse_given
from visioncal.cli.progress import shown_progress
from visioncal.core.errors import DataError, DriverError
from visioncal.core.number_format import figure

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.core.types import FloatArray, Target
    from visioncal.frames.measured_points import Tool
    from visioncal.frames.touch_test import TouchPoint, TouchTargets
    from visioncal.live.capture.hover import Hovering
    from visioncal.results import Calibration

_FORM = "Flange targets: x, y, z \\[mm], rotation vector \\[rad]; hover first, then touch."


def touch_test_command(
    session: SessionArgument,
    calibration: Annotated[
        Path | None, typer.Option("-c", "--calibration", help="An output folder of calibrate.")
    ] = None,
    tool: Annotated[
        str | None,
        typer.Option(
            help="Which tool of the calibration has the tip, see tcp; its only tool need not be "
            "named. none: a gauge of --clearance-mm before the flange."
        ),
    ] = None,
    clearance_mm: Annotated[
        float | None,
        typer.Option(
            min=0.0,
            max=2000.0,
            help="With --tool none: the flange comes no nearer to the board, and a gauge of this "
            "length has the tip; longer than all that the flange carries.",
        ),
    ] = None,
    height_mm: Annotated[
        float, typer.Option(min=1.0, max=1000.0, help="Hovering height, before the touch.")
    ] = 50.0,
    gaps_mm: Annotated[
        str | None,
        typer.Option(metavar="A,B,C,D,E", help="Measured gaps from tip to point, in their order."),
    ] = None,
    drive: Annotated[
        str | None,
        typer.Option(
            metavar="ur:HOST",
            help="Bring the tip above each point by this arm, slowly; the rest is by hand.",
        ),
    ] = None,
    yes: Yes = False,
    force: ForceBad = False,
    as_json: AsJson = False,
) -> None:
    """Prove a calibration: touch what the camera locates, and enter the gaps.

    The session has one image or more of a board as it lies now. Prints where to send the robot,
    hovering first, corrected where the arm is calibrated; at a terminal it asks for each gap. With
    all gaps, they are compared with what was predicted, and kept in the result and its report. Exit
    status 3: they are larger, or nothing was done as the calibration or the tool is bad.
    """
    from visioncal.frames.touch_test import evaluate_gaps, touch_targets, touch_test_finding
    from visioncal.interchange.result_files import load_result, rewrite_result
    from visioncal.results import to_document
    from visioncal.session import Session

    loaded = Session.load(session)
    calibration = named_result(calibration, "-c", "touch-test: the calibration to prove")
    result = load_result(calibration)
    if result.cell is not None:
        raise DataError(
            f"touch-test is for one camera and one robot, and {calibration} is of a whole cell.",
            culprits=["-c"],
            next_step=f"Let visioncal locate {shlex.quote(str(session))} "
            f"-c {shlex.quote(str(calibration))} --camera NAME --robot NAME say where the board "
            "is, touch it there, and compare.",
        )
    touching = _touching(result, calibration, tool)
    misplaced_mm = None if tool == "none" else clearance_mm
    refuse_given({"--clearance-mm": misplaced_mm}, "it is for --tool none")
    if drive is not None:
        refuse_given({"--gaps-mm": gaps_mm}, "with --drive, gaps are asked for")
    with shown_progress(quiet=as_json):
        clearance_m = None if clearance_mm is None else 1e-3 * clearance_mm
        located = touch_targets(loaded, result, touching, clearance_m)
    used = {
        "the calibration": result.verdict,
        "where the board lies": located.board.verdict,
        **({} if touching is None else {touching.name: touching.verdict}),
    }
    for what, verdict in used.items():
        for warning in check_usable(verdict, what, force=force):
            warn(warning)
    points = located.points
    targets = [_target(result, located, point, 1e-3 * height_mm) for point in points]
    if gaps_mm is not None:
        count = gaps_mm.count(",") + 1
        gaps = [*numbers_in(gaps_mm, "--gaps-mm", ",".join("abcdefghij"[:count]))]
    elif drive is not None:
        board = next(iter(loaded.boards.values()))
        gaps = _drive(drive, result, board, located, targets, 1e-3 * height_mm, yes=yes)
    elif sys.stdin.isatty() and not as_json:
        gaps = _ask_gaps(points, targets)
    else:
        _report(points, targets, as_json=as_json)
        return
    test = evaluate_gaps(points, gaps, touching)
    extended = replace(result, touch_test=test)
    written = rewrite_result(calibration if calibration.is_dir() else calibration.parent, extended)
    if as_json:
        print_json({"points": targets, "touch_test": to_document(extended)["touch_test"]})
    else:
        answers().print(escape(touch_test_finding(test).reason))
    report_written(written, quiet=as_json, status=0 if test.passed else EXIT_BAD)


def _touching(calibration: "Calibration", path: Path, tool: str | None) -> "Tool | None":
    """The tool that touches; None where there is none."""
    from visioncal.frames.measured_points import Tool

    if any(frame.startswith("flange_from_") for frame in calibration.frames):
        return None if tool == "none" else Tool.among(calibration.frames, "The calibration", tool)
    if tool not in (None, "none"):
        raise DataError(
            f"--tool is {tool!r}, and the calibration has no tool.",
            culprits=["--tool"],
            next_step="Find the tip first, and let it join the calibration: "
            f"visioncal tcp TOUCHES -c {shlex.quote(str(path))} --name gripper",
        )
    return None


def _target(
    calibration: "Calibration", located: "TouchTargets", point: "TouchPoint", height_m: float
) -> dict[str, Any]:
    """Targets of the robot for its own controller."""
    from visioncal.results.compensation import correct

    touch, hover = point.base_from_flange, located.above(point, height_m)
    document: dict[str, Any] = {
        "name": point.name,
        "base_m": point.base_m.tolist(),
        "radius95_mm": point.radius95_mm,
    }
    if calibration.arm_is_calibrated:
        corrected = correct(calibration, [hover, touch])
        (hover, touch), document["q_rad"] = corrected.base_from_flange, corrected.q[1].tolist()
    return document | {"hover": _numbers(hover), "touch": _numbers(touch)}


def _numbers(pose: "FloatArray") -> list[float]:
    from scipy.spatial.transform import RigidTransform

    transform = RigidTransform.from_matrix(pose)
    return [*transform.translation.tolist(), *transform.rotation.as_rotvec().tolist()]


def _report(
    points: "Sequence[TouchPoint]", targets: Sequence[dict[str, Any]], *, as_json: bool
) -> None:
    if as_json:
        print_json({"points": targets})
        return
    console = answers()
    console.print(_FORM)
    for point, target in zip(points, targets, strict=True):
        _report_point(point, target, console)
    console.print("Enter the gaps with --gaps-mm, in this order.")


def _report_point(point: "TouchPoint", target: dict[str, Any], console: Console) -> None:
    """Prints a point's position, and the targets of the robot."""
    x, y, z = 1e3 * point.base_m
    console.print(
        f"{point.name} at ({x:.2f}, {y:.2f}, {z:.2f}) mm, 95 % within {figure(point.radius95_mm)} "
        "mm"
    )
    for name in ("hover", "touch"):
        place, turn = target[name][:3], target[name][3:]
        numbers = [*(f"{1e3 * item:.2f}" for item in place), *(f"{item:.5f}" for item in turn)]
        console.print(f"  {name}: {', '.join(numbers)}")


def _ask_gaps(points: "Sequence[TouchPoint]", targets: Sequence[dict[str, Any]]) -> list[float]:
    """Asks for the gaps, one point after the other."""
    console = messages()
    console.print(_FORM)
    gaps = []
    for point, target in zip(points, targets, strict=True):
        _report_point(point, target, console)
        gaps.append(_gap())
    return gaps


def _drive(
    words: str,
    calibration: "Calibration",
    board: "Target",
    located: "TouchTargets",
    targets: Sequence[dict[str, Any]],
    height_m: float,
    *,
    yes: bool,
) -> list[float]:
    """Drives the tip above each point, and asks for its gap."""
    from visioncal.live.capture.devices import ArmSetup, open_arm
    from visioncal.live.capture.gate import Consent
    from visioncal.live.capture.hover import Hovering
    from visioncal.live.drivers.protocols import MovingArm

    consent = Consent.of("touch-test", asked, yes=yes)
    gaps = []
    with closing(open_arm(words, ArmSetup("", watch_only=False, ask=_line))) as arm:
        if not isinstance(arm, MovingArm):
            raise DataError(f"{arm.name} cannot be driven.", culprits=["--drive"])
        hovering = Hovering.of(arm, calibration, board, located, height_m, consent)
        for point, target in zip(located.points, targets, strict=True):
            _bring(hovering, _pose(target["hover"]), point.name)
            _report_point(point, target, messages())
            gaps.append(_gap())
    return gaps


def _bring(hovering: "Hovering", base_from_flange: "FloatArray", name: str) -> None:
    """Drives the tip above a point; retries while the arm refuses, as in local control."""
    while True:
        try:
            hovering.bring(base_from_flange, name)
        except DriverError as error:
            report_error(error, as_json=False)
            if _line("Enter tries again, q ends: ").strip().lower() == "q":
                raise
        else:
            return


def _pose(numbers: Sequence[float]) -> "FloatArray":
    """(4, 4) pose of x, y, z [m] and a rotation vector [rad]."""
    import numpy as np
    from scipy.spatial.transform import RigidTransform, Rotation

    return np.asarray(
        RigidTransform.from_components(numbers[:3], Rotation.from_rotvec(numbers[3:])).as_matrix()
    )


def _gap() -> float:
    """Asks until a length is typed."""
    import numpy as np

    while True:
        line = _line("  gap [mm]: ")
        with suppress(ValueError):
            gap = float(line.replace(",", "."))
            if 0.0 <= gap < np.inf:
                return gap
        say("  A length of 0 mm or more is needed, as 0.2.")


def _line(question: str) -> str:
    """Asks, and returns the typed line."""
    try:
        return asked(question)
    except EOFError:
        raise DataError(
            "touch-test: the gaps are at their end, and nothing was kept.",
            culprits=["stdin"],
            next_step="Give all with --gaps-mm.",
        ) from None
