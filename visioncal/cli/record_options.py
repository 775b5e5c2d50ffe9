"""The options of `visioncal record`, as types of its parameters."""

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from visioncal.core.conventions import POSE_FORMS
from visioncal.core.types import CameraMount
from visioncal.live.capture.options import Keep

_CELL = "The cell, where no plan says it"
_TAKING = "How views are taken"
_MOVING = "How the arm is moved"
_CAMERA = "What the camera is set to"


def _option(
    *names: str, words: str, panel: str | None = None, metavar: str | None = None
) -> object:
    return typer.Option(
        *names, help=words, rich_help_panel=panel, show_default=False, metavar=metavar
    )


Out: TypeAlias = Annotated[
    Path, typer.Option("-o", "--out", metavar="SESSION", help="The session's folder; a new one.")
]
ArmOption: TypeAlias = Annotated[
    str,
    typer.Option(
        "--arm",
        metavar="ur:HOST|manual",
        help="The arm: a UR by its address, or poses that you type from the pendant.",
    ),
]
CameraOption: TypeAlias = Annotated[
    str,
    typer.Option(
        "--camera",
        metavar="oak|uvc:N|uvc:URL|folder:PATH",
        help="The camera: an OAK (oak:SERIAL for one of several), a webcam, a network "
        "camera's stream, or pictures that were taken already.",
    ),
]
PlanOption: TypeAlias = Annotated[
    Path | None, _option("--plan", words="What visioncal plan wrote: a folder, or its plan.json.")
]
Follow: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--follow", help="Move nothing: take a view whenever the arm, guided by hand, rests."
    ),
]
Views: TypeAlias = Annotated[
    int,
    typer.Option(
        "--views",
        min=0,
        help="With --follow or a manual arm: end after so many.",
        show_default=False,
    ),
]
Resume: TypeAlias = Annotated[
    bool, typer.Option("--resume", help="Go on with a recording that was ended or cut off.")
]
DryRun: TypeAlias = Annotated[
    bool, typer.Option("--dry-run", help="Only say what would be driven; nothing moves.")
]
Yes: TypeAlias = Annotated[bool, typer.Option("--yes", help="Begin to move without asking.")]
View: TypeAlias = Annotated[
    bool, typer.Option("--view", help="Show it in the rerun viewer as it goes.")
]
AsJson: TypeAlias = Annotated[
    bool, typer.Option("--json", help="Print a summary to stdout at the end.")
]

TargetOption: TypeAlias = Annotated[
    str | None,
    _option(
        "--target",
        panel=_CELL,
        words="The board: a name in targets/, a .toml, or in one word as checkerboard_9x6_23.6mm.",
    ),
]
RobotOption: TypeAlias = Annotated[
    str | None,
    _option("--robot", panel=_CELL, words="The robot's model: a built-in name, a .urdf or .toml."),
]
MountOption: TypeAlias = Annotated[
    CameraMount | None,
    _option("--mount", panel=_CELL, words="Where the camera is; eye-in-hand if nothing is said."),
]
PoseForm: TypeAlias = Annotated[
    str | None,
    _option(
        "--pose-form",
        panel=_CELL,
        metavar="|".join(("ours", *POSE_FORMS)),
        words="With a manual arm: how poses are typed.",
    ),
]

Frames: TypeAlias = Annotated[
    int,
    typer.Option("--frames", min=1, max=100, help="Frames a view.", rich_help_panel=_TAKING),
]
KeepOption: TypeAlias = Annotated[
    Keep,
    typer.Option("--keep", help="The sharpest of these, or their mean.", rich_help_panel=_TAKING),
]
StillPx: TypeAlias = Annotated[
    float,
    typer.Option(
        "--still-px",
        min=0.01,
        max=10.0,
        help="Image motion over which nothing is taken.",
        rich_help_panel=_TAKING,
    ),
]
SettleS: TypeAlias = Annotated[
    float,
    typer.Option(
        "--settle-s",
        min=0.0,
        max=30.0,
        help="How long arm and image must have been still before.",
        rich_help_panel=_TAKING,
    ),
]

Speed: TypeAlias = Annotated[
    float,
    typer.Option(
        "--speed", help="Of the fastest joint, in rad/s; at most 1.5.", rich_help_panel=_MOVING
    ),
]

Resolution: TypeAlias = Annotated[
    str | None,
    _option("--resolution", panel=_CAMERA, metavar="W,H", words="Size of the images in pixels."),
]
ExposureUs: TypeAlias = Annotated[
    int | None, _option("--exposure-us", panel=_CAMERA, words="Exposure time in microseconds.")
]
Gain: TypeAlias = Annotated[
    int | None, _option("--gain", panel=_CAMERA, words="ISO, or the device's own unit.")
]
Focus: TypeAlias = Annotated[
    int | None, _option("--focus", panel=_CAMERA, words="Lens position, in the device's own unit.")
]
