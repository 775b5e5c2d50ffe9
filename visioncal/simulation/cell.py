"""A simulated robot cell: an arm, a camera and a board, what really is and what is reported."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.transforms import compose, invert
from visioncal.core.types import Camera, Corners, FloatArray, Mask
from visioncal.simulation.arms import Arm, arm_named, forward, inverse, link_frames, reach_m
from visioncal.simulation.boards import Sheet, centre_m, corners_m
from visioncal.simulation.draws import Stream
from visioncal.simulation.optics import project, sees
from visioncal.simulation.options import CameraOptions, CellOptions
from visioncal.simulation.poses import draw_views, mean_view
from visioncal.simulation.sag import Payload
from visioncal.simulation.second import Shown, chains, sheets_of, shown_at, with_second

# Postures with a smaller dexterity are so near a singularity that no operator would choose them.
LEAST_DEXTERITY = 0.04
# A corner nearer to the image's edge is not detected [px].
EDGE_PX = 2.0


@dataclass(frozen=True, eq=False)
class Cell:
    """A simulated cell with m views, numbered from 0.

    Attributes:
        options: What was asked for.
        arm: The nominal arm.
        true_arm: The arm as it was built.
        stated_camera: The intrinsics as the session states them.
        transforms: True edges, each (4, 4): `flange_from_cam` and `base_from_target`
            (eye-in-hand), or `base_from_cam` and `flange_from_target` (eye-to-hand); of two boards
            `base_from_target_first`, `base_from_target_second` and the like.
        joints: (m, n) joint angles as reported [rad].
        base_from_flange: (m, 4, 4) poses as reported: the nominal arm at the reported joints.
        true_base_from_flange: (m, 4, 4) where the flange really stood.
        cam_from_target: (m, 4, 4) where the board really stood.
        exact_corners: Where the corners really are in each image.
        corners: The same as a detector with `pixel_sigma_px` would report them.
        wrong_views: Views whose report is wrong, ascending.
        sheets: The boards as they were printed.
        shown: Which stop and which board each view is of: a stop that shows two has two views.
        payloads: What the arm carried, view by view; empty where nothing.
        approach: (m,) the side from which each stop was approached, +1 or -1; None where that is
            not stated.
    """

    options: CellOptions
    arm: Arm
    true_arm: Arm
    stated_camera: Camera
    transforms: Mapping[str, FloatArray]
    joints: FloatArray
    base_from_flange: FloatArray
    true_base_from_flange: FloatArray
    cam_from_target: FloatArray
    exact_corners: tuple[Corners, ...]
    corners: tuple[Corners, ...]
    wrong_views: tuple[int, ...]
    sheets: tuple[Sheet, ...]
    shown: Shown
    payloads: tuple[Payload, ...] = ()
    approach: FloatArray | None = None

    def flange_at(self, q: FloatArray, payloads: Sequence[Payload] = ()) -> FloatArray:
        """Where the real arm's flange stands (k, 4, 4) at (k, n) joint angles [rad].

        With k loads, or none but its own weight; from the middle of its play.
        """
        return self.options.flange_at(self.true_arm, q, payloads)

    def only(self, views: Sequence[int]) -> "Cell":
        """The cell with some of its views, numbered anew; stops keep their numbers."""
        kept = list(views)
        exact, found = (
            tuple(replace(corners[at], view=view) for view, at in enumerate(kept))
            for corners in (self.exact_corners, self.corners)
        )
        return replace(
            self,
            joints=self.joints[kept],
            base_from_flange=self.base_from_flange[kept],
            true_base_from_flange=self.true_base_from_flange[kept],
            cam_from_target=self.cam_from_target[kept],
            exact_corners=exact,
            corners=found,
            wrong_views=tuple(at for at, index in enumerate(kept) if index in self.wrong_views),
            shown=Shown(self.shown.stops[kept], self.shown.boards[kept]),
            payloads=tuple(self.payloads[at] for at in kept if self.payloads),
            approach=None if self.approach is None else self.approach[kept],
        )

    def standing_at(self, true_base_from_flange: FloatArray) -> "Cell":
        """The cell as its views look where the flange really stands at (m, 4, 4)."""
        boards = self.shown.boards
        poses = [before_camera(chain, true_base_from_flange) for chain in chains(self.transforms)]
        seen = np.array(poses)[boards, np.arange(len(boards))]
        exact = tuple(
            seen_in(self.options, self.sheets[board], pose, view)
            for view, (board, pose) in enumerate(zip(boards, seen, strict=True))
        )
        return replace(
            self,
            true_base_from_flange=true_base_from_flange,
            cam_from_target=seen,
        ).showing(exact)

    def showing(self, exact_corners: Sequence[Corners]) -> "Cell":
        """The cell with corners elsewhere in the images of its views, and found anew."""
        noise, sigma_px = self.options.stream(Stream.PIXELS), self.options.pixel_sigma_px
        found = tuple(detected(corners_, sigma_px, noise) for corners_ in exact_corners)
        return replace(self, exact_corners=tuple(exact_corners), corners=found)


@typed
def simulate(options: CellOptions, postures: FloatArray | None = None) -> Cell:
    """Builds a cell, moves its robot and looks at the board.

    Args:
        options: What the cell is made of. The same options give the same cell.
        postures: (m, n) joint angles to move to, one a view, whatever the camera sees there [rad];
            None draws as many as the options say, from which the board is in the image.

    Returns:
        The truth and the reports.

    Raises:
        DataError: The arm is unknown, the camera's coefficients do not fit its model, or the
            arm cannot reach enough poses from which the board is in the image.
    """
    arm = arm_named(options.robot)
    if postures is not None:
        options = replace(options, views=len(postures))
    true_arm = options.built(options.stream(Stream.ARM))
    sheets = sheets_of(options)
    transforms = _mountings(options, arm, sheets[0])
    if options.second is not None:
        transforms = with_second(transforms, sheets, options.second)
    if postures is None:
        moved = _postures(options, arm, sheets, transforms)
    else:
        moved = np.array(postures, dtype=float)
    transforms = _bumped(options, transforms)
    payloads, approach = options.loads(options.views), options.approach(options.views)
    jitter = options.jitter(options.views, options.stream(Stream.ROBOT))
    true_base_from_flange = options.flange_at(true_arm, moved, payloads, approach) @ jitter
    rng = options.stream(Stream.WRONG)
    joints, wrong_stops = misreported(arm, moved, options.wrong_views, rng)
    poses = [before_camera(chain, true_base_from_flange) for chain in chains(transforms)]
    shown = shown_at(options, sheets, poses)
    cell = Cell(
        options=options,
        arm=arm,
        true_arm=true_arm,
        stated_camera=options.stated(options.stream(Stream.LENS)),
        transforms=transforms,
        joints=joints[shown.stops],
        base_from_flange=forward(arm, joints)[shown.stops],
        true_base_from_flange=np.empty(0),
        cam_from_target=np.empty(0),
        exact_corners=(),
        corners=(),
        wrong_views=tuple(np.flatnonzero(np.isin(shown.stops, wrong_stops)).tolist()),
        sheets=sheets,
        shown=shown,
        payloads=tuple(payloads[at] for at in shown.stops if payloads),
        approach=None if approach is None else approach[shown.stops],
    )
    return cell.standing_at(true_base_from_flange[shown.stops])


def _mountings(options: CellOptions, arm: Arm, sheet: Sheet) -> dict[str, FloatArray]:
    """The two constant edges of the cell, plausible for the arm's size."""
    rng = options.stream(Stream.MOUNTING)
    front, spin = rng.uniform(-0.5, 0.5), rng.uniform(-0.4, 0.4)
    radius = 0.6 * reach_m(arm)
    skewed = Rotation.from_rotvec(rng.normal(0.0, 0.05, 3))
    if options.mount == "eye-in-hand":
        aside = rng.uniform([0.05, -0.02, 0.03], [0.09, 0.02, 0.07])
        camera = Rotation.from_euler("z", 0.5 * np.pi) * skewed
        flange_from_cam = compose(camera.as_matrix(), aside)
        # The target's z points into the table.
        board = Rotation.from_euler("ZX", [front + spin, np.pi]).as_matrix()
        # A table so low that the arm has the board in view from a comfortable height.
        table = min(0.0, 0.4 * reach_m(arm) - float(mean_view(options, sheet)[2, 3]))
        centre = np.array([radius * np.cos(front), radius * np.sin(front), table])
        base_from_target = compose(board, centre - board @ centre_m(sheet))
        return {"flange_from_cam": flange_from_cam, "base_from_target": base_from_target}
    board = (Rotation.from_euler("ZX", [spin, np.pi]) * skewed).as_matrix()
    held = np.array([0.0, 0.0, 0.06]) + rng.normal(0.0, 0.005, 3)
    flange_from_target = compose(board, held - board @ centre_m(sheet))
    work = np.array([radius * np.cos(front), radius * np.sin(front), 0.6 * reach_m(arm)])
    away = np.array([np.cos(front + spin), np.sin(front + spin), 0.35])
    base_from_cam = looking_at(work, away / np.linalg.norm(away), mean_view(options, sheet))
    return {"base_from_cam": base_from_cam, "flange_from_target": flange_from_target}


