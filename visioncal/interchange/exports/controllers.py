"""Tools and fixtures in the languages of UR's, ABB's and KUKA's controllers.

All take a tool in the flange's frame and a fixture in the robot's base: the frames of poses that
are reported with no active tool or base.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

from visioncal.core.conventions import POSE_FORMS
from visioncal.core.errors import DataError
from visioncal.core.number_format import fixed
from visioncal.interchange.exports.content import Content, ExportFormat, comments
from visioncal.interchange.exports.robots import abb_pose, kuka_frame, pose_texts, ur_pose

_NO_POSE = "[[0,0,0],[1,0,0,0]]"
# A FlexPendant writes this mass into a new tool whose load is still to be given.
_NO_LOAD = "[-1,[0,0,0],[1,0,0,0],0,0,0]"


@dataclass(frozen=True)
class Language:
    """Rules of a language for variable names."""

    name: str
    shape: re.Pattern[str]  # Pattern of a valid name.
    needed: str  # The same in words.
    taken: frozenset[str]  # Reserved words; lower case where the language ignores case.
    cased: bool  # Whether it distinguishes upper and lower case.


_RAPID_WORDS = """
    tool0 wobj0 load0
    alias and backward case connect const default div do else elseif endfor endfunc endif endmodule
    endproc endrecord endtest endtrap endwhile error exit false for from func goto if inout local
    mod module nostepin not noview or pers proc raise readonly record retry return step sysmodule
    task test then to trap true trynext undo var viewonly while with xor
"""
_URSCRIPT_WORDS = """
    and break continue def elif else end enter_critical exit_critical False global halt if in join
    kill local not or pause return run sec struct thread True while xor
"""
# ABB, "RAPID kernel", lexical elements: identifiers of up to 32 characters, case ignored, and the
# reserved words. tool0, wobj0 and load0 are the system's own and cannot be changed.
RAPID = Language(
    "RAPID",
    re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}", re.ASCII),
    "a letter first, then letters, digits and _, 32 in all",
    frozenset(_RAPID_WORDS.split()),
    cased=False,
)
# Universal Robots, script manual, "Numbers, Variables, and Types", "Flow of Control", "Threads" and
# "Secondary Programs": the keywords.
URSCRIPT = Language(
    "URScript",
    re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII),
    "a letter or _ first, then letters, digits and _",
    frozenset(_URSCRIPT_WORDS.split()),
    cased=True,
)


def _check_identifier(name: str, language: Language) -> str:
    """Returns a name after checking that it is valid for a variable."""
    compared = name if language.cased else name.lower()
    if not language.shape.fullmatch(name):
        wrong = f"{language.needed}, are needed"
    elif compared in language.taken:
        wrong = "it is the language's own"
    else:
        return name
    raise DataError(
        f"{name!r} cannot be a name in {language.name}: {wrong}.",
        culprits=[name],
        next_step="Choose another with --child.",
    )


def _write_ur_tcp(content: Content) -> str:
    """Writes a call of URScript's set_tcp (script manual, module internals, `set_tcp`)."""
    # Without the name argument of newer controllers, so that older ones read it, too.
    pose = ur_pose(pose_texts(content.matrix, POSE_FORMS["ur"]))
    return comments("#", content.notes) + f"set_tcp({pose})\n"


def _write_ur_feature(content: Content) -> str:
    """Writes a pose into a variable, for use with pose_trans."""
    # PolyScope's features are entered by hand; programs can use a variable of type pose like a
    # feature (script manual, "Numbers, Variables, and Types" and "Scoping rules").
    name = _check_identifier(content.child, URSCRIPT)
    pose = ur_pose(pose_texts(content.matrix, POSE_FORMS["ur"]))
    return comments("#", content.notes) + f"global {name} = {pose}\n"


def _write_abb_tool(content: Content) -> str:
    """Writes RAPID's `tooldata`: robhold, tframe, tload (RAPID reference, data types, `tooldata`).

    `loaddata`'s centre of mass is in the flange's frame [mm]; its axes and moments of inertia are
    those of a point mass.
    """
    name = _check_identifier(content.child, RAPID)
    pose = abb_pose(pose_texts(content.matrix, POSE_FORMS["abb"]))
    load = _NO_LOAD
    if content.load is not None:
        centre = ",".join(fixed(value, 6) for value in content.load.centre_mm)
        load = f"[{fixed(content.load.mass_kg, 6)},[{centre}],[1,0,0,0],0,0,0]"
    notes = comments("!", content.notes)
    return f"{notes}PERS tooldata {name}:=[TRUE,{pose},{load}];\n"


def _warn_of_load(content: Content) -> Iterator[str]:
    if content.load is None:
        yield (
            "touches determine no load: the tool's mass is written as -1, ABB's mark of a load "
            "that is still to be given. Give it with --mass-kg and --cog-mm, or run LoadIdentify "
            "before the robot moves with this tool."
        )


def _write_abb_wobj(content: Content) -> str:
    """Writes RAPID's `wobjdata` with the fixture as its user frame."""
    # robhold, ufprog, ufmec, uframe, oframe (RAPID reference, data types, `wobjdata`): a fixed user
    # frame, with the object frame at its origin.
    name = _check_identifier(content.child, RAPID)
    pose = abb_pose(pose_texts(content.matrix, POSE_FORMS["abb"]))
    notes = comments("!", content.notes)
    return f'{notes}PERS wobjdata {name}:=[FALSE,TRUE,"",{pose},{_NO_POSE}];\n'


def _write_kuka(what: Literal["TOOL", "BASE"], content: Content) -> str:
    """Writes an entry of $CONFIG.DAT, or the active frame (KUKA, system variables)."""
    frame = kuka_frame(pose_texts(content.matrix, POSE_FORMS["kuka"]))
    name = f"${what}" if content.number is None else f"{what}_DATA[{content.number}]"
    return f"{comments(';', content.notes)}{name}={frame}\n"


CONTROLLERS = (
    ExportFormat(
        "ur-tcp",
        "a tool for Universal Robots: set_tcp(p[...]) [m, rotation vector in rad]",
        _write_ur_tcp,
        holds="tool",
        counterpart="ur-feature",
    ),
    ExportFormat(
        "ur-feature",
        "a fixture for Universal Robots: a pose in a variable [m, rotation vector in rad]",
        _write_ur_feature,
        holds="fixture",
        counterpart="ur-tcp",
    ),
    ExportFormat(
        "abb-tooldata",
        "a tool for ABB: PERS tooldata, with --mass-kg and --cog-mm [mm, quaternion w first]",
        _write_abb_tool,
        holds="tool",
        takes=frozenset({"load"}),
        warn=_warn_of_load,
        counterpart="abb-wobjdata",
    ),
    ExportFormat(
        "abb-wobjdata",
        "a fixture for ABB: PERS wobjdata [mm, quaternion w first]",
        _write_abb_wobj,
        holds="fixture",
        counterpart="abb-tooldata",
    ),
    ExportFormat(
        "kuka-tool",
        "a tool for KUKA: $TOOL, or TOOL_DATA[n] with --number n [mm, deg]",
        partial(_write_kuka, "TOOL"),
        holds="tool",
        takes=frozenset({"number"}),
        counterpart="kuka-base",
    ),
    ExportFormat(
        "kuka-base",
        "a fixture for KUKA: $BASE, or BASE_DATA[n] with --number n [mm, deg]",
        partial(_write_kuka, "BASE"),
        holds="fixture",
        takes=frozenset({"number"}),
        counterpart="kuka-tool",
    ),
)
