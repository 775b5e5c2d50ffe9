"""A transform as a pose in the language of a robot's controller.

Numbers have fixed decimals: no controller keeps more, and not every language reads an exponent.
"""

from collections.abc import Callable
from functools import partial

from visioncal.core.conventions import POSE_FORMS, PoseForm, write_pose
from visioncal.core.number_format import fixed
from visioncal.core.types import FloatArray
from visioncal.interchange.exports.content import Content, ExportFormat, comments

# A nanometre and 2e-10 rad, which is a nanometre at five metres.
_DECIMALS = {"m": 9, "mm": 6}
_ROTATION_DECIMALS = {"rotation-vector": 10, "quaternion-wxyz": 10}
_DEGREE_DECIMALS = 8


def ur_pose(group: list[str]) -> str:
    """Writes URScript's pose (Universal Robots, script manual)."""
    return f"p[{', '.join(group)}]"


def kuka_frame(group: list[str]) -> str:
    """Writes KRL's FRAME (KUKA, system variables)."""
    return "{" + ",".join(f"{a} {b}" for a, b in zip("XYZABC", group, strict=True)) + "}"


def abb_pose(group: list[str]) -> str:
    """Writes RAPID's `pose`: trans of type pos, rot of type orient (RAPID reference manual)."""
    return f"[[{','.join(group[:3])}],[{','.join(group[3:])}]]"


def _fanuc(group: list[str]) -> str:
    """Writes a position's numbers as an ASCII program (.LS) has them."""
    x, y, z, w, p, r = group
    return f"X = {x} mm, Y = {y} mm, Z = {z} mm,\nW = {w} deg, P = {p} deg, R = {r} deg"


def pose_texts(matrix: FloatArray, form: PoseForm) -> list[str]:
    """Writes the numbers of a (4, 4) pose [m] as a controller reads them."""
    decimals = _ROTATION_DECIMALS.get(form.rotation, _DEGREE_DECIMALS)
    pose = write_pose(matrix, form)
    texts = [fixed(value, _DECIMALS[form.unit]) for value in pose[:3]]
    return texts + [fixed(value, decimals) for value in pose[3:]]


def _write(form: PoseForm, mark: str, shape: Callable[[list[str]], str], content: Content) -> str:
    notes = comments(mark, content.notes) if mark else ""
    return notes + shape(pose_texts(content.matrix, form)) + "\n"


def _robot(name: str, words: str, mark: str, shape: Callable[[list[str]], str]) -> ExportFormat:
    """Builds a format; `mark` starts a comment in the controller's language."""
    return ExportFormat(name, words, partial(_write, POSE_FORMS[name], mark, shape))


UR = _robot(
    "ur", "Universal Robots: p[x, y, z, rx, ry, rz] [m, rotation vector in rad]", "#", ur_pose
)
KUKA = _robot("kuka", "KUKA KRL: {X ..,Y ..,Z ..,A ..,B ..,C ..} [mm, deg]", ";", kuka_frame)
FANUC = _robot("fanuc", "FANUC: X, Y, Z, W, P, R as in an .LS program [mm, deg]", "", _fanuc)
ABB = _robot(
    "abb", "ABB RAPID pose: [[x,y,z],[q1,q2,q3,q4]] [mm, quaternion w first]", "!", abb_pose
)
STAUBLI = _robot(
    "staubli",
    "Staubli VAL 3 trsf: {x, y, z, rx, ry, rz} [mm, deg]",
    "//",
    lambda group: f"{{{', '.join(group)}}}",
)
YASKAWA = _robot("yaskawa", "Yaskawa: X,Y,Z,Rx,Ry,Rz as in a job [mm, deg]", "", ",".join)
DOOSAN = _robot(
    "doosan",
    "Doosan DRL: posx(x, y, z, a, b, c) [mm, deg about z, y, z]",
    "#",
    lambda group: f"posx({', '.join(group)})",
)

ROBOTS = (UR, KUKA, FANUC, ABB, STAUBLI, YASKAWA, DOOSAN)
