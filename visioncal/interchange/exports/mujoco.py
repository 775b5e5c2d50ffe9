"""MuJoCo's MJCF: the parent frame as a body, with the calibrated camera or a site on it.

A camera of MuJoCo looks along -z with y up (MuJoCo, XML reference, `body/camera`), and ours along z
with y down. It is a pinhole with its principal point in the middle of the image: `fovy` is the
vertical angle of view by fy, and a warning states what that leaves out.
"""

from collections.abc import Iterator

import numpy as np

from visioncal.core.conventions import ROTATION_FORMS
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.interchange.exports.content import Content, ExportFormat, numbers, xml_comments

# Our camera's axes in MuJoCo's: turned by half a turn about x.
_TURNED = np.diag([1.0, -1.0, -1.0])
_TEMPLATE = """\
<mujoco model="visioncal">
{notes}  <worldbody>
    <body name="{parent}">
      <site name="{parent}"/>
      <{kind} name="{child}" pos="{pos}" quat="{quat}"{lens}/>
    </body>
  </worldbody>
</mujoco>
"""


def _write(content: Content) -> str:
    rotation, lens, kind = content.matrix[:3, :3], "", "site"
    if content.frames[1].startswith("cam"):
        rotation, kind = rotation @ _TURNED, "camera"
        if content.lens is not None:
            width, height = content.lens.camera.resolution
            fovy_deg = np.rad2deg(2.0 * np.arctan(height / (2.0 * content.lens.camera.matrix[1])))
            lens = f' fovy="{float(fovy_deg)!r}" resolution="{width} {height}"'
    quaternion = ROTATION_FORMS["quaternion-wxyz"].write(rotation[None])[0]
    return _TEMPLATE.format(
        notes=xml_comments("  ", [*content.notes, *_warn(content)]),
        parent=content.parent,
        child=content.child,
        kind=kind,
        pos=_words(content.matrix[:3, 3]),
        quat=_words(quaternion),
        lens=lens,
    )


def _words(values: FloatArray) -> str:
    return " ".join(map(repr, numbers(values)))


def _warn(content: Content) -> Iterator[str]:
    """The part of the lens that a pinhole in the middle of the image leaves out."""
    if content.lens is not None and content.frames[1].startswith("cam"):
        camera = content.lens.camera
        middle = (np.array(camera.resolution) - 1) / 2.0
        off_px = float(np.linalg.norm(camera.matrix[2:] - middle))
        yield (
            "MuJoCo's camera has neither distortion nor a principal point beside the middle of "
            f"the image, from which this one is {figure(off_px)} px away."
        )


MUJOCO = ExportFormat(
    "mujoco",
    "MuJoCo's MJCF: a body with a site, and the camera or a site on it [m, quaternion w first]",
    _write,
    warn=_warn,
)
