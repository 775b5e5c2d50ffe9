"""`visioncal locate`."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import typer

from visioncal.cli.console import check_usable, print_json, say, warn
from visioncal.cli.frame_options import LocateOptions
from visioncal.cli.progress import shown_progress
from visioncal.core.conventions import PoseForm, controller_form, stated_pose
from visioncal.core.documents.pendants import is_marked_pose, read_pose
from visioncal.core.errors import DataError
from visioncal.core.files import MOST_IMAGE_BYTES, check_own, read_bytes, write_atomically
from visioncal.core.number_format import did_you_mean, figure, some_of
from visioncal.core.parsing import FORMS, POSE, numbers_in, refuse_given
from visioncal.core.types import FloatArray, Mount, Target
from visioncal.frames.camera_chain import CalibratedCamera, Plane
from visioncal.frames.locate import (
    cloud_in_base,
    locate,
    locate_by_depth,
    locate_target,
    seen_distances,
)
from visioncal.frames.located import Located
from visioncal.interchange.result_files import load_result
from visioncal.results import Calibration, Edge
from visioncal.results.picking import check_mount
from visioncal.results.selecting import targets_fixed_to_base
from visioncal.session import Session, View
from visioncal.session.selecting import EYE, Choice, has_several, select
from visioncal.vision.boards.imaging import read_image
from visioncal.vision.boards.picture import with_weights
from visioncal.vision.hard_matches import check_weights
from visioncal.vision.targets import target_from_document

_LEAD = "base_from_"


# A located point, with its label in words and in JSON.
_Point: TypeAlias = tuple[str, Mapping[str, Any], Located]


def locate_command(options: LocateOptions) -> None:
    """Runs `visioncal locate`."""
    result = load_result(options.calibration)
    source, target, choice = options.source, options.target, Choice(options.camera, options.robot)
    session, several = None, False
    if source is not None and (source.is_dir() or source.suffix.lower() == ".rrd"):
        session = Session.load(source)
        several = has_several(session)
    if session is not None and several:
        session_target = target if target in session.plates else None
        session = select(session, replace(choice, target=session_target), robot_between=False)
        target = None if session_target else target
    # Names may be those of the session alone.
    is_session_name = several and result.cell is None
    calibrated = result if is_session_name else result.chosen(choice, EYE)
    # With --force, every place has the warning.
    check_usable(calibrated.verdict, "the calibration", force=options.force)
    if session is not None:
        refuse_given({"--pose": options.pose}, "the session has the poses of its views")
    else:
        refuse_given({"--view": options.view}, "only a session has views")
    form = controller_form("", options.robot_form) or calibrated.controller()
    flange, joints_rad = _flange(options.pose, form, calibrated.mount), None
    if options.pixel or options.cloud is not None:
        if session is not None:
            flange, joints_rad = _flange_of(session, _chosen(session, options.view), calibrated)
        if options.cloud is not None:
            _write_cloud(options, options.cloud, calibrated, flange, joints_rad)
            return
        boards = targets_fixed_to_base(result, choice, EYE)
        points = _by_pixels(options, session, calibrated, boards, (flange, joints_rad))
    else:
        needless = {"--plane": options.plane, "--plane-sigma-mm": options.plane_sigma}
        refuse_given(needless, "it is for --pixel")
        origin_m = np.array(options.point or np.zeros(3))
        if session is None and source is not None and target is None:
            target = _only_target(result, source.name)
        other_target = None if target is None else _target(target, result)
        check_weights(options.weights)
        if options.weights is not None:
            session = session and session.with_weights(options.weights)
            other_target = other_target and with_weights(other_target, options.weights)
        if session is not None:
            points = _by_views(options, session, calibrated, other_target, origin_m)
        else:
            points = _by_image(options, calibrated, other_target, origin_m, flange)
    _report(points, as_json=options.as_json)


def _by_pixels(
    options: LocateOptions,
    session: Session | None,
    calibrated: Calibration,
    boards: Mapping[str, Edge],
    state: tuple[FloatArray | None, FloatArray | None],
) -> list[_Point]:
    """Pixels on a plane or at their depth, with the flange's pose and the joints."""
    given = {"--point-mm": options.point, "--target": options.target}
    refuse_given(given, "a pixel is placed by its plane or its depth")
    if session is None and options.source is not None:
        from visioncal.frames.target_in_image import check_image_size

        image = read_image(options.source)
        check_image_size(CalibratedCamera.of(calibrated), image, options.source.name)
    px, sigma_px, (flange, joints_rad) = np.array(options.pixel), options.sigma_px, state
    measured = _measured(options, session, calibrated, px)
    if measured is not None:
        places = locate_by_depth(
            calibrated, px, measured, flange, joints_rad=joints_rad, sigma_px=sigma_px
        )
    elif options.plane is not None:
        plane, note = _plane_of(options.plane, options.plane_sigma or 0.0, calibrated, boards)
        places = locate(calibrated, px, plane, flange, joints_rad=joints_rad, sigma_px=sigma_px)
        if note:
            places = tuple(replace(at, warnings=(*at.warnings, note)) for at in places)
    else:
        no_pose = flange is None and calibrated.mount == "eye-in-hand"
        also = ", and the flange's pose at the image (--pose)" if no_pose else ""
        raise DataError(
            "One image shows no depth: name the plane (--plane) that the feature lies in, or "
            f"its depth (--depth){also}.",
            culprits=["--plane", *["--pose"] * no_pose],
            next_step=f"A plane is {FORMS}. visioncal locate --example prints a line that works.",
        )
    return [
        (f"pixel ({u:g}, {v:g})", {"pixel": [u, v]}, place)
        for (u, v), place in zip(px.tolist(), places, strict=True)
    ]


