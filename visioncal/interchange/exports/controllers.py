"""Tools and fixtures in the languages of UR's, ABB's and KUKA's controllers.

All take a tool in the flange's own frame and a fixture in the robot's base: the frames of the
poses that were reported while no tool and no base were active.
"""

from functools import partial
from typing import Literal

from visioncal.core.conventions import POSE_FORMS
from visioncal.interchange.exports.content import Content
from visioncal.interchange.exports.format import ExportFormat
from visioncal.interchange.exports.identifiers import RAPID, URSCRIPT, check_identifier
from visioncal.interchange.exports.robots import abb_pose, kuka_frame, pose_texts, ur_pose
from visioncal.interchange.exports.writing import comments, fixed

_NO_POSE = "[[0,0,0],[1,0,0,0]]"
# What a FlexPendant writes into a new tool whose load is still to be given.
_NO_LOAD = "[-1,[0,0,0],[1,0,0,0],0,0,0]"


def _write_ur_tcp(content: Content) -> str:
    """Writes a call of URScript's set_tcp (script manual, module internals, `set_tcp`).

    Without the name that newer controllers take, so that older ones read it, too.
    """
    pose = ur_pose(pose_texts(content.matrix, POSE_FORMS["ur"]))
    return comments("#", content.notes) + f"set_tcp({pose})\n"


def _write_ur_feature(content: Content) -> str:
    """Writes a pose into a variable, as a program uses it with pose_trans.

    PolyScope's features are entered by hand; its programs move in a variable of type pose as in a
    feature (script manual, "Numbers, Variables, and Types" and "Scoping rules").
    """
    name = check_identifier(content.child, URSCRIPT)
    pose = ur_pose(pose_texts(content.matrix, POSE_FORMS["ur"]))
    return comments("#", content.notes) + f"global {name} = {pose}\n"


def _write_abb_tool(content: Content) -> str:
    """Writes RAPID's `tooldata`: robhold, tframe, tload (RAPID reference, data types, `tooldata`).

    `loaddata`'s centre of mass is in the flange's frame [mm]; axes and moments of inertia are
    left at those of a point.
    """
    name = check_identifier(content.child, RAPID)
    pose = abb_pose(pose_texts(content.matrix, POSE_FORMS["abb"]))
    load = _NO_LOAD
    if content.load is not None:
        centre = ",".join(fixed(it, 6) for it in content.load.centre_mm)
        load = f"[{fixed(content.load.mass_kg, 6)},[{centre}],[1,0,0,0],0,0,0]"
    notes = comments("!", content.notes)
    return f"{notes}PERS tooldata {name}:=[TRUE,{pose},{load}];\n"


def _warn_of_load(content: Content) -> str:
    if content.load is not None:
        return ""
    return (
        "touches determine no load: the tool's mass is written as -1, ABB's mark of a load that is "
        "still to be given. Give it with --mass-kg and --cog-mm, or run LoadIdentify before the "
        "robot moves with this tool."
    )


def _write_abb_wobj(content: Content) -> str:
    """Writes RAPID's `wobjdata` with the fixture as its user frame.

    robhold, ufprog, ufmec, uframe, oframe (RAPID reference, data types, `wobjdata`): a fixed frame,
    and the object's own at its origin.
    """
    name = check_identifier(content.child, RAPID)
    pose = abb_pose(pose_texts(content.matrix, POSE_FORMS["abb"]))
    notes = comments("!", content.notes)
    return f'{notes}PERS wobjdata {name}:=[FALSE,TRUE,"",{pose},{_NO_POSE}];\n'


def _write_kuka(what: Literal["TOOL", "BASE"], content: Content) -> str:
    """Writes an entry of $CONFIG.DAT, or the frame that is active (KUKA, system variables)."""
    frame = kuka_frame(pose_texts(content.matrix, POSE_FORMS["kuka"]))
    name = f"${what}" if content.number is None else f"{what}_DATA[{content.number}]"
    return f"{comments(';', content.notes)}{name}={frame}\n"


CONTROLLERS = (
    ExportFormat(
        "ur-tcp",
        "a tool for Universal Robots: set_tcp(p[...]) [m, rotation vector in rad]",
        _write_ur_tcp,
        "tool",
        counterpart="ur-feature",
    ),
    ExportFormat(
        "ur-feature",
        "a fixture for Universal Robots: a pose in a variable [m, rotation vector in rad]",
        _write_ur_feature,
        "fixture",
        counterpart="ur-tcp",
    ),
    ExportFormat(
        "abb-tooldata",
        "a tool for ABB: PERS tooldata, with --mass-kg and --cog-mm [mm, quaternion w first]",
        _write_abb_tool,
        "tool",
        takes=frozenset({"load"}),
        warn=_warn_of_load,
        counterpart="abb-wobjdata",
    ),
    ExportFormat(
        "abb-wobjdata",
        "a fixture for ABB: PERS wobjdata [mm, quaternion w first]",
        _write_abb_wobj,
        "fixture",
        counterpart="abb-tooldata",
    ),
    ExportFormat(
        "kuka-tool",
        "a tool for KUKA: $TOOL, or TOOL_DATA[n] with --number n [mm, deg]",
        partial(_write_kuka, "TOOL"),
        "tool",
        takes=frozenset({"number"}),
        counterpart="kuka-base",
    ),
    ExportFormat(
        "kuka-base",
        "a fixture for KUKA: $BASE, or BASE_DATA[n] with --number n [mm, deg]",
        partial(_write_kuka, "BASE"),
        "fixture",
        takes=frozenset({"number"}),
        counterpart="kuka-tool",
    ),
)
