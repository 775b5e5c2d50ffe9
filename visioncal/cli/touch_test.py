"""`visioncal touch-test`."""

import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.cli.console import (
    EXIT_BAD,
    answer,
    check_usable,
    print_json,
    report_written,
    say,
    warn,
)
from visioncal.cli.frame_options import TouchTestOptions
from visioncal.cli.history import enter
from visioncal.cli.locate import known_targets
from visioncal.cli.progress import shown_progress
from visioncal.core.conventions import POSE_FORMS, PoseForm, controller_form
from visioncal.core.documents.pendants import pendant_words
from visioncal.core.errors import DataError
from visioncal.core.files import MOST_IMAGE_BYTES, read_bytes
from visioncal.core.number_format import figure, mm_and_deg
from visioncal.core.parsing import numbers_in, refuse_given
from visioncal.core.verdict import Verdict
from visioncal.frames.camera_chain import CalibratedCamera
from visioncal.frames.touch_test import (
    TouchPoint,
    TouchTargets,
    evaluate_gaps,
    touch_targets,
    touch_test_finding,
)
from visioncal.frames.touches import Tool
from visioncal.interchange.result_files import load_result, rewrite_result
from visioncal.results import Calibration, to_document
from visioncal.results.compensation.correction import correct
from visioncal.results.history import entries_of
from visioncal.session import Session
from visioncal.session.images import IMAGE_ENDINGS, MemoryImages

_PLACE = "where the board lies"


def touch_test_command(options: TouchTestOptions) -> None:
    """Runs `visioncal touch-test`."""
    calibration = options.calibration
    result = load_result(calibration)
    if result.cell is not None:
        raise DataError(
            f"touch-test is for one camera and one robot, and {calibration} is of a whole cell.",
            culprits=["-c"],
            next_step=f"Let visioncal locate {shlex.quote(str(options.session))} "
            f"-c {shlex.quote(str(calibration))} --camera NAME --robot NAME say where the board "
            "is, touch it there, and compare.",
        )
    loaded = _looked(options.session, result)
    touching = _touching(result, calibration, options.tool)
    misplaced_mm = None if options.tool == "none" else options.clearance_mm
    step = "Leave it out." if options.tool else "Give --tool none, too, or leave it out."
    refuse_given({"--clearance-mm": misplaced_mm}, "it is for --tool none", step)
    with shown_progress(quiet=options.as_json):
        clearance_m = None if options.clearance_mm is None else 1e-3 * options.clearance_mm
        located = touch_targets(loaded, result, touching, clearance_m)
    used = {
        "the calibration": result.verdict,
        _PLACE: located.board.verdict,
        **({} if touching is None else {touching.name: touching.verdict}),
    }
    _check_used(used, force=options.force)
    points = located.points
    known = controller_form("", options.robot_form) or result.controller()
    # No pendant's angles are taken for another's where no maker is known: a quaternion.
    form = known or POSE_FORMS["ros"]
    targets = [_target(result, located, point, 1e-3 * options.height_mm, form) for point in points]
    if options.gaps_mm is None:
        if options.as_json:
            print_json({"points": targets})
            return
        if known is None:
            say(
                "The robot's maker is not known: --robot-form (ur, kuka, fanuc, abb ...) gives "
                "the poses as its pendant shows them."
            )
        words = "positions and quaternions x, y, z, w" if known is None else form.words
        answer(f"Flange targets: {words}; hover first, then touch.")
        for point, target in zip(points, targets, strict=True):
            x, y, z = 1e3 * point.base_m
            answer(
                f"{point.name} at ({x:.2f}, {y:.2f}, {z:.2f}) mm, 95 % within "
                f"{figure(point.radius95_mm)} mm"
            )
            for key in (key for key in target if key.startswith(("hover_", "touch_"))):
                answer(f"  {key.partition('_')[0]}: {target[key]}")
        answer("Enter the gaps with --gaps-mm, in this order.")
        return
    test = evaluate_gaps(points, numbers_in(options.gaps_mm, "--gaps-mm"), touching)
    extended = replace(result, touch_test=test)
    written = rewrite_result(calibration if calibration.is_dir() else calibration.parent, extended)
    enter(options, options.session, entries_of(extended), calibration)
    if options.as_json:
        print_json({"points": targets, "touch_test": to_document(extended)["touch_test"]})
    else:
        answer(touch_test_finding(test).reason)
    report_written(written, quiet=options.as_json, status=0 if test.passed else EXIT_BAD)


