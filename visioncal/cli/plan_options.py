"""The options of `visioncal plan`, as types of its parameters."""

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from visioncal.core.types import Mount
from visioncal.live.planning.purposes import PURPOSES
from visioncal.live.planning.selection import Criterion

_WHAT = "What is planned"
_CELL = "The cell, where the source does not say it"
_LIMITS = "What the arm must keep"
_DOUBT = "How well it is known"
_USUAL_STOPS = ", ".join(f"{it.stops} for {it.name}" for it in PURPOSES.values())


def _option(*names: str, panel: str, words: str, metavar: str | None = None) -> object:
    return typer.Option(
        *names, help=words, rich_help_panel=panel, show_default=False, metavar=metavar
    )


Source: TypeAlias = Annotated[
    str,
    typer.Argument(
        help="A robot (a built-in name, a .urdf or .toml), a session, or an output folder of "
        "calibrate.",
    ),
]
Out: TypeAlias = Annotated[
    Path, typer.Option("-o", "--out", help="Folder for table, program and preview.")
]
AsJson: TypeAlias = Annotated[bool, typer.Option("--json", help="Print plan.json to stdout.")]

For: TypeAlias = Annotated[
    str,
    typer.Option(
        "--for", metavar="|".join(PURPOSES), help="What they are for.", rich_help_panel=_WHAT
    ),
]
Stops: TypeAlias = Annotated[
    int | None,
    typer.Option(
        "--stops",
        min=1,
        max=500,
        help=f"How many stops: {_USUAL_STOPS}.",
        rich_help_panel=_WHAT,
        show_default=False,
    ),
]
Add: TypeAlias = Annotated[
    int | None,
    typer.Option(
        "--add",
        min=1,
        max=500,
        help="How many stops to add to a recorded session, which counts.",
        rich_help_panel=_WHAT,
        show_default=False,
    ),
]
CriterionOption: TypeAlias = Annotated[
    Criterion,
    typer.Option(
        "--criterion",
        help="I: mean variance of the places that count; D, A, E: of the unknowns; O1: of the "
        "Jacobian.",
        rich_help_panel=_WHAT,
    ),
]
WishMm: TypeAlias = Annotated[
    float | None,
    _option("--wish-mm", panel=_WHAT, words="Fewer stops where they predict this sigma, in mm."),
]
WishDeg: TypeAlias = Annotated[
    float | None, _option("--wish-deg", panel=_WHAT, words="The same of the rotation, in degrees.")
]
Workspace: TypeAlias = Annotated[
    str | None,
    _option(
        "--workspace",
        panel=_WHAT,
        metavar="X,Y,Z:SX,SY,SZ",
        words="Where the arm's place counts: a box by its centre in the base and its lengths, in "
        "mm; else all of its reach.",
    ),
]
StartJoints: TypeAlias = Annotated[
    str | None,
    _option(
        "--start-joints",
        panel=_WHAT,
        metavar="Q1,Q2,...",
        words="Where the arm stands now, in radians; else the way to the first stop is not looked "
        "at.",
    ),
]
CandidatesOption: TypeAlias = Annotated[
    int,
    typer.Option(
        "--candidates",
        min=12,
        max=20000,
        help="From how many possible stops they are chosen.",
        rich_help_panel=_WHAT,
    ),
]
Seed: TypeAlias = Annotated[
    int,
    typer.Option(
        "--seed", min=0, help="Other possible stops for every number.", rich_help_panel=_WHAT
    ),
]

