"""The options of `visioncal convert`, as types of its parameters."""

from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import typer

from visioncal.core.conventions import POSE_FORMS, UNITS_M
from visioncal.core.errors import DataError
from visioncal.core.types import CameraMount
from visioncal.interchange.formats import FOREIGN_FORMATS

_POSES = "The poses of somebody else's recording"
_CAMERA = "Its camera"
_OTHER = "The recording itself"
_DOUBT = "Poses that may be misread, of a session as well"

_FORMS = f"{', '.join(POSE_FORMS)}, or a rotation such as euler-ZYX-deg, quaternion-wxyz"
_UNITS = "|".join(UNITS_M)
_FORMATS = ", ".join(it.name for it in FOREIGN_FORMATS)


def _option(*names: str, panel: str, words: str, metavar: str | None = None) -> object:
    return typer.Option(
        *names, help=words, rich_help_panel=panel, show_default=False, metavar=metavar
    )


Source: TypeAlias = Annotated[
    Path,
    typer.Argument(help="A session's folder, its .rrd, or somebody else's file or folder."),
]
Dest: TypeAlias = Annotated[Path, typer.Argument(help="An .rrd, or the folder to write.")]
Force: TypeAlias = Annotated[
    bool, typer.Option("--force", help="Replace a file that is there; never a folder.")
]

Form: TypeAlias = Annotated[
    str | None, _option("--from", panel=_OTHER, words=f"Its format, by name: {_FORMATS}.")
]
MountOption: TypeAlias = Annotated[
    CameraMount | None, _option("--mount", panel=_OTHER, words="Where the camera is.")
]
Target: TypeAlias = Annotated[
    str | None,
    _option(
        "--target",
        panel=_OTHER,
        words="A name in targets/, a .toml, or in one word as checkerboard_9x6_23.6mm, "
        "charuco_5x7_36.2mm_18.3mm_DICT_6X6_250, marker_DICT_4X4_50_10_48mm.",
    ),
]
RobotModel: TypeAlias = Annotated[
    str | None,
    _option(
        "--robot-model", panel=_OTHER, words="A built-in robot, or the path of a .urdf or .toml."
    ),
]
Tip: TypeAlias = Annotated[
    str | None, _option("--tip", panel=_OTHER, words="The frame that the poses are of.")
]

RobotColumns: TypeAlias = Annotated[
    str | None,
    _option(
        "--robot-columns",
        "--robot-key",
        panel=_POSES,
        words="Columns or keys of the robot's poses, position first: X,Y,Z,A,B,C or O_T_EE.",
    ),
]
RobotForm: TypeAlias = Annotated[
    str | None, _option("--robot-form", panel=_POSES, words=f"How they are written: {_FORMS}.")
]
RobotUnit: TypeAlias = Annotated[
    str | None, _option("--robot-unit", panel=_POSES, metavar=_UNITS, words="Of their positions.")
]
RobotInverse: TypeAlias = Annotated[
    bool | None,
    _option(
        "--robot-inverse/--robot-as-is", panel=_POSES, words="They give the base in the flange."
    ),
]
CameraColumns: TypeAlias = Annotated[
    str | None,
    _option(
        "--camera-columns",
        "--camera-key",
        panel=_POSES,
        words="Columns or keys of measured poses of the target: rvec,tvec.",
    ),
]
CameraForm: TypeAlias = Annotated[
    str | None, _option("--camera-form", panel=_POSES, words="As --robot-form.")
]
CameraUnit: TypeAlias = Annotated[
    str | None, _option("--camera-unit", panel=_POSES, metavar=_UNITS, words="Of their positions.")
]
CameraInverse: TypeAlias = Annotated[
    bool | None,
    _option(
        "--camera-inverse/--camera-as-is", panel=_POSES, words="They give the camera in the target."
    ),
]
CameraFile: TypeAlias = Annotated[
    Path | None,
    _option(
        "--camera-file",
        panel=_POSES,
        words="A second file with the camera's poses; with times in both, the clocks' offset is "
        "found.",
    ),
]
JointColumns: TypeAlias = Annotated[
    str | None,
    _option(
        "--joint-columns",
        "--joint-key",
        panel=_POSES,
        words="Columns or keys of the joint angles.",
    ),
]
JointUnit: TypeAlias = Annotated[
    Literal["rad", "deg"],
    typer.Option("--joint-unit", help="What they are in.", rich_help_panel=_POSES),
]

Images: TypeAlias = Annotated[
    Path | None,
    _option(
        "--images",
        panel=_CAMERA,
        words="The folder of the images; matched by name, by number, or in order.",
    ),
]
ImageColumn: TypeAlias = Annotated[
    str | None,
    _option(
        "--image-column",
        "--image-key",
        panel=_CAMERA,
        words="The column or key that names each row's image.",
    ),
]
Intrinsics: TypeAlias = Annotated[
    str | None,
    _option(
        "--intrinsics",
        panel=_CAMERA,
        words="A file (ROS, OpenCV, Kalibr, ViSP, .npz, .json), or `estimate` to ignore those of "
        "the source.",
    ),
]
Resolution: TypeAlias = Annotated[
    str | None,
    _option("--resolution", panel=_CAMERA, words="WIDTH,HEIGHT that the intrinsics hold for."),
]

TryOthers: TypeAlias = Annotated[
    bool, _option("--guess", panel=_DOUBT, words="Try other readings of the poses, and ask.")
]
TakeBest: TypeAlias = Annotated[
    bool, _option("--yes", panel=_DOUBT, words="Take the best one where it stands out clearly.")
]


def names_in(words: str | None, option: str) -> tuple[str, ...]:
    """Splits an option of names with commas between.

    Raises:
        DataError: A name is empty or there twice.
    """
    if words is None:
        return ()
    names = tuple(it.strip() for it in words.split(","))
    if not all(names) or len(set(names)) < len(names):
        raise DataError(
            f"{option} is {words[:80]!r}; names are needed, each once, with commas between.",
            culprits=[option],
        )
    return names
