"""FANUC tools and fixtures: an ASCII program (.LS) that sets UTOOL or UFRAME when it runs.

A program cannot assign a constant frame. It stores it as a position, and copies that through a
position register (FANUC operator's manual, "frame instructions": UTOOL[i]=PR[j], UFRAME[i]=PR[j]).
The listing's layout is that of a controller's own printout (CrossArm, docs/fanuc_ls_format.md and
tests/fixtures/probes/maketp: loaded, run and printed by ROBOGUIDE).
"""

from functools import partial
from typing import Literal

from visioncal.core.conventions import POSE_FORMS, write_pose
from visioncal.core.errors import DataError
from visioncal.core.number_format import fixed
from visioncal.interchange.exports.content import Content, ExportFormat

# The last position register of a controller in its delivered state.
REGISTER = 100
# A nanometre and 2e-8 rad. A controller prints three decimals, but loads more.
_DECIMALS = 6
_REMARK_SIZE = 32
_NEWLINE = "\r\n"

_ATTRIBUTES = (
    "OWNER\t\t= MNEDITOR;",
    'COMMENT\t\t= "visioncal";',
    "PROG_SIZE\t= 0;",
    "FILE_NAME\t= ;",
    "VERSION\t\t= 0;",
    "LINE_COUNT\t= {count};",
    "MEMORY_SIZE\t= 0;",
    "PROTECT\t\t= READ_WRITE;",
    "TCD:  STACK_SIZE\t= 0,",
    "      TASK_PRIORITY\t= 50,",
    "      TIME_SLICE\t= 0,",
    "      BUSY_LAMP_OFF\t= 0,",
    "      ABORT_REQUEST\t= 0,",
    "      PAUSE_REQUEST\t= 0;",
    "DEFAULT_GROUP\t= 1,*,*,*,*;",
    "CONTROL_CODE\t= 00000000 00000000;",
)


def _write(what: Literal["UTOOL", "UFRAME"], content: Content) -> str:
    """Writes the program; its remarks state what it sets and overwrites."""
    if content.number is None:
        raise DataError(
            f"fanuc-{what.lower()} sets {what}[n] of the controller, and n is not said.",
            next_step="Name it with --number: what stands there is overwritten.",
        )
    instructions = [
        *_remarks(content),
        f"!PR[{REGISTER}] is overwritten",
        # A controller pads the first of them, but not the second.
        f"PR[{REGISTER}]=P[1]   ",
        f"{what}[{content.number}]=PR[{REGISTER}]",
    ]
    lines = [
        f"/PROG  {_program_name(what, content.number)}",
        "/ATTR",
        *(attribute.format(count=len(instructions)) for attribute in _ATTRIBUTES),
        "/MN",
        *(f"{number:>4}:  {instruction} ;" for number, instruction in enumerate(instructions, 1)),
        "/POS",
        *_position(content),
        "/END",
    ]
    return _NEWLINE.join(lines) + _NEWLINE


def _program_name(what: Literal["UTOOL", "UFRAME"], number: int) -> str:
    """Name of the program and its file: 8 characters are safe everywhere."""
    return f"SET_{what[:2]}{number}"


def _remarks(content: Content) -> list[str]:
    edge, measured = content.edge, content.rotation_of is None
    parts = [
        f"visioncal {content.name}",
        f"verdict {content.verdict.status}",
        f"sigma {edge.sigma_mm:.2g} mm" + (f" and {edge.sigma_deg:.2g} deg" if measured else ""),
        *([] if measured else ["rotation not measured"]),
    ]
    return [f"!{part[: _REMARK_SIZE - 1]}" for part in parts]


def _position(content: Content) -> list[str]:
    pose = [fixed(value, _DECIMALS) for value in write_pose(content.matrix, POSE_FORMS["fanuc"])]
    x, y, z, w, p, r = (f"{name:>13}" for name in pose)
    return [
        "P[1]{",
        "   GP1:",
        "\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',",
        f"\tX ={x}  mm,\tY ={y}  mm,\tZ ={z}  mm,",
        f"\tW ={w} deg,\tP ={p} deg,\tR ={r} deg",
        "};",
    ]


PROGRAMS = (
    ExportFormat(
        "fanuc-utool",
        "a tool for FANUC: a program that sets UTOOL[n], --number n [mm, deg]",
        partial(_write, "UTOOL"),
        holds="tool",
        takes=frozenset({"number"}),
        counterpart="fanuc-uframe",
    ),
    ExportFormat(
        "fanuc-uframe",
        "a fixture for FANUC: a program that sets UFRAME[n], --number n [mm, deg]",
        partial(_write, "UFRAME"),
        holds="fixture",
        takes=frozenset({"number"}),
        counterpart="fanuc-utool",
    ),
)
