"""Poses, tools and fixtures in the languages of robots' controllers.

A tool is given in the flange's frame and a fixture in the robot's base: the frames of poses that
are reported with no active tool or base. Numbers have fixed decimals: no controller keeps more, and
not every language reads an exponent.
"""

import re
from collections.abc import Iterable, Mapping
from functools import partial

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, write_pose
from visioncal.core.errors import DataError
from visioncal.core.number_format import fixed
from visioncal.interchange.exports.content import Content, ExportFormat, comments

# A nanometre and 2e-10 rad, which is a nanometre at five metres.
_DECIMALS = {"m": 9, "mm": 6}
_ROTATION_DECIMALS = dict.fromkeys(("rotation-vector", "quaternion-wxyz", "euler-xyz-rad"), 10)
# By form of poses: what starts a comment, empty where nothing does, and the pose's numbers.
_LANGUAGES: Mapping[str, tuple[str, str]] = {
    # Universal Robots, script manual.
    "ur": ("#", "p[{}, {}, {}, {}, {}, {}]"),
    # KRL's FRAME (KUKA, system variables).
    "kuka": (";", "{{X {},Y {},Z {},A {},B {},C {}}}"),
    # As an ASCII program (.LS) has them.
    "fanuc": ("", "X = {} mm, Y = {} mm, Z = {} mm,\nW = {} deg, P = {} deg, R = {} deg"),
    # RAPID's `pose`: trans of type pos, rot of type orient (RAPID reference manual).
    "abb": ("!", "[[{},{},{}],[{},{},{},{}]]"),
    "staubli": ("//", "{{{}, {}, {}, {}, {}, {}}}"),
    "doosan": ("#", "posx({}, {}, {}, {}, {}, {})"),
}
# Of all other makers, as Yaskawa's jobs have them.
_NUMBERS = ("", "{},{},{},{},{},{}")


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
# By language: its name, the pattern of a variable's name and the same in words, and the words that
# it reserves. ABB, "RAPID kernel", lexical elements: case is ignored, and tool0, wobj0 and load0
# are the system's own. Universal Robots, script manual: the keywords.
_IDENTIFIERS: Mapping[str, tuple[str, re.Pattern[str], str, frozenset[str]]] = {
    "abb": (
        "RAPID",
        re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}", re.ASCII),
        "a letter first, then letters, digits and _, 32 in all",
        frozenset(_RAPID_WORDS.split()),
    ),
    "ur": (
        "URScript",
        re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII),
        "a letter or _ first, then letters, digits and _",
        frozenset(_URSCRIPT_WORDS.split()),
    ),
}


def _identifier(language: str, name: str) -> str:
    """Returns a name after checking that a variable can have it; raises DataError."""
    title, shape, needed, taken = _IDENTIFIERS[language]
    if shape.fullmatch(name) and not {name, name.lower() if language == "abb" else name} & taken:
        return name
    raise DataError(
        f"{name!r} cannot be a name in {title}: it must have {needed}, and be no word of its own.",
        culprits=[name],
        next_step="Choose another with --child.",
    )


def _write(language: str, statement: str, content: Content) -> str:
    """Writes a statement: {pose}, {child}, {load}, {active} and {number} are filled in."""
    form, (mark, shape) = POSE_FORMS[language], _LANGUAGES.get(language, _NUMBERS)
    pose = write_pose(content.matrix, form)
    decimals = _ROTATION_DECIMALS.get(form.rotation, 8)
    numbers = [fixed(value, _DECIMALS[form.unit]) for value in pose[:3]]
    numbers += [fixed(value, decimals) for value in pose[3:]]
    # A FlexPendant writes this mass into a new tool whose load is still to be given.
    mass, centre = "-1", "0,0,0"
    if content.load is not None:
        mass = fixed(content.load.mass_kg, 6)
        centre = ",".join(fixed(value, 6) for value in content.load.centre_mm)
    text = statement.format(
        pose=shape.format(*numbers),
        child=_identifier(language, content.child) if "{child}" in statement else "",
        # `loaddata`: the centre of mass is in the flange's frame [mm]; its axes and moments of
        # inertia are those of a point mass.
        load=f"[{mass},[{centre}],[1,0,0,0],0,0,0]",
        active="$" if content.number is None else "",
        number="" if content.number is None else f"_DATA[{content.number}]",
    )
    return f"{comments(mark, content.notes) if mark else ''}{text}\n"


# An ASCII program of FANUC as a controller prints its own (CrossArm, docs/fanuc_ls_format.md). It
# cannot assign a constant: a frame goes through a position and a position register (operator's
# manual, "frame instructions"), here the last that a controller has as delivered.
_PROGRAM = """/PROG  SET_{short}{number}
/ATTR
OWNER\t\t= MNEDITOR;
COMMENT\t\t= "visioncal";
PROG_SIZE\t= 0;
FILE_NAME\t= ;
VERSION\t\t= 0;
LINE_COUNT\t= {count};
MEMORY_SIZE\t= 0;
PROTECT\t\t= READ_WRITE;
TCD:  STACK_SIZE\t= 0,
      TASK_PRIORITY\t= 50,
      TIME_SLICE\t= 0,
      BUSY_LAMP_OFF\t= 0,
      ABORT_REQUEST\t= 0,
      PAUSE_REQUEST\t= 0;
DEFAULT_GROUP\t= 1,*,*,*,*;
CONTROL_CODE\t= 00000000 00000000;
/MN
{lines}
/POS
P[1]{{
   GP1:
\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX ={pose[0]}  mm,\tY ={pose[1]}  mm,\tZ ={pose[2]}  mm,
\tW ={pose[3]} deg,\tP ={pose[4]} deg,\tR ={pose[5]} deg
}};
/END
"""