def _measured(
    options: LocateOptions, session: Session | None, calibration: Calibration, px: FloatArray
) -> FloatArray | None:
    """(n,) depth at (n, 2) pixels, of the file or the view; None where a plane is given instead."""
    camera, file = CalibratedCamera.of(calibration).camera, options.depth
    if options.plane is not None:
        refuse_given({"--depth": file}, "the plane says how far the pixels are")
        return None
    # Imported late, like all that few picks need.
    from visioncal.session.depth import read_depth

    if file is not None:
        data, name = read_bytes(file, MOST_IMAGE_BYTES), file.name
    else:
        views = () if session is None else _chosen(session, options.view)
        if session is None or not views[0].depth:
            return None
        data, name = session.images.read(views[0].depth), views[0].depth
    model = None if calibration.camera is None else calibration.camera.depth
    size = camera.resolution if model is None or model.by is None else model.by.resolution
    depth = read_depth(data, name, size, None if model is None else model.unit_m)
    found = seen_distances(calibration, depth, px)
    lost = np.flatnonzero(np.isnan(found))
    if len(lost):
        at = f"({px[lost[0], 0]:g}, {px[lost[0], 1]:g})"
        raise DataError(
            f"{name}: the sensor measured no depth at pixel {at}.",
            culprits=[f"pixel {at}"],
            next_step="Give a pixel beside it, or the plane that it lies in (--plane).",
        )
    return found


