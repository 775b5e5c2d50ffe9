"""The formats that are known, and the way from a calibration to a document."""

from visioncal.calibration import Calibration
from visioncal.errors import DataError
from visioncal.exports.content import HAND_EYE, Selection, select
from visioncal.exports.format import ExportFormat
from visioncal.exports.launch import MOVEIT, ROS_LAUNCH
from visioncal.exports.lens import CAMERA_INFO, KALIBR
from visioncal.exports.matrices import OPENCV, TEXT, ZIVID
from visioncal.exports.robots import ROBOTS
from visioncal.exports.ros import EASY_HANDEYE2, ROS
from visioncal.exports.urdf import URDF
from visioncal.files import did_you_mean

EXPORT_FORMATS: tuple[ExportFormat, ...] = (
    ROS,
    ROS_LAUNCH,
    MOVEIT,
    EASY_HANDEYE2,
    URDF,
    CAMERA_INFO,
    KALIBR,
    OPENCV,
    ZIVID,
    TEXT,
    *ROBOTS,
)
_EVERYTHING = Selection()


def export(calibration: Calibration, to: str, selection: Selection = _EVERYTHING) -> str:
    """Writes a result in somebody else's format.

    Args:
        calibration: The result.
        to: The name of a format among `EXPORT_FORMATS`.
        selection: Which transform, in which direction, and what its frames are to be called.

    Returns:
        The document.

    Raises:
        DataError: There is no such format or transform, the format cannot hold what is asked for,
            or a frame's name cannot be written safely.
    """
    form = _find(to)
    _check_holds(form, selection)
    return form.write(select(calibration, selection, form.frames))


def _find(name: str) -> ExportFormat:
    by_name = {it.name: it for it in EXPORT_FORMATS}
    if name in by_name:
        return by_name[name]
    hint = did_you_mean(name, by_name)
    raise DataError(
        f"There is no format named {name!r}; the names are {', '.join(by_name)}.",
        culprits=[name],
        next_step=f"{hint} visioncal export --list says what each is.".strip(),
    )


def _check_holds(form: ExportFormat, selection: Selection) -> None:
    if form.holds == "lens" and (
        selection.inverse or selection.edge is not None or selection.parent is not None
    ):
        raise DataError(
            f"{form.name} holds the lens and no transform: --edge, --inverse and --parent do not "
            "go with it.",
            culprits=[form.name],
            next_step="Leave them out; --child names the camera.",
        )
    hand_eye = selection.edge in (None, *HAND_EYE.values())
    if form.holds == "hand-eye" and (selection.inverse or not hand_eye):
        raise DataError(
            f"{form.name} holds the camera's pose on the flange or in the base, and nothing else.",
            culprits=[form.name],
            next_step="Leave --edge and --inverse out, or choose --to ros.",
        )
