"""A made-up session with its calibration: small, complete, and drawn without the pipeline."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.transforms import exp, invert
from visioncal.core.types import Camera, Corners, FloatArray, Target
from visioncal.results import (
    Calibration,
    CameraResult,
    Edge,
    Frame,
    Observation,
    Rms,
    SolverResult,
    Validation,
    Verdict,
    ViewResult,
)
from visioncal.results.evidence import ViewEvidence
from visioncal.robot import Robot, load_robot
from visioncal.session import MemoryImages, Session
from visioncal.session.columns import POSE
from visioncal.vision.boards.charuco import charuco_board
from visioncal.vision.camera import project
from visioncal.vision.targets import corner_positions, load_target

TARGET = "charuco_9x6_30mm"
RESOLUTION = (640, 400)
CAMERA = Camera("brown", RESOLUTION, np.array([520.0, 521.0, 322.5, 198.0]), np.zeros(5))
HOME_RAD = np.array([0.4, -1.3, 1.5, -1.75, -1.57, 0.3])
FLANGE_FROM_CAM = RigidTransform.from_components(
    [0.031, -0.012, 0.081], Rotation.from_rotvec([0.02, -0.03, 1.55])
)
# Lies in front of the camera at the home pose, seen straight on.
CAM_FROM_TARGET_HOME = RigidTransform.from_components(
    [-0.135, -0.09, 0.42], Rotation.from_rotvec([0.05, 0.02, 0.0])
)
# Views that are not used, with their reasons.
REJECTED = {
    3: "no corners: the target is out of the image",
    6: "its pose is 14 mm off: <b>robot moved</b> & hit **[it](http://example.org)**",
}
FLANGE_FROM_TOOL = RigidTransform.from_components(
    [0.0338, 0.001, 0.1768], Rotation.from_rotvec([0.0, 0.4, 0.1])
)
# A fixture of which one point alone was touched: its axes are the base's by declaration.
BASE_FROM_FIXTURE = RigidTransform.from_translation([-0.62, -0.05, 0.02])
# The touch of the tool that is not used, with its reason, and that of one that is used in doubt.
WRONG_TOUCH, WRONG_REASON = "17", "it is 6.4 mm off: the tip slipped, or <i>another</i> point"
DOUBT = "it is 0.9 mm off, three times the others"


@dataclass(frozen=True)
class Sample:
    """A session, and what a calibration of it could give."""

    session: Session
    calibration: Calibration
    evidence: tuple[ViewEvidence, ...]


def made_up(views: int = 9, name: str = "bench <1> & 2", *, images: bool = True) -> Sample:
    """Builds a sample; without images its target poses are in the table, as cft_*."""
    rng = np.random.default_rng(7)
    robot = load_robot("ur10e")
    target = load_target(TARGET)
    q = HOME_RAD + rng.uniform(-0.22, 0.22, (views, 6)) * [0.4, 0.4, 0.6, 1, 1, 1.6]
    base_from_flange = robot.base_from_flange(q)
    base_from_target = (
        robot.base_from_flange(HOME_RAD[None])[0]
        @ FLANGE_FROM_CAM.as_matrix()
        @ CAM_FROM_TARGET_HOME.as_matrix()
    )
    cam_from_target = invert(base_from_flange @ FLANGE_FROM_CAM.as_matrix()) @ base_from_target
    session = _session(name, q, base_from_flange, cam_from_target, target, images=images)
    evidence = tuple(
        _evidence(view, base_from_flange[view], cam_from_target[view], target, rng, images=images)
        for view in range(views)
    )
    calibration = _calibration(session, robot, base_from_target, evidence, rng, images=images)
    return Sample(session, calibration, evidence)


def _session(
    name: str,
    q: FloatArray,
    base_from_flange: FloatArray,
    cam_from_target: FloatArray,
    target: Target,
    *,
    images: bool,
) -> Session:
    joints = [f"q{number}_rad" for number in range(1, 7)]
    measured = [] if images else [f"cft_{name}" for name in POSE]
    columns = ["view", "role", "image", *POSE, *joints, *measured, "note"]
    cells, files = [], {}
    for view, pose in enumerate(base_from_flange):
        image = f"images/{view:03d}.png" if images else ""
        numbers = [*_pose(pose), *q[view]]
        numbers += [] if images else _pose(cam_from_target[view])
        note = 'first, "dark"\n' if view == 0 else ""
        cells.append([str(view), "", image, *(repr(float(number)) for number in numbers), note])
        if images:
            files[image] = _picture(target, cam_from_target[view])
    document: dict[str, object] = {"schema": 1, "name": name, "mount": "eye-in-hand"}
    document |= {"robot": {"model": "ur10e", "tip": "tool0"}, "target": TARGET}
    if images:
        document["camera"] = {
            "name": "made up",
            "resolution": list(RESOLUTION),
            "matrix": CAMERA.matrix.tolist(),
            "distortion": CAMERA.distortion.tolist(),
        }
    return Session.assemble(document, columns, cells, MemoryImages(files))


def _pose(matrix: FloatArray) -> list[float]:
    quaternion = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    return [*matrix[:3, 3], *quaternion]


def _picture(target: Target, cam_from_target: FloatArray) -> bytes:
    """The printed board, warped to where the camera sees it."""
    scale = 500.0
    board_px = (
        round(target.columns * target.square_m * scale),
        round(target.rows * target.square_m * scale),
    )
    printed = charuco_board(target).generateImage(board_px)
    matrix = np.array([[520.0, 0, 322.5], [0, 521.0, 198.0], [0, 0, 1]])
    plane_from_print = np.diag([1 / scale, 1 / scale, 1.0])
    homography = matrix @ cam_from_target[:3, [0, 1, 3]] @ plane_from_print
    picture = cv2.warpPerspective(printed, homography, RESOLUTION, borderValue=150)
    return cv2.imencode(".png", picture)[1].tobytes()


def _evidence(
    view: int,
    base_from_flange: FloatArray,
    cam_from_target: FloatArray,
    target: Target,
    rng: np.random.Generator,
    *,
    images: bool,
) -> ViewEvidence:
    if not images:
        return ViewEvidence(view, None, None, base_from_flange, cam_from_target)
    if view == 3:
        return ViewEvidence(view, base_from_flange=base_from_flange)
    points = corner_positions(target) @ cam_from_target[:3, :3].T + cam_from_target[:3, 3]
    predicted = project(CAMERA, points)
    seen = predicted + rng.normal(0.0, 0.15 + 0.02 * view, predicted.shape)
    corners = Corners(view, np.arange(len(seen)), seen, 0.8)
    return ViewEvidence(view, corners, predicted, base_from_flange, cam_from_target)


def _calibration(
    session: Session,
    robot: Robot,
    base_from_target: FloatArray,
    evidence: tuple[ViewEvidence, ...],
    rng: np.random.Generator,
    *,
    images: bool,
) -> Calibration:
    covariance = np.diag([2e-4, 2e-4, 1e-4, 1.2e-4, 1e-4, 3e-4]) ** 2
    edges = {
        "flange_from_cam": Edge(FLANGE_FROM_CAM.as_matrix(), covariance),
        "base_from_target": Edge(base_from_target, 4 * covariance),
    }
    solvers = {
        solver: SolverResult(
            {edge: item.matrix @ exp(rng.normal(0, size, 6)) for edge, item in edges.items()},
            500 * size,
            20 * size,
        )
        for solver, size in (("joint", 0.0), ("park", 4e-4), ("tsai", 2e-3))
    }
    views = tuple(_view(view, rng) for view in evidence)
    px = 0.23 if images else None
    return Calibration(
        session.name,
        session.digest(),
        "2026-11-20T10:11:12+00:00",
        "eye-in-hand",
        edges,
        np.kron(np.diag([1.0, 4.0]), covariance),
        solvers,
        {"pixel_px": 0.21, "robot_translation_mm": 0.051, "robot_rotation_deg": 0.0042},
        views,
        Rms(0.31, 0.024, px),
        Validation("5-fold over stops", Rms(0.36, 0.03, px), None),
        Verdict.of(
            "check",
            "Position is determined to 0.33 mm and orientation to 0.017 deg.",
            f"2 of {len(views)} views were not used; view 6 disagrees: look at <its> image.",
        ),
        CameraResult(
            CAMERA, estimated=True, covariance=np.diag([0.4, 0.4, 0.6, 0.6] + [1e-3] * 5) ** 2
        )
        if images
        else None,
        robot,
    )


def _view(seen: ViewEvidence, rng: np.random.Generator) -> ViewResult:
    reason = REJECTED.get(seen.view, "")
    if seen.view == 3:
        return ViewResult(seen.view, used=False, reason=reason, corners=0)
    mm, deg = rng.uniform(0.1, 0.5), rng.uniform(0.01, 0.04)
    corners, rms_px = None, None
    if seen.corners is not None and seen.predicted_px is not None:
        corners = len(seen.corners.ids)
        errors = seen.corners.px - seen.predicted_px
        rms_px = float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
    if reason:
        mm, deg, rms_px = 14.2, 1.9, None if rms_px is None else 8.1
    return ViewResult(seen.view, not reason, reason, corners, rms_px, mm, deg)


def with_frames(sample: Sample) -> Sample:
    """The sample with a tool and a fixture in its calibration."""
    frames = {"flange_from_tool": tool_frame(), "base_from_fixture": fixture_frame()}
    return replace(sample, calibration=replace(sample.calibration, frames=frames))


def tool_frame() -> Frame:
    """A tool from ten touches of one point, of which one is wrong, and two for its axes."""
    rng = np.random.default_rng(5)
    root = rng.normal(size=(6, 6)) * np.repeat([1e-3, 3e-5], 3)[:, None]
    touches = [
        Observation(str(number), used=True, kind="point", residual_mm=rng.uniform(0.1, 0.4))
        for number in range(11, 21)
    ]
    touches[3] = replace(touches[3], reason=DOUBT, residual_mm=0.9)
    touches[6] = replace(touches[6], used=False, reason=WRONG_REASON, residual_mm=6.4)
    touches += [Observation("21", used=True, kind="z"), Observation("22", used=True, kind="xz")]
    return Frame(
        Edge(FLANGE_FROM_TOOL.as_matrix(), root @ root.T),
        oriented=True,
        method="pivot about one point, axes from touches",
        source="touches <b>1</b>.csv",
        created="2026-11-20T12:13:14+00:00",
        rms_mm=0.31,
        noise_mm=0.21,
        observations=tuple(touches),
        verdict=Verdict.of("check", f"Touch {WRONG_TOUCH} is not used: {WRONG_REASON}. Repeat it."),
        details={
            "cone_deg": 43.71,
            "point_m": [0.61, -0.12, 0.034],
            "refined": False,
            "weights": [[1.0, 0.0], [0.0, 1.0]],
            "bound": {"tip_mm": 0.052},
        },
    )


def fixture_frame() -> Frame:
    """A fixture whose orientation was not measured, from three touches of its origin."""
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = np.diag([6e-5, 6e-5, 1.2e-4]) ** 2
    return Frame(
        Edge(BASE_FROM_FIXTURE.as_matrix(), covariance),
        oriented=False,
        method="touches of its origin",
        source="fixture.csv",
        created="2026-11-20T12:20:00+00:00",
        rms_mm=0.12,
        noise_mm=0.1,
        observations=tuple(
            Observation(name, used=True, kind="origin", residual_mm=0.1) for name in ("1", "2", "3")
        ),
        verdict=Verdict.of("good", "Position is determined to 0.15 mm."),
    )
