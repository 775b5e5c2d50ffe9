"""Random poses and postures of a cell of one robot and one camera."""

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray, Mount
from visioncal.session import frame_name
from visioncal.simulation.arms import DhArm, arm_named, reach_m
from visioncal.simulation.boards import Sheet, centre_m
from visioncal.simulation.draws import RandomStream
from visioncal.simulation.layout import CellOptions, Second
from visioncal.simulation.poses import Viewpoints, filling_m, looking_at
from visioncal.simulation.reach import home_posture, reachable_postures

# Offset of a second board on the flange [m].
_ASIDE_M = 0.10
# Bounds of the smallest and of the largest distance of a fixed camera [m].
_NEAR_M, _FAR_M = (0.7, 1.0), (1.0, 1.2)
_TRIES = 50


def mounted(options: CellOptions) -> dict[str, FloatArray]:
    """(4, 4) poses of camera and boards on their parents, plausible for the arm's size."""
    rng, reach = options.stream(RandomStream.MOUNTING), reach_m(arm_named(options.robot))
    first, *further = options.layout.boards
    front, spin = rng.uniform(-0.5, 0.5), rng.uniform(-0.4, 0.4)
    skewed = Rotation.from_rotvec(rng.normal(0.0, 0.05, 3))
    straight = _viewpoints(options, first).mean()
    ahead = 0.6 * reach * np.array([np.cos(front), np.sin(front), 1.0])
    if options.mount == "eye-in-hand":
        aside = rng.uniform([0.05, -0.02, 0.03], [0.09, 0.02, 0.07])
        cam = compose((Rotation.from_euler("z", 0.5 * np.pi) * skewed).as_matrix(), aside)
        # The target's z points into the table.
        rotation = Rotation.from_euler("ZX", [front + spin, np.pi]).as_matrix()
        # The table is low enough to view the board from a comfortable height.
        middle = np.array([*ahead[:2], min(0.0, 0.4 * reach - float(straight[2, 3]))])
    else:
        rotation = (Rotation.from_euler("ZX", [spin, np.pi]) * skewed).as_matrix()
        middle = np.array([0.0, 0.0, 0.06]) + rng.normal(0.0, 0.005, 3)
        direction = np.array([np.cos(front + spin), np.sin(front + spin), 0.35])
        distance_m = float(np.linalg.norm(straight[:3, 3]))
        cam = looking_at(ahead, direction / np.linalg.norm(direction), distance_m)
    target = compose(rotation, middle - rotation @ centre_m(first))
    placed = {"cam": cam, frame_name("target", first.name): target}
    if options.second is not None:
        placed[frame_name("target", further[0].name)] = _second(
            options.second, first, target, options.mount
        )
    return placed


def _second(second: Second, first: Sheet, pose: FloatArray, mount: Mount) -> FloatArray:
    """(4, 4) pose of a second board, given that of the first."""
    middle = pose[:3, :3] @ centre_m(first) + pose[:3, 3]
    rotation_z = Rotation.from_euler("z", second.turn_rad).as_matrix()
    if mount == "eye-in-hand":
        position = rotation_z @ middle
        lean = np.cross([0.0, 0.0, 1.0], position / np.linalg.norm(position))
        # The print faces the base, as the arm comes from there.
        rotation = (
            Rotation.from_rotvec(-second.tilt_rad * lean).as_matrix() @ rotation_z @ pose[:3, :3]
        )
    else:
        aside = rotation_z @ np.array([1.0, 0.0, 0.0])
        position = middle + _ASIDE_M * aside
        lean = np.cross([0.0, 0.0, 1.0], aside)
        rotation = Rotation.from_rotvec(second.tilt_rad * lean).as_matrix() @ pose[:3, :3]
    return compose(rotation, position - rotation @ centre_m(second))


def pushed(options: CellOptions, mountings: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Mountings after the camera was displaced in a random direction."""
    shift = options.stream(RandomStream.BUMP).standard_normal(3)
    shift *= options.camera_moved_m / np.linalg.norm(shift)
    return {**mountings, "cam": mountings["cam"] @ compose(np.eye(3), shift)}


def postures(options: CellOptions, mountings: Mapping[str, FloatArray]) -> FloatArray:
    """(s, n) postures of the nominal arm, aimed at the boards in turn [rad].

    Raises:
        DataError: The arm cannot reach enough poses with a board in the image.
    """
    arm, boards = arm_named(options.robot), options.layout.boards
    joints = np.zeros((options.views, arm.a.size))
    for index, board in enumerate(boards):
        stops = np.arange(index, options.views, len(boards))
        target = mountings[frame_name("target", board.name)]
        rng = options.stream(RandomStream.POSES, *([index] if index else []))
        joints[stops] = _aimed_postures(
            options, arm, board, (mountings["cam"], target), len(stops), rng
        )
    return joints


def _aimed_postures(
    options: CellOptions,
    arm: DhArm,
    board: Sheet,
    ends: tuple[FloatArray, FloatArray],
    count: int,
    rng: np.random.Generator,
) -> FloatArray:
    """(count, n) postures of the nominal arm with a board in the image [rad].

    `ends` are the poses of camera and board on their parents, (4, 4) each.
    """
    cam, target = ends
    in_hand = options.mount == "eye-in-hand"

    def flange(cam_from_target: FloatArray) -> FloatArray:
        """(m, 4, 4) `base_from_flange` for board poses in the camera frame."""
        if in_hand:
            return target @ invert(cam_from_target) @ invert(cam)
        return cam @ cam_from_target @ invert(target)

    # The arm must stay above the table under the board, and above the robot's own.
    floor_m = min(0.0, float(target[2, 3]) if in_hand else 0.0) + 0.05
    views = _viewpoints(options, board)
    home = home_posture(arm, flange(views.mean()[None]), rng)
    kept: list[FloatArray] = []
    for _ in range(_TRIES):
        drawn = views.draw(4 * count, rng)
        if not len(drawn):
            continue
        starts = np.tile(home, (len(drawn), 1))
        if options.branches:
            starts = rng.uniform(-np.pi, np.pi, starts.shape)
        joints, good = reachable_postures(arm, flange(drawn), starts, floor_m)
        kept.extend(joints[good])
        if len(kept) >= count:
            return np.array(kept[:count])
    raise DataError(
        f"simulation: {len(kept)} of {count} views found in which the {arm.name} reaches "
        "its pose and the camera sees the board.",
        next_step="Take another working distance, board, tilt or robot.",
    )


def _viewpoints(options: CellOptions, board: Sheet) -> Viewpoints:
    """Range of viewpoints towards a board."""
    distance_m = options.distance_m
    if distance_m is None:
        near, far = filling_m(options.camera, board)
        if options.mount == "eye-to-hand":
            near, far = min(max(near, _NEAR_M[0]), _NEAR_M[1]), min(max(far, _FAR_M[0]), _FAR_M[1])
        distance_m = near, far
    return Viewpoints(
        camera=options.camera,
        board=board,
        distance_m=distance_m,
        tilt_rad=options.tilt_rad,
        roll_rad=options.roll_rad,
        motion=options.motion,
        cut_views=options.cut_views,
    )