def _bumped(options: CellOptions, transforms: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """The edges once the camera was pushed, in a direction of chance."""
    away = options.stream(Stream.BUMP).standard_normal(3)
    away *= options.camera_moved_m / np.linalg.norm(away)
    push = compose(np.eye(3), away)
    return {
        name: transform @ push if name.endswith("cam") else transform
        for name, transform in transforms.items()
    }


def looking_at(point: FloatArray, away: FloatArray, view: FloatArray) -> FloatArray:
    """`base_from_cam` (4, 4) of an upright camera that looks at a point along -`away`."""
    right = np.cross(-away, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(-away, right), -away], axis=1)
    return compose(rotation, point + np.linalg.norm(view[:3, 3]) * away)


def _flange(transforms: Mapping[str, FloatArray], cam_from_target: FloatArray) -> FloatArray:
    """(m, 4, 4) `base_from_flange` at which the camera sees the board so."""
    if "flange_from_cam" in transforms:
        base_from_cam = transforms["base_from_target"] @ invert(cam_from_target)
        return base_from_cam @ invert(transforms["flange_from_cam"])
    base_from_target = transforms["base_from_cam"] @ cam_from_target
    return base_from_target @ invert(transforms["flange_from_target"])


def before_camera(transforms: Mapping[str, FloatArray], base_from_flange: FloatArray) -> FloatArray:
    """(m, 4, 4) `cam_from_target` of a chain at these poses of the flange."""
    if "flange_from_cam" in transforms:
        base_from_cam = base_from_flange @ transforms["flange_from_cam"]
        return invert(base_from_cam) @ transforms["base_from_target"]
    base_from_target = base_from_flange @ transforms["flange_from_target"]
    return invert(transforms["base_from_cam"]) @ base_from_target