def _check_used(used: Mapping[str, Verdict], *, force: bool) -> None:
    """Refuses what is bad, and warns of a place in doubt, whose wide radius lets gaps pass."""
    for what, verdict in used.items():
        for warning in check_usable(verdict, what, force=force):
            warn(warning)
    place = used[_PLACE]
    if place.status == "check":
        warn(f"{_PLACE.capitalize()} is in doubt: {place.findings[0].words}")


def _looked(path: Path, result: Calibration) -> Session:
    """The session that shows the board; also of one image of a camera that stands still."""
    is_image = path.is_file() and path.suffix.lower() in IMAGE_ENDINGS
    if not is_image or result.mount != "eye-to-hand":
        return Session.load(path)
    data, known = read_bytes(path, MOST_IMAGE_BYTES), known_targets(result)
    if len(known) != 1:
        raise DataError(
            f"{path} is one image, and the calibration does not have exactly one board.",
            culprits=[str(path)],
            next_step="Name a session of this image, whose session.toml names the board.",
        )
    name, resolution = f"look{path.suffix}", list(CalibratedCamera.of(result).camera.resolution)
    camera = {"resolution": resolution}
    document = {"schema": 1, "name": path.stem, "mount": result.mount, "camera": camera}
    return Session.assemble(
        {**document, "target": "target.toml"},
        ("view", "image"),
        [("0", name)],
        MemoryImages({name: data}),
        target_document=next(iter(known.values())),
    )


def _touching(calibration: Calibration, path: Path, tool: str | None) -> Tool | None:
    """The tool that touches; None where there is none."""
    if any(frame.startswith("flange_from_") for frame in calibration.frames):
        return None if tool == "none" else Tool.among(calibration.frames, "The calibration", tool)
    if tool not in (None, "none"):
        raise DataError(
            f"--tool is {tool!r}, and the calibration has no tool.",
            culprits=["--tool"],
            next_step="Find the tip first, and let it join the calibration: "
            f"visioncal tcp TOUCHES -c {shlex.quote(str(path))} --name gripper",
        )
    return None


def _target(
    calibration: Calibration,
    located: TouchTargets,
    point: TouchPoint,
    height_m: float,
    form: PoseForm,
) -> dict[str, Any]:
    """Targets of the robot for its own controller, also in the form of its poses."""
    touch, hover = point.base_from_flange, located.above(point, height_m)
    document: dict[str, Any] = {
        "name": point.name,
        "base_m": point.base_m.tolist(),
        "radius95_mm": point.radius95_mm,
    }
    if calibration.arm_is_calibrated:
        corrected = correct(calibration, [hover, touch])
        if not corrected.reached.all():
            left = mm_and_deg(1e3 * corrected.off_m.max(), np.rad2deg(corrected.off_rad.max()))
            raise DataError(
                f"{point.name} cannot be touched from above: it or the place over it is out of "
                f"reach within the joints' limits, and the nearest posture leaves {left}.",
                culprits=[point.name],
                next_step="Put the board where the arm reaches all of it with this tool, take a "
                "view of it there, and name that session; or hover lower with --height-mm.",
            )
        (hover, touch), document["q_rad"] = corrected.base_from_flange, corrected.q[1].tolist()
    for name, pose in (("hover", hover), ("touch", touch)):
        transform = RigidTransform.from_matrix(pose)
        turn = transform.rotation.as_rotvec().tolist()
        document[name] = [*transform.translation.tolist(), *turn]
        document[f"{name}_{form.name}"] = pendant_words(pose, form)
    return document
