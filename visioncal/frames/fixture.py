"""A fixture from touches: where the tip was, the fit, and what it rests on."""

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.core.limits import FixtureLimits
from visioncal.core.verdict import Finding
from visioncal.estimation.features import FEATURE_KINDS
from visioncal.frames.drawing_points import NominalPoints
from visioncal.frames.fixture_fit import Setting
from visioncal.frames.fixture_from_drawing import drawn_fixture
from visioncal.frames.fixture_from_features import featured_fixture
from visioncal.frames.measured import Tool, touched_points
from visioncal.frames.touches import TouchRows, robot_noise
from visioncal.results import Calibration, Frame
from visioncal.robot import Robot


@typed
def touched_fixture(
    rows: TouchRows,
    tool: Tool | None,
    drawing: NominalPoints | None = None,
    calibration: Calibration | None = None,
    robot: Robot | None = None,
    *,
    touch_noise_m: float | None = None,
    options: FixtureLimits | None = None,
) -> Frame:
    """Finds a fixture by touches of its features, or of points that a drawing has.

    Args:
        rows: The touches. Without a drawing each is of kind `origin`, `x` (on the positive x axis)
            or `xy` (in the xy plane, on the side of positive y); with one, each names its point.
        tool: That touched; None where the poses are of the tip itself.
        drawing: The points in the fixture's frame; None for features.
        calibration: Of the same robot, where there is one: its noise and its arm are used.
        robot: A model for joint angles, where the calibration has none.
        touch_noise_m: What a touch is known to repeat to, per axis [m].
        options: Where doubt begins.

    Returns:
        `base_from_fixture`.

    Raises:
        DataError: Touches are missing, wrongly written, or contradict each other or the drawing.
        DegenerateError: They leave a direction of the fixture open.
    """
    if drawing is None:
        rows = rows.of_kinds(
            FEATURE_KINDS, hint="Say --cad FILE, where the points are those of a drawing."
        )
    else:
        rows = rows.of_kinds(
            ("point",),
            "point",
            "Leave --cad away, where the fixture's origin, x axis and xy plane were touched.",
        )
        _check_named(rows)
    measured = touched_points(rows, tool, robot_noise(calibration), robot, calibration)
    setting = Setting(
        touch_noise_m, tuple(_doubts(tool)), _details(tool), options or FixtureLimits()
    )
    if drawing is None:
        return featured_fixture(measured, rows.kinds, setting)
    return drawn_fixture(measured, drawing, setting)


def _check_named(rows: TouchRows) -> None:
    unnamed = [place for place, it in zip(rows.places, rows.points, strict=True) if not it.strip()]
    if unnamed:
        where = rows.source if len(unnamed) == len(rows) else some_of(unnamed)
        raise DataError(
            f"{where}: which point was touched is not said.",
            culprits=[where],
            next_step="Give a column point, with the names that the drawing has.",
        )


def _doubts(tool: Tool | None) -> list[Finding]:
    if tool is None or tool.verdict.status == "good":
        return []
    return [
        Finding(
            "tool",
            f"The tool, {tool.name}, is in doubt itself ({tool.verdict.status}): "
            f"{tool.verdict.reasons[0] if tool.verdict.reasons else 'no reason is kept.'}",
            is_fatal=tool.verdict.status == "bad",
        )
    ]


def _details(tool: Tool | None) -> dict[str, object]:
    if tool is None:
        return {"tool": "none: the poses are of the tip"}
    return {"tool": {"name": tool.name, "sigma_mm": tool.edge.sigma_mm}}