def _postures(
    options: CellOptions, arm: Arm, sheets: Sequence[Sheet], transforms: Mapping[str, FloatArray]
) -> FloatArray:
    """(s, n) postures of the nominal arm, which look at the boards in turn."""
    joints = np.zeros((options.views, arm.a.size))
    for board, (sheet, chain) in enumerate(zip(sheets, chains(transforms), strict=True)):
        mine = np.arange(board, options.views, len(sheets))
        part = replace(options, target=sheet.target, views=len(mine), wrong_views=0)
        rng = options.stream(Stream.POSES, *([board] if board else []))
        joints[mine] = _reachable_joints(part, arm, sheet, chain, rng)
    return joints


def _reachable_joints(
    options: CellOptions,
    arm: Arm,
    sheet: Sheet,
    transforms: Mapping[str, FloatArray],
    rng: np.random.Generator,
) -> FloatArray:
    """(m, n) postures of the nominal arm that bring the board into the image."""
    # Nothing of the arm may sink into the table under the board, or under the robot.
    floor = min(0.0, transforms.get("base_from_target", np.eye(4))[2, 3]) + 0.05
    home = home_posture(arm, _flange(transforms, mean_view(options, sheet)[None]), rng)
    kept: list[FloatArray] = []
    for _ in range(50):
        views = draw_views(options, sheet, 4 * options.views, rng)
        if not len(views):
            continue
        starts = np.tile(home, (len(views), 1))
        if options.branches:
            starts = rng.uniform(-np.pi, np.pi, starts.shape)
        joints, good = reached(arm, _flange(transforms, views), starts, floor)
        kept.extend(joints[good])
        if len(kept) >= options.views:
            return np.array(kept[: options.views])
    raise DataError(
        f"simulation: {len(kept)} of {options.views} views found in which the {arm.name} reaches "
        "its pose and the camera sees the board.",
        next_step="Take another working distance, board, tilt or robot.",
    )