def _write_cloud(
    options: LocateOptions,
    cloud: Path,
    calibration: Calibration,
    flange: FloatArray | None,
    joints_rad: FloatArray | None,
) -> None:
    """Writes a cloud in the base."""
    from visioncal.session.depth import npy_of, ply_of, read_cloud

    output = options.output
    if output is None or output.suffix.lower() not in (".ply", ".npy"):
        raise DataError(
            "--cloud needs -o, a .ply or .npy where the cloud goes.",
            culprits=["--output"],
            next_step="Add -o cloud.ply.",
        )
    points = read_cloud(read_bytes(cloud, MOST_IMAGE_BYTES), cloud.name)
    if output.exists() and output.samefile(cloud):
        raise DataError(
            f"-o {output} is the cloud of --cloud itself, which is kept as it was measured.",
            culprits=["--output"],
            next_step="Add -o with another name.",
        )
    is_ply = output.suffix.lower() == ".ply"
    if is_ply:
        check_own(output)
    placed = cloud_in_base(calibration, points, flange, joints_rad=joints_rad)
    write_atomically(output, (ply_of if is_ply else npy_of)(placed))
    say(f"wrote {output}: {np.isfinite(placed[..., 2]).sum()} points in the base, in metres")


def _chosen(session: Session, view: int | None) -> tuple[View, ...]:
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


def _flange(words: str | None, form: PoseForm | None, mount: Mount) -> FloatArray | None:
    """Reads a pose of the robot, (4, 4) `base_from_flange` [m]; None where none is given."""
    if words is None:
        return None
    if words.count(",") != POSE.count(",") or is_marked_pose(words):
        pose = read_pose(words, "--pose", None if form is None else form.name).pose
    else:
        pose = stated_pose(numbers_in(words, "--pose", POSE), "--pose")
    if mount == "eye-to-hand":
        refuse_given({"--pose": words}, "the camera is fixed, wherever the robot is")
    return pose


