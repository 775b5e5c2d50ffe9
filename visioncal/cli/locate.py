"""`visioncal locate`."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from visioncal.cli.console import check_usable, print_json, say, warn
from visioncal.cli.options import AsJson, CameraName, ForceBad, RobotName
from visioncal.cli.parsing import FORMS, named_result, numbers_in, plane_of, refuse_given
from visioncal.cli.progress import shown_progress
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure, some_of

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.core.types import FloatArray, Target
    from visioncal.frames.located import Located
    from visioncal.results import Calibration, Edge
    from visioncal.session import Session, View

_POSE = "x,y,z,qx,qy,qz,qw"
# Rounding to four digits keeps a unit quaternion's norm within this of 1.
_NORM_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class _Point:
    """One located point, with its label in words and in JSON."""

    words: str
    document: Mapping[str, Any]
    located: "Located"


def locate_command(
    source: Annotated[
        Path | None,
        typer.Argument(
            help="A session, or one image (png, jpg, tif, bmp, webp); may be left out with --pixel."
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            "-c", "--calibration", help="The camera's: an output folder of calibrate, or its .rrd."
        ),
    ] = None,
    pixel: Annotated[
        list[str] | None,
        typer.Option(
            metavar="U,V", help="A feature, in the image as it was taken; several may be given."
        ),
    ] = None,
    plane: Annotated[str | None, typer.Option(help=f"Plane of the features: {FORMS}.")] = None,
    plane_sigma: Annotated[
        float | None, typer.Option("--plane-sigma-mm", help="Sigma of the plane's height, in mm.")
    ] = None,
    point: Annotated[
        str | None,
        typer.Option(
            "--point-mm", metavar="X,Y,Z", help="A point of the target, instead of its origin."
        ),
    ] = None,
    target: Annotated[
        str | None,
        typer.Option(
            help="What to look for, instead of the session's own: a name in targets/, a .toml, or "
            "in one word as marker_DICT_4X4_50_10_48mm; or one of a whole cell's, as floor."
        ),
    ] = None,
    camera: CameraName = None,
    robot: RobotName = None,
    view: Annotated[
        int | None,
        typer.Option(help="Which of the session's views; else all that show the target."),
    ] = None,
    pose: Annotated[
        str | None,
        typer.Option(
            metavar=_POSE.upper(),
            help="Pose of the flange at the image, in metres, for a camera on the flange.",
        ),
    ] = None,
    sigma_px: Annotated[
        float | None,
        typer.Option(
            help="Noise of a feature's coordinate; else that of the calibration's corners."
        ),
    ] = None,
    force: ForceBad = False,
    as_json: AsJson = False,
) -> None:
    """Locate what an image shows in the robot's base, with its uncertainty.

    It is a target, or a pixel whose plane is known. Exit status 2: there is no place, for the
    reason given; 3: there is none, as the calibration's verdict is bad.
    """
    import numpy as np

    from visioncal.frames.camera_chain import CalibratedCamera
    from visioncal.frames.target_in_image import check_image_size
    from visioncal.interchange.result_files import load_result
    from visioncal.results.selecting import targets_fixed_to_base
    from visioncal.session.selecting import EYE, Choice, has_several, select
    from visioncal.vision.finders.imaging import read_image

    result = load_result(named_result(calibration, "-c", "locate: the camera's calibration"))
    session = _session(source)
    several = session is not None and has_several(session)
    if session is not None and several:
        is_own_target = target in session.plates
        session = select(
            session, Choice(camera, robot, target if is_own_target else None), robot_between=False
        )
        target = None if is_own_target else target
    # Names may be those of the session alone.
    is_session_name = several and result.cell is None
    calibrated = result if is_session_name else result.chosen(Choice(camera, robot), EYE)
    # With --force, every place has the warning.
    check_usable(calibrated.verdict, "the calibration", force=force)
    if session is not None:
        refuse_given({"--pose": pose}, "the session has the poses of its views")
    else:
        refuse_given({"--view": view}, "only a session has views")
    flange, joints_rad = None if pose is None else _flange(pose), None
    if pixel:
        refuse_given({"--point-mm": point, "--target": target}, "a pixel is placed by its plane")
        if session is not None:
            flange, joints_rad = _flange_of(session, _chosen(session, view), calibrated)
        elif source is not None:
            check_image_size(CalibratedCamera.of(calibrated), read_image(source), source.name)
        boards = targets_fixed_to_base(result, Choice(camera, robot), EYE)
        points = _by_plane(
            calibrated, boards, pixel, plane, plane_sigma or 0.0, flange, joints_rad, sigma_px
        )
    else:
        refuse_given({"--plane": plane, "--plane-sigma-mm": plane_sigma}, "it is for --pixel")
        origin_m = 1e-3 * np.array(numbers_in(point or "0,0,0", "--point-mm", "x,y,z"))
        other_target = None if target is None else _target(target, result)
        if session is not None:
            views = _chosen(session, view)
            if other_target is not None and any(other.has_corners for other in views):
                raise DataError(
                    f"--target: session {session.name!r} has corners of its own target "
                    "(corners.csv), and no image is searched.",
                    culprits=["--target"],
                    next_step="Leave it out, or name one image.",
                )
            session = session if other_target is None else replace(session, target=other_target)
            points = _by_views(session, views, calibrated, origin_m, sigma_px, quiet=as_json)
        else:
            points = _by_image(source, calibrated, other_target, origin_m, flange, sigma_px)
    _report(points, as_json=as_json)


def _session(source: Path | None) -> "Session | None":
    """The session; None where the source is none."""
    from visioncal.session import Session

    if source is None or not (source.is_dir() or source.suffix.lower() == ".rrd"):
        return None
    return Session.load(source)


def _chosen(session: "Session", view: int | None) -> "tuple[View, ...]":
    """The chosen view, or all."""
    chosen = tuple(other for other in session.views if view in (None, other.number))
    if not chosen:
        numbers = some_of([str(other.number) for other in session.views], 20)
        raise DataError(
            f"--view {view}: session {session.name!r} has no such view; it has {numbers}.",
            culprits=["--view"],
            next_step="The numbers are those of the column view.",
        )
    return chosen


def _flange(words: str) -> "FloatArray":
    """Reads a pose of the robot, (4, 4) `base_from_flange` [m]."""
    import numpy as np
    from scipy.spatial.transform import RigidTransform, Rotation

    values = numbers_in(words, "--pose", _POSE)
    norm = float(np.linalg.norm(values[3:]))
    if abs(norm - 1.0) > _NORM_TOLERANCE:
        raise DataError(
            f"--pose: the quaternion's norm is {norm:.6g}, but must be 1 to within "
            f"{_NORM_TOLERANCE:g}.",
            culprits=["--pose"],
            next_step=f"Give {_POSE}: metres, and a unit quaternion.",
        )
    turn = Rotation.from_quat(values[3:])
    return np.asarray(RigidTransform.from_components(values[:3], turn).as_matrix())


def _flange_of(
    session: "Session", views: "Sequence[View]", calibration: "Calibration"
) -> "tuple[FloatArray | None, FloatArray | None]":
    """Flange pose and joint angles of a calibrated arm at the one chosen view.

    A stationary camera needs neither.
    """
    from visioncal.frames.session_observations import calibrated_joints, pose_of
    from visioncal.results.picking import check_mount

    check_mount(session, calibration)
    if calibration.mount == "eye-to-hand":
        return None, None
    if len(views) > 1:
        raise DataError(
            f"session {session.name!r} has {len(views)} views, and a camera on the flange "
            "stands elsewhere in each: --view is needed.",
            culprits=["--view"],
            next_step="Say which of them the pixel is of.",
        )
    (view,) = views
    flange = pose_of(session, view, calibration)
    if flange is None:
        raise DataError(
            f"view {view.number} of session {session.name!r} has no pose of the robot.",
            culprits=[f"view {view.number}"],
            next_step="Fill in x_m to qw, or joint angles and [robot] model.",
        )
    return flange, calibrated_joints(view, calibration)


def _by_plane(
    calibration: "Calibration",
    boards: "Mapping[str, Edge]",
    pixels: Sequence[str],
    plane: str | None,
    sigma_mm: float,
    flange: "FloatArray | None",
    joints_rad: "FloatArray | None",
    sigma_px: float | None,
) -> tuple[_Point, ...]:
    import numpy as np

    from visioncal.frames.locate import locate

    if plane is None:
        raise DataError(
            "One image shows no depth: the plane (--plane) that the feature lies in is needed.",
            culprits=["--plane"],
            next_step=f"It is {FORMS}.",
        )
    px = np.array([numbers_in(pixel, "--pixel", "u,v") for pixel in pixels])
    declared, note = plane_of(plane, sigma_mm, calibration, boards)
    places = locate(calibration, px, declared, flange, joints_rad=joints_rad, sigma_px=sigma_px)
    return tuple(
        _Point(
            f"pixel ({u:g}, {v:g})",
            {"pixel": [u, v]},
            replace(place, warnings=(*place.warnings, note)) if note else place,
        )
        for (u, v), place in zip(px.tolist(), places, strict=True)
    )


def _by_views(
    session: "Session",
    views: "Sequence[View]",
    calibration: "Calibration",
    point_m: "FloatArray",
    sigma_px: float | None,
    *,
    quiet: bool,
) -> tuple[_Point, ...]:
    # Imported late, as a pixel is placed in a millisecond without it.
    from visioncal.calibration.stages.observed import by_reason
    from visioncal.frames.picks import locate_views

    with shown_progress(quiet=quiet) as progress:
        picks = locate_views(
            session, calibration, point_m, among=views, sigma_px=sigma_px, progress=progress
        )
    for words in (*by_reason(picks.lost), *picks.warnings):
        say(words)
    return tuple(
        _Point(f"view {view}", {"view": view}, located) for view, located in picks.found.items()
    )


def _by_image(
    source: Path | None,
    calibration: "Calibration",
    target: "Target | None",
    point_m: "FloatArray",
    flange: "FloatArray | None",
    sigma_px: float | None,
) -> tuple[_Point, ...]:
    from visioncal.frames.locate import locate_target
    from visioncal.vision.finders.imaging import read_image

    if source is None:
        raise DataError(
            "locate: there is nothing to look for: a session, an image or a pixel is needed.",
            next_step="Name a session or an image; or give --pixel U,V and --plane.",
        )
    if target is None:
        raise DataError(
            f"{source} is one image, which does not say what to look for: --target is needed.",
            culprits=["--target"],
            next_step="Name the target; or give --pixel U,V and --plane.",
        )
    image, name = read_image(source), source.name
    located = locate_target(
        calibration, image, target, flange, point_m, sigma_px=sigma_px, label=name
    )
    return (_Point(name, {"image": name}, located),)


def _target(words: str, result: "Calibration") -> "Target":
    from visioncal.vision.targets import target_from_document

    if result.cell is not None and words in result.cell.targets:
        return target_from_document(result.cell.targets[words], words)
    from visioncal.interchange.formats.boards import target_named

    return target_named(words, Path(words).stem)


def _report(points: Sequence[_Point], *, as_json: bool) -> None:
    if as_json:
        print_json([_document(point) for point in points])
        return
    for point in points:
        typer.echo(f"{point.words}: {_line(point.located)}")
        for warning in point.located.warnings:
            warn(warning if warning.startswith(point.words) else f"{point.words}: {warning}")


def _line(located: "Located") -> str:
    place = ", ".join(f"{value:.2f}" for value in 1e3 * located.p_base)
    sigmas = ", ".join(figure(float(value)) for value in located.sigma_mm)
    largest_mm = figure(located.budget_mm[located.largest])
    return (
        f"({place}) mm, sigma ({sigmas}) mm, 95 % within {figure(located.radius95_mm)} mm; "
        f"largest source: {located.largest}, {largest_mm} mm"
    )


def _document(point: _Point) -> dict[str, Any]:
    located = point.located
    return {
        **point.document,
        "p_base_m": located.p_base.tolist(),
        "covariance": located.covariance.tolist(),
        "sigma_mm": located.sigma_mm.tolist(),
        "radius95_mm": located.radius95_mm,
        "budget_mm": dict(located.budget_mm),
        "warnings": list(located.warnings),
    }