def _write_program(what: str, content: Content) -> str:
    """Writes a program that sets UTOOL[n] or UFRAME[n] when it runs; raises DataError without n."""
    if content.number is None:
        raise DataError(
            f"fanuc-{what.lower()} sets {what}[n] of the controller, and n is not given.",
            culprits=["--number"],
            next_step="Name it with --number: what stands there is overwritten.",
        )
    edge = content.edge
    turn = f" and {edge.sigma_deg:.2g} deg" if content.oriented else ", no rotation"
    words = (
        content.name,
        f"verdict {content.verdict.status}",
        f"sigma {edge.sigma_mm:.2g} mm{turn}",
    )
    # A remark has 32 characters; the first register is padded as a controller does.
    lines = [f"!{line[:31]}" for line in (*words, "PR[100] is overwritten")]
    lines += ["PR[100]=P[1]   ", f"{what}[{content.number}]=PR[100]"]
    pose = [f"{fixed(value, 6):>13}" for value in write_pose(content.matrix, POSE_FORMS["fanuc"])]
    text = _PROGRAM.format(
        short=what[:2],
        number=content.number,
        count=len(lines),
        lines="\n".join(f"{number:>4}:  {line} ;" for number, line in enumerate(lines, 1)),
        pose=pose,
    )
    return text.replace("\n", "\r\n")


def _warn_of_load(content: Content) -> Iterable[str]:
    if content.load is None:
        yield (
            "touches determine no load: the tool's mass is written as -1, ABB's mark of a load "
            "that is still to be given. Give it with --mass-kg and --cog-mm, or run LoadIdentify "
            "before the robot moves with this tool."
        )


# Formats of poses; and those of tools and fixtures: name, beginning with the language, what it
# holds, statement, and description. A tool for Universal Robots (script manual, `set_tcp`) is
# without the name argument of newer controllers, so that older ones read it, too; programs can use
# a variable of type pose like one of PolyScope's features. RAPID reference, data types: `tooldata`
# has robhold, tframe and tload; `wobjdata` robhold, ufprog, ufmec, uframe and oframe: a fixed user
# frame, with the object frame at its origin. KUKA, system variables: an entry of $CONFIG.DAT, or
# the active frame.
_FRAMES = """
ur-tcp  tool  set_tcp({pose})
    a tool for Universal Robots: set_tcp(p[...]) [m, rotation vector in rad]
ur-feature  fixture  global {child} = {pose}
    a fixture for Universal Robots: a pose in a variable [m, rotation vector in rad]
abb-tooldata  tool  PERS tooldata {child}:=[TRUE,{pose},{load}];
    a tool for ABB: PERS tooldata, with --mass-kg and --cog-mm [mm, quaternion w first]
abb-wobjdata  fixture  PERS wobjdata {child}:=[FALSE,TRUE,"",{pose},[[0,0,0],[1,0,0,0]]];
    a fixture for ABB: PERS wobjdata [mm, quaternion w first]
kuka-tool  tool  {active}TOOL{number}={pose}
    a tool for KUKA: $TOOL, or TOOL_DATA[n] with --number n [mm, deg]
kuka-base  fixture  {active}BASE{number}={pose}
    a fixture for KUKA: $BASE, or BASE_DATA[n] with --number n [mm, deg]
"""
ROBOTS = (
    *(
        ExportFormat(
            form.name,
            f"{form.words} [{form.unit}, {ROTATION_FORMS[form.rotation].words}]",
            partial(_write, form.name, "{pose}"),
            has_comments=bool(_LANGUAGES.get(form.name, _NUMBERS)[0]),
        )
        for form in POSE_FORMS.values()
        if form.models
    ),
    *(
        ExportFormat(
            name,
            words,
            partial(_write, name.partition("-")[0], statement),
            takes=frozenset(("number",) * ("{number}" in statement))
            | frozenset(("mass_kg", "cog_mm") * ("{load}" in statement)),
            warn=_warn_of_load if "{load}" in statement else lambda _: (),
            holds="tool" if holds == "tool" else "fixture",
        )
        for name, holds, statement, words in (
            re.split(r"\s{2,}", entry) for entry in re.split(r"\n(?! )", _FRAMES.strip())
        )
    ),
    ExportFormat(
        "fanuc-utool",
        "a tool for FANUC: a program that sets UTOOL[n], --number n [mm, deg]",
        partial(_write_program, "UTOOL"),
        frozenset({"number"}),
        holds="tool",
    ),
    ExportFormat(
        "fanuc-uframe",
        "a fixture for FANUC: a program that sets UFRAME[n], --number n [mm, deg]",
        partial(_write_program, "UFRAME"),
        frozenset({"number"}),
        holds="fixture",
    ),
)