def _flange_of(
    session: Session, views: Sequence[View], calibration: Calibration
) -> tuple[FloatArray | None, FloatArray | None]:
    """Flange pose and joint angles of a calibrated arm at the one chosen view."""
    from visioncal.frames.session_observations import calibrated_joints, pose_of

    check_mount(session, calibration)
    if calibration.mount == "eye-to-hand":
        return None, None
    if len(views) > 1:
        raise DataError(
            f"session {session.name!r} has {len(views)} views, and a camera on the flange "
            "stands elsewhere in each: name one with --view.",
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


def _plane_of(
    words: str, sigma_mm: float, calibration: Calibration, boards: Mapping[str, Edge]
) -> tuple[Plane, str]:
    """Parses a plane as in `FORMS`, whose height has a sigma [mm]."""
    sigma_m = 1e-3 * sigma_mm
    if words.startswith("z="):
        return Plane.horizontal(_height_m(words), sigma_m), ""
    frame, _, height = words.rpartition(":") if ":" in words else (words, "", "z=0")
    if "," in words:
        nx, ny, nz, product = numbers_in(words, "--plane", "nx,ny,nz,d")
        normal = np.array([nx, ny, nz])
        foot = 1e-3 * product * normal / max(float(normal @ normal), 1e-300)
        return Plane.through(normal, foot, sigma_m), ""
    z_m, placed = _height_m(height), {**calibration.placed, **boards}
    planes = [name for name in placed if name.startswith(_LEAD) and name != f"{_LEAD}cam"]
    names = (frame, f"{_LEAD}{frame}", f"{_LEAD}target_{frame}")
    name = next((name for name in names if name in planes), "")
    if not name:
        known_planes = some_of(planes) if planes else "none yet; visioncal fixture places them"
        raise DataError(
            f"--plane is {frame[:80]!r}, but must be a frame in the base: {known_planes}.",
            culprits=["--plane"],
            next_step=did_you_mean(f"{_LEAD}{frame.removeprefix(_LEAD)}", planes)
            or f"A plane is {FORMS}.",
        )
    warning = ""
    if name in calibration.frames and calibration.frames[name].verdict.status == "bad":
        warning = f"The verdict of {name} is bad: {calibration.frames[name].verdict.reasons[0]}"
    return Plane.of_frame(placed[name], z_m, sigma_m), warning


def _height_m(words: str) -> float:
    if not words.startswith("z="):
        raise DataError(
            f"--plane ends in {words[:80]!r}, but must end in a height in mm, such as z=5.",
            culprits=["--plane"],
            next_step=f"A plane is {FORMS}.",
        )
    return 1e-3 * numbers_in(words.removeprefix("z="), "--plane z", "z")[0]


def _by_views(
    options: LocateOptions,
    session: Session,
    calibration: Calibration,
    target: Target | None,
    point_m: FloatArray,
) -> list[_Point]:
    # Imported late, as a pixel is placed in a millisecond without it.
    from visioncal.calibration.stages.observed import by_reason
    from visioncal.frames.session_observations import locate_views

    views = _chosen(session, options.view)
    if target is not None and any(view.has_corners for view in views):
        raise DataError(
            f"--target: session {session.name!r} has corners of its own target (corners.csv), and "
            "no image is searched.",
            culprits=["--target"],
            next_step="Leave it out, or name one image.",
        )
    session = session if target is None else replace(session, target=target)
    with shown_progress(quiet=options.as_json) as progress:
        picks = locate_views(
            session, calibration, point_m, among=views, sigma_px=options.sigma_px, progress=progress
        )
    for words in (*by_reason(picks.lost), *picks.warnings):
        say(words)
    return [(f"view {view}", {"view": view}, located) for view, located in picks.found.items()]


def _by_image(
    options: LocateOptions,
    calibration: Calibration,
    target: Target | None,
    point_m: FloatArray,
    flange: FloatArray | None,
) -> list[_Point]:
    source = options.source
    if source is None:
        raise DataError(
            "locate needs a session, an image or a pixel to look for.",
            next_step="Name a session or an image; or give --pixel U,V and --plane.",
        )
    if target is None:
        raise DataError(
            f"{source} is one image, which names no target, and the calibration does not have "
            "exactly one.",
            culprits=["--target"],
            next_step="Name the target; or give --pixel U,V and --plane.",
        )
    image, name = read_image(source), source.name
    located = locate_target(
        calibration, image, target, flange, point_m, sigma_px=options.sigma_px, label=name
    )
    return [(name, {"image": name}, located)]


def known_targets(result: Calibration) -> Mapping[str, Mapping[str, Any]]:
    """Documents of the targets that a result was made with, by name."""
    if result.cell is not None:
        return result.cell.targets
    return {} if result.joint_fit is None else result.joint_fit.targets


def _only_target(result: Calibration, image: str) -> str | None:
    """The target that is looked for in an image without a word of it: the only one known."""
    known = known_targets(result)
    if len(known) != 1:
        return None
    say(f"{image}: looked for the board of the calibration; --target names another")
    return next(iter(known))


def _target(words: str, result: Calibration) -> Target:
    known = known_targets(result)
    if words in known:
        return target_from_document(known[words], words or "target")
    # A pixel waits for no foreign format.
    from visioncal.interchange.formats.intrinsics import target_named

    return target_named(words, Path(words).stem)


def _report(points: Sequence[_Point], *, as_json: bool) -> None:
    if as_json:
        print_json([{**document, **_document(located)} for _, document, located in points])
        return
    for words, _, located in points:
        place = ", ".join(f"{value:.2f}" for value in 1e3 * located.p_base)
        sigmas = ", ".join(figure(float(value)) for value in located.sigma_mm)
        largest_mm = figure(located.budget_mm[located.largest])
        typer.echo(
            f"{words}: ({place}) mm, sigma ({sigmas}) mm, 95 % within "
            f"{figure(located.radius95_mm)} mm; largest source: {located.largest}, {largest_mm} mm"
        )
        for warning in located.warnings:
            warn(warning if warning.startswith(words) else f"{words}: {warning}")


def _document(located: Located) -> dict[str, Any]:
    return {
        "p_base_m": located.p_base.tolist(),
        "covariance": located.covariance.tolist(),
        "sigma_mm": located.sigma_mm.tolist(),
        "radius95_mm": located.radius95_mm,
        "budget_mm": dict(located.budget_mm),
        "warnings": list(located.warnings),
    }