def home_posture(arm: Arm, base_from_flange: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(n,) the most dexterous posture at one pose (1, 4, 4); all views start from it."""
    starts = rng.uniform(-np.pi, np.pi, size=(64, arm.a.size))
    reach = inverse(arm, np.tile(base_from_flange, (64, 1, 1)), starts)
    elbow_up = link_frames(arm, reach.joints)[:, 2, 2, 3] > arm.d[0]
    merit = np.where(reach.solved & elbow_up, reach.dexterity, 0.0)
    if not merit.any():
        raise DataError(
            f"simulation: the {arm.name} cannot reach the middle of the views.",
            next_step="Take another working distance, board or robot.",
        )
    best = reach.joints[np.argmax(merit)]
    # All joints within half a turn: the middle of their range.
    return np.asarray((best + np.pi) % (2.0 * np.pi) - np.pi)


def reached(
    arm: Arm, base_from_flange: FloatArray, starts: FloatArray, floor_m: float
) -> tuple[FloatArray, Mask]:
    """(m, n) postures [rad] at (m, 4, 4) poses, and (m,) which an operator would choose.

    They are sought from (m, n) starts [rad]; no link comes lower over the base than the floor.
    """
    reach = inverse(arm, base_from_flange, starts)
    good = reach.solved & (reach.dexterity > LEAST_DEXTERITY)
    return reach.joints, np.asarray(good & (lowest_m(arm, reach.joints) > floor_m))


def lowest_m(arm: Arm, joints: FloatArray) -> FloatArray:
    """(m,) height over the base of the lowest of elbow, wrists and flange [m]."""
    return np.asarray(link_frames(arm, joints)[:, 2:, 2, 3].min(axis=1))


def misreported(
    arm: Arm, moved: FloatArray, count: int, rng: np.random.Generator
) -> tuple[FloatArray, tuple[int, ...]]:
    """Joints as reported: those moved to, but for some stops whose report belongs elsewhere.

    Args:
        arm: The nominal arm.
        moved: (s, n) joint angles moved to [rad].
        count: How many stops are reported 5 to 30 mm and 1 to 5 degrees away.
        rng: Source of randomness.

    Returns:
        (s, n) joint angles as reported [rad], and those stops, ascending.
    """
    chosen = np.sort(rng.permutation(len(moved))[:count])
    joints = moved.copy()
    for stop in chosen:
        for _ in range(20):
            turn, shift = rng.normal(size=(2, 3))
            turn *= np.deg2rad(rng.uniform(1.0, 5.0)) / np.linalg.norm(turn)
            shift *= rng.uniform(0.005, 0.030) / np.linalg.norm(shift)
            error = compose(Rotation.from_rotvec(turn).as_matrix(), shift)
            reach = inverse(arm, forward(arm, moved[stop, None]) @ error, moved[stop, None])
            if reach.solved[0]:
                joints[stop] = reach.joints[0]
                break
        else:
            raise DataError(f"simulation: no wrong report is in the arm's reach at stop {stop}.")
    return joints, tuple(chosen.tolist())


def seen_in(camera: CameraOptions, sheet: Sheet, cam_from_target: FloatArray, view: int) -> Corners:
    """Where the corners of a sheet are in the image of one view, without the ones outside it."""
    points = corners_m(sheet) @ cam_from_target[:3, :3].T + cam_from_target[:3, 3]
    ids = np.flatnonzero(sees(camera.camera, points, EDGE_PX)).astype(np.int64)
    return Corners(view, ids, project(camera.camera, points[ids]), camera.blur_px)


def detected(exact: Corners, sigma_px: float, noise: np.random.Generator) -> Corners:
    """The corners of a view with the noise of their detection."""
    return replace(exact, px=exact.px + sigma_px * noise.standard_normal(exact.px.shape))
