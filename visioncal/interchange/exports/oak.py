"""The calibration of a Luxonis OAK camera, as its own library reads it and the device keeps it."""

from visioncal.interchange.exports.content import Content
from visioncal.interchange.exports.format import ExportFormat
from visioncal.interchange.exports.lens import camera_of, warn_of_field
from visioncal.live.drivers.oak_calibration import calibration_json


def _write(content: Content) -> str:
    """Writes the JSON of depthai's CalibrationHandler; the child's name is the camera's socket."""
    return calibration_json(camera_of(content), content.child, content.onto)


def _warn(content: Content) -> str:
    said = warn_of_field(content)
    if content.onto is not None:
        return said
    board = (
        "this calibration holds one camera and nothing of its board. Before a device is given it, "
        "write it onto the device's own: --onto FILE, as CalibrationHandler.eepromToJsonFile saves "
        "it."
    )
    return f"{said} {board}".strip()


OAK = ExportFormat(
    "oak",
    "the lens as the calibration JSON of an OAK [px]; --child names the socket",
    _write,
    "lens",
    {"cam": "CAM_A"},
    frozenset({"onto"}),
    warn=_warn,
)