RobotOption: TypeAlias = Annotated[
    str | None,
    _option("--robot", panel=_CELL, words="The robot, where a session names none."),
]
TargetOption: TypeAlias = Annotated[
    str | None,
    _option(
        "--target",
        panel=_CELL,
        words="The board: a name in targets/, a .toml, or in one word as checkerboard_9x6_23.6mm.",
    ),
]
CameraOption: TypeAlias = Annotated[
    str | None,
    _option(
        "--camera",
        panel=_CELL,
        metavar="FX,FY,CX,CY | FILE",
        words="The lens: four numbers in pixels, a file of intrinsics, or an earlier calibration.",
    ),
]
Resolution: TypeAlias = Annotated[
    str | None,
    _option("--resolution", panel=_CELL, metavar="W,H", words="Size of the images in pixels."),
]
MountOption: TypeAlias = Annotated[
    Mount | None, _option("--mount", panel=_CELL, words="Where the camera is.")
]
CamOption: TypeAlias = Annotated[
    str | None,
    _option(
        "--cam",
        panel=_CELL,
        metavar="'X Y Z RX RY RZ'",
        words="Rough place of the camera on the flange (or in the base), in mm and degrees: turned "
        "about the fixed axes x, then y, then z. It looks along its z.",
    ),
]
BoardOption: TypeAlias = Annotated[
    str | None,
    _option(
        "--board",
        panel=_CELL,
        metavar="'X Y Z RX RY RZ'",
        words="Rough place of the board in the base (or on the flange), in the same form. Its z "
        "points into the paper: face up is '... 180 0 0'.",
    ),
]

GuessMm: TypeAlias = Annotated[
    float,
    typer.Option(
        "--guess-mm",
        min=0.1,
        max=500.0,
        help="How well both places are known, per axis.",
        rich_help_panel=_DOUBT,
    ),
]
GuessDeg: TypeAlias = Annotated[
    float,
    typer.Option(
        "--guess-deg",
        min=0.01,
        max=45.0,
        help="The same of their rotations.",
        rich_help_panel=_DOUBT,
    ),
]
NoisePx: TypeAlias = Annotated[
    float | None,
    _option(
        "--noise-px", panel=_DOUBT, words="Of a corner in the image; else 0.1, or as recorded."
    ),
]
NoiseMm: TypeAlias = Annotated[
    float | None,
    _option(
        "--noise-mm",
        panel=_DOUBT,
        words="Of the robot at a stop, per axis; else 0.03, or as recorded.",
    ),
]
NoiseDeg: TypeAlias = Annotated[
    float | None,
    _option(
        "--noise-deg", panel=_DOUBT, words="The same of its rotation; else 0.003, or as recorded."
    ),
]

BoxOption: TypeAlias = Annotated[
    list[str] | None,
    _option(
        "--box",
        panel=_LIMITS,
        metavar="NAME:X,Y,Z:SX,SY,SZ",
        words="Something in the way, by its centre in the base and its lengths, in mm; as often as "
        "needed.",
    ),
]
Floor: TypeAlias = Annotated[
    str,
    typer.Option(
        "--floor",
        metavar="Z|none",
        help="Height of the floor or table in the base, in mm.",
        rich_help_panel=_LIMITS,
    ),
]
Clearance: TypeAlias = Annotated[
    float,
    typer.Option(
        "--clearance-mm",
        min=0.0,
        max=1000.0,
        help="Of the arm from floor, board, boxes and itself.",
        rich_help_panel=_LIMITS,
    ),
]
Margin: TypeAlias = Annotated[
    float,
    typer.Option(
        "--margin-deg",
        min=0.0,
        max=90.0,
        help="Of the joints from their limits.",
        rich_help_panel=_LIMITS,
    ),
]
Tilt: TypeAlias = Annotated[
    float,
    typer.Option(
        "--tilt-deg",
        min=5.0,
        max=80.0,
        help="Most between the line of sight and the board's normal.",
        rich_help_panel=_LIMITS,
    ),
]
Edge: TypeAlias = Annotated[
    float,
    typer.Option(
        "--edge-px",
        min=0.0,
        max=10000.0,
        help="Of the board from the image's edge.",
        rich_help_panel=_LIMITS,
    ),
]
Distance: TypeAlias = Annotated[
    str | None,
    _option(
        "--distance-mm",
        panel=_LIMITS,
        metavar="NEAR,FAR",
        words="Of the camera from the board; else as the board fills the image.",
    ),
]
Focus: TypeAlias = Annotated[
    str | None,
    _option(
        "--focus-mm", panel=_LIMITS, metavar="NEAR,FAR", words="Depths at which images are sharp."
    ),
]
