"""What a world does to a calibration: what is named, how it is judged, and whether sigmas hold.

A row of `WORLDS` is a cell of one camera and one robot, seen by its corners, and what it must give.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from support.cells import calibrated, error_of, reporting, showing
from support.commands import visioncal
from support.marks import seeds, slow
from support.misfits import misfit

from visioncal.calibration.run import calibrate
from visioncal.calibration.stages.random_effects import KINDS
from visioncal.core.transforms import adjoint, apply, apply_each, compose, exp, invert, log
from visioncal.core.types import Corners
from visioncal.model.effects import Stretches
from visioncal.results import Calibration
from visioncal.simulation import BOARDS, CAMERAS, CellOptions, SimulatedCell, cell_session, simulate
from visioncal.vision.camera import normalise, project
from visioncal.vision.targets import corner_positions

FINE = CellOptions(camera=CAMERAS["fine"], pixel_sigma_px=0.1)
# So that an arm's errors count: half a millimetre and a milliradian in every parameter.
WRONG_ARM = replace(FINE, dh_sigma_m=5e-4, dh_sigma_rad=1e-3)
LITTLE_WRONG = replace(FINE, views=30, dh_sigma_m=2e-4, dh_sigma_rad=2e-4)
# As a user has it who states no lens.
OPEN = CellOptions(views=18, state_intrinsics=False, pixel_sigma_px=0.1, seed=1)
GROWING = frozenset(KINDS)
LONE_TAGS = replace(BOARDS["aprilgrid"], kind="gridboard", dictionary="DICT_APRILTAG_36h11")


def unchanged(cell: SimulatedCell) -> SimulatedCell:
    return cell


def moved_base(cell, twists):
    """The cell whose base is elsewhere by twists (s, 6), which no report knows."""
    return reporting(cell, base_from_flange=exp(twists) @ cell.robot.base_from_flange)


def knocked(steps):
    """A change of cells: their base is elsewhere by shifts (3,), each from a stop on [m]."""

    def change(cell):
        twists = np.zeros((len(cell.corners), 6))
        for stop, shift in steps.items():
            twists[stop:, 3:] += shift
        return moved_base(cell, twists)

    return change


def time_of(cell):
    """(s, 1) from -0.5 to 0.5."""
    return np.linspace(-0.5, 0.5, len(cell.robot.base_from_flange))[:, None]


# Tilts about x and y by the flange's x, and by its y: a stand that is stiffer one way.
TILT_RAD_M, CREEP_M = np.array([0.0, 1.8e-3, -1.2e-3, 0.0]), np.array([2e-4, -1e-4, 3e-4])
BEND_M = np.array([[4e-4, 0.0, 0.0], [0.0, -4e-4, 0.0], [0.0, 2e-4, 4e-4]])


def short(cell):
    """Poses that were commanded: a two-hundredth of each motion is not reached."""
    sent, reached = cell.robot.base_from_flange, [cell.robot.base_from_flange[0]]
    for pose in sent[1:]:
        reached.append(pose @ exp(5e-3 * log(invert(pose) @ reached[-1])))
    # What the camera sees is where the arm stands; what is logged is where it was sent.
    left = log(invert(np.array(reached)) @ sent)
    return reporting(cell, base_from_flange=cell.robot.base_from_flange @ exp(left))


def short_of_lines(cell):
    """As `short`, by a hundredth, of an arm that moves on straight lines and turns evenly."""
    sent = cell.robot.base_from_flange
    back = np.zeros((len(sent), 6))
    back[1:] = log(invert(sent[1:]) @ sent[:-1])
    back[1:, 3:] = np.einsum("nji,nj->ni", sent[1:, :3, :3], sent[:-1, :3, 3] - sent[1:, :3, 3])
    return reporting(cell, base_from_flange=sent @ exp(-0.01 * back))


def short_of_places(cell):
    """As `short`, by 0.6 mm of each motion, in place alone: turns are reached."""
    sent = cell.robot.base_from_flange
    away = np.append(np.zeros((1, 3)), np.diff(sent[:, :3, 3], axis=0), axis=0)
    length = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    logged = sent.copy()
    logged[:, :3, 3] += 6e-4 * away / length
    return reporting(cell, base_from_flange=logged)


def onwards(cell):
    """Poses that are read when the arm is a two-hundredth of the way to its next stop."""
    poses = cell.robot.base_from_flange
    away = np.append(log(invert(poses[:-1]) @ poses[1:]), np.zeros((1, 6)), axis=0)
    return reporting(cell, base_from_flange=poses @ exp(5e-3 * away))


def tilted(cell):
    """In proportion to the moment of what hangs at the flange."""
    turns = cell.robot.base_from_flange[:, :2, 3] @ TILT_RAD_M.reshape(2, 2)
    return moved_base(cell, -np.pad(turns, ((0, 0), (0, 4))))


def stretched(cell, axis=1):
    """A linear axis that goes 0.3 % farther than is reported."""
    poses = cell.robot.base_from_flange.copy()
    poses[:, axis, 3] /= 1.003
    return reporting(cell, base_from_flange=poses)


def skewed(cell):
    """Linear axes that meet at 89.9 deg: y leans towards x."""
    poses = cell.robot.base_from_flange.copy()
    poses[:, 0, 3] -= 2e-3 * poses[:, 1, 3]
    return reporting(cell, base_from_flange=poses)


def grown(cell):
    """An arm that warms up, to its length at the end: it is 0.1 % shorter at the start."""
    poses = cell.robot.base_from_flange.copy()
    poses[:, :3, 3] *= 1.0 + 1e-3 * (0.5 - time_of(cell))
    return reporting(cell, base_from_flange=poses)


def crept(cell):
    """To where it is at the end."""
    return moved_base(cell, -np.pad((time_of(cell) - 0.5) * CREEP_M, ((0, 0), (3, 0))))


def turned_beside(cell):
    """A target that turns by 0.7 deg in its place beside the robot, to where it is at the end."""
    place = np.eye(4)
    place[:3, 3] = cell.transforms["base_from_target"][:3, 3]
    turns = (time_of(cell) - 0.5) * (adjoint(place)[:, :3] @ [0.006, 0.008, -0.007])
    return moved_base(cell, -turns)


def bent_bracket(cell):
    poses = cell.robot.base_from_flange
    twists = np.pad(poses[:, 2, :3] @ BEND_M.T, ((0, 0), (3, 0)))
    return reporting(cell, base_from_flange=poses @ exp(twists))


def lifted(cell):
    """By 1 mm from the tenth view on."""
    return moved_base(cell, np.where(time_of(cell) < -0.05, 0.0, 1e-3) * np.eye(6)[5])


def in_groups(cell):
    """Three stops on end err alike."""
    drawn = np.random.default_rng(0).standard_normal((10, 6)) * np.repeat([4e-4, 2e-4], 3)
    poses = cell.robot.base_from_flange @ exp(np.repeat(drawn, 3, axis=0))
    return reporting(cell, base_from_flange=poses)


def zoomed(cell, shares):
    """Images that are larger by some shares, about the principal point."""
    centre = cell.options.camera.matrix[2:]
    pairs = zip(cell.corners, np.ravel(shares), strict=True)
    return showing(
        cell, [replace(seen, px=seen.px + by * (seen.px - centre)) for seen, by in pairs]
    )


def warmed(cell):
    return zoomed(cell, 1.5e-3 * (1.0 - np.exp(-3.0 * (time_of(cell) + 0.5))))


def sagged(cell):
    """A lens whose centre moves by a thousandth of the focal length with gravity."""
    moved = -1e-3 * cell.options.camera.matrix[0] * cell.robot.base_from_flange[:, 2, :2]
    return showing(
        cell, [replace(at, px=at.px + by) for at, by in zip(cell.corners, moved, strict=True)]
    )


def breathing(cell):
    """A focal length that follows the distance, by a hundredth."""
    far = np.array([pose[2, 3] for pose in cell.cam_from_target])
    return zoomed(cell, 0.01 * (far / far.mean() - 1.0))


def zoomed_once(share):
    """A lens that is longer by a share from the tenth view on."""
    return lambda cell: zoomed(cell, share * (np.arange(len(cell.corners)) >= 9))


def creeping(cell):
    """Images that are read row by row in 25 ms by an arm that creeps by 30 mm/s and 1 deg/s."""
    drawn = np.random.default_rng(4).standard_normal((len(cell.corners), 6))
    moves, camera = 0.025 * drawn * np.repeat([0.0175, 0.03], 3), cell.options.camera
    points, looks = corner_positions(cell.options.target), list[Corners]()
    for seen, pose, move in zip(cell.corners, cell.cam_from_target, moves, strict=True):
        share = seen.px[:, 1] / (camera.resolution[1] - 1) - 0.5
        at = apply_each(exp(share[:, None] * move) @ pose, points[seen.ids])
        still = project(camera, apply_each(np.tile(pose, (len(at), 1, 1)), points[seen.ids]))
        looks.append(replace(seen, px=seen.px + project(camera, at) - still))
    return showing(cell, looks)


def with_marks(cell, marked):
    """Looks at a board whose (k, 3) marks are elsewhere, by look and where they are drawn."""
    points, camera = corner_positions(cell.options.target), cell.options.camera
    looks = list[Corners]()
    for at, (seen, pose) in enumerate(zip(cell.corners, cell.cam_from_target, strict=True)):
        ends = (apply(pose, each[seen.ids]) for each in (marked(at, points), points))
        marked_px, drawn = (project(camera, end) for end in ends)
        looks.append(replace(seen, px=seen.px + marked_px - drawn))
    return showing(cell, looks)


def swelling(cell):
    """Paper that grows by 0.2 % about its first corner, until the end."""
    shares = 2e-3 * np.linspace(-1.0, 0.0, len(cell.corners))
    return with_marks(cell, lambda at, points: (1.0 + shares[at]) * points)


def sagging(cell):
    """A board on a flange whose ends along x hang by 0.5 mm below its middle where it is level."""
    normals = cell.robot.base_from_flange[:, 2, :3] @ cell.transforms["flange_from_target"][:3, 2]

    def marked(at, points):
        x = points[:, 0] - np.mean(points[:, 0])
        down = -5e-4 * normals[at] * (x / np.max(np.abs(x))) ** 2
        return points + np.outer(down, [0.0, 0.0, 1.0])

    return with_marks(cell, marked)


def on_the_way(cell):
    """Poses that are read when the arm is a twelfth of the way to its next stop."""
    poses = cell.robot.base_from_flange
    away = np.append(log(invert(poses[:-1]) @ poses[1:]), np.zeros((1, 6)), axis=0)
    return reporting(cell, base_from_flange=poses @ exp(0.08 * away))


def logged_once(axis):
    """One coordinate, or the angle about x of angles about z, y, x, that is one number."""

    def change(cell):
        poses = cell.robot.base_from_flange.copy()
        if axis < 3:
            poses[:, axis, 3] = poses[0, axis, 3]
            return reporting(cell, base_from_flange=poses)
        angles = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX")
        angles[:, 2] = angles[0, 2]
        poses[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
        return reporting(cell, base_from_flange=poses)

    return change


def with_another_tool(cell):
    """From the tenth view on, poses of a tool that is 60 mm longer and 20 mm to the side."""
    poses = cell.robot.base_from_flange.copy()
    poses[9:] = poses[9:] @ exp(np.array([0.0, 0.0, 0.3, 0.02, 0.0, 0.06]))
    return reporting(cell, base_from_flange=poses)


def wavy(cell):
    """Corners that are displaced by a smooth field of 0.25 px, which no lens model has."""
    rng = np.random.default_rng(cell.options.seed)
    waves = rng.normal(size=(2, 200, 2)) / (0.2 * cell.stated[""].resolution[0])
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, 200))
    weights = rng.normal(size=(2, 200)) * np.sqrt(2 / 200) * 0.25

    def away(px):
        angles = np.einsum("ni,cki->cnk", px, waves) + phases[:, None]
        return np.einsum("cnk,ck->nc", np.cos(angles), weights)

    return showing(cell, [replace(seen, px=seen.px + away(seen.px)) for seen in cell.corners])


def printed(*rows, since=0):
    """A board whose flat corners are where a (3, 3) matrix has them, from some view on."""
    matrix = np.eye(3)
    matrix[:2, :2] += rows

    def change(cell):
        flat, camera = corner_positions(cell.options.target), cell.options.camera

        def anew(corners, pose):
            before, after = (
                project(camera, places[corners.ids] @ pose[:3, :3].T + pose[:3, 3])
                for places in (flat, flat @ matrix.T)
            )
            return replace(corners, px=corners.px + after - before)

        later = map(anew, cell.corners[since:], cell.cam_from_target[since:])
        return showing(cell, [*cell.corners[:since], *later])

    return change


def later(since, **changes):
    """Views from some on are those of a cell with other options."""

    def change(cell):
        other = simulate(replace(cell.options, **changes)).corners
        return showing(cell, [*cell.corners[:since], *other[since:]])

    return change


def rectified_midway(cell):
    """A driver that rectifies the pictures from the ninth view on."""
    camera = cell.options.camera
    flat = replace(camera, distortion=0.0 * camera.distortion)

    def rectified(corners):
        rays = np.pad(normalise(camera, corners.px), ((0, 0), (0, 1)), constant_values=1.0)
        return replace(corners, px=project(flat, rays))

    return showing(cell, [*cell.corners[:8], *map(rectified, cell.corners[8:])])


def zoomed_midway(cell):
    """A focal length that is longer by 2 % from the eighth view on."""
    return zoomed(cell, 0.02 * (np.arange(len(cell.corners)) >= 7))


def hit_midway(cell):
    """A principal point that is elsewhere from the eighth view on."""
    by = np.where(np.arange(len(cell.corners)) >= 7, 8.0, 0.0)[:, None] * [1.0, -1.0]
    pairs = zip(cell.corners, by, strict=True)
    return showing(cell, [replace(seen, px=seen.px + step) for seen, step in pairs])


def refocused(cell):
    """A focal length of its own in each view."""
    return zoomed(cell, np.random.default_rng(1).normal(0.0, 0.005, len(cell.corners)))


def exchanged(cell):
    """Two rows are exchanged, and one has the image of another."""
    poses, corners = cell.robot.base_from_flange.copy(), list(cell.corners)
    poses[[4, 9]] = poses[[9, 4]]
    corners[7] = replace(corners[2], view=7)
    return reporting(showing(cell, corners), base_from_flange=poses)


@dataclass(frozen=True)
class World:
    """A cell, what is changed about it, and what its calibration must say."""

    options: CellOptions
    change: Callable[[SimulatedCell], SimulatedCell] = unchanged
    joints: bool = False  # Whether joint angles are told.
    seed: int = 0
    status: str = ""  # Of the verdict.
    causes: tuple[str, ...] = ()  # The first ones, in their order.
    kinds: tuple[str, ...] = ()  # That are found.
    never: frozenset[str] = frozenset()  # Kinds that are not.
    words: tuple[str, ...] = ()  # Patterns of reasons.
    # Components of the edges whose squared error is chi-square; none where sigmas are not asked.
    of: tuple[int, int] = (0, 12)
    # What a chi-square of so many is multiplied by, where levels or what is held add to it.
    slack: float = 1.0
    figure: tuple[float, float] | None = None  # Of the pattern's first group: value, tolerance.


NONE, PLACE = (0, 0), (3, 6)


ARM = frozenset({"arm_errors"})
ANY = frozenset({*GROWING, *ARM, "board_shape", "wrong_views", "moved_at_once", "lens_field"})
WORLDS: dict[str, World] = {
    # Nothing is named where nothing is.
    "sound": World(FINE, joints=True, status="good", never=ANY),
    "sound to hand": World(replace(FINE, mount="eye-to-hand", views=30), status="good", never=ANY),
    "an arm errs and nothing grows": World(LITTLE_WRONG, never=GROWING, slack=2.0),
    # What happens once, or to some views.
    "lifted": World(
        FINE,
        lifted,
        causes=("moved_at_once",),
        words=("moved at once: from view 9 on",),
        never=frozenset({"moved_slowly", "weak_motion", "place", "calibration"}),
        of=NONE,
    ),
    "lifted in the last views": World(
        replace(FINE, views=30),
        lambda cell: moved_base(cell, (time_of(cell) > 0.3) * 1e-3 * np.eye(6)[5]),
        joints=True,
        causes=("something_moved",),
        words=("from view 24 on, the target.* or another load bends the arm",),
        of=NONE,
    ),
    "stops err in groups": World(
        replace(FINE, views=30), in_groups, seed=1, words=("last from stop to stop",), slack=2.0
    ),
    "views left out after a bump": World(
        CellOptions(views=30, dh_sigma_m=3e-4, dh_sigma_rad=3e-4),
        later(24, camera_moved_m=4e-3),
        seed=2,
        causes=("something_moved", "arm_errors"),
        words=("from view 24 on, the camera",),
        of=NONE,
    ),
    "rectified midway": World(
        OPEN,
        rectified_midway,
        causes=("focus",),
        words=("from view 8 on, its distortion is another one",),
        of=NONE,
    ),
    "bump": World(
        OPEN,
        later(9, camera_moved_m=2e-3),
        causes=("moved_at_once",),
        words=(r"The camera moved at once: from view 9 on, it is (\S+) mm",),
        figure=(2.0, 0.3),
        of=NONE,
    ),
    # By a single step it seems to creep, and it stands between the places otherwise.
    "knocked twice": World(
        replace(OPEN, views=26),
        knocked({8: [1.2e-3, 0.0, 6e-4], 17: [9e-4, 1e-3, 0.0]}),
        causes=("moved_at_once",),
        words=("twice: from view 8 on, .* and from view 17 on, .* from where it was in between",),
        never=GROWING,
        of=NONE,
    ),
    # By five repeatabilities: creep and errors that last explain it nearly as well.
    "knocked by little": World(
        replace(OPEN, views=28, robot_sigma_m=8e-5, robot_sigma_rad=1.4e-4),
        later(15, camera_moved_m=5e-4),
        causes=("moved_at_once",),
        words=("The camera moved at once: from view 15 on",),
        of=NONE,
    ),
    "lens zoomed midway": World(
        OPEN,
        zoomed_midway,
        causes=("focus",),
        words=("^The lens changed at once.*: from view 7 on, its focal length is",),
    ),
    "lens hit midway": World(
        OPEN,
        hit_midway,
        causes=("image_shifted",),
        words=("^From view 7 on, the images are shifted by .*, or the lens was hit",),
        of=NONE,
    ),
    "autofocus": World(
        replace(OPEN, pixel_sigma_px=0.02),
        refocused,
        causes=("focus",),
        words=("^The lens changes its focal length by",),
        of=NONE,
    ),
    "board exchanged midway": World(
        replace(OPEN, views=19),
        printed([0.01, 0.0], [0.0, 0.01], since=9),
        causes=("board_changed",),
        words=(r"from view 9 on.* (\S+) % larger", "target is another one"),
        # Its sigma is an eighth of it: each half is known by the noise of both.
        figure=(1.0, 0.25),
        of=NONE,
    ),
    # A size that is off by no more than stated is held, and no other cause is its residuals'.
    **{
        f"board within its stated size, {seed}": World(
            CellOptions(views=24),
            printed([1e-3, 0.0], [0.0, 1e-3]),
            seed=seed,
            never=frozenset({"board_changed", "lens", "moved_at_once", *ARM}),
        )
        for seed in (1, 5)
    },
    # Beyond an arm's repeatability, what a held size leaves is no riddle either.
    "board two sigma from its stated size": World(
        CellOptions(views=29, mount="eye-to-hand"),
        printed([2e-3, 0.0], [0.0, 2e-3]),
        causes=("unmeasured_board",),
        never=frozenset({"board_changed", "lens", "moved_at_once", "unexplained"}),
        of=NONE,
    ),
    # Of unlike parts, the views of the smaller one are left out.
    "board exchanged for the last views": World(
        replace(OPEN, views=19),
        printed([-1 / 6, 0.0], [0.0, -1 / 6], since=14),
        causes=("something_moved",),
        words=("from view 14 on, the camera, the target",),
        of=NONE,
    ),
    "exchanged rows": World(
        CellOptions(),
        exchanged,
        seed=3,
        status="check",
        words=(
            "^Views 4 and 9 are exchanged: the image of each fits the pose in the",
            "^View 7 was left out.*its image is of stop 2; its pose or its reading is wrong",
        ),
    ),
    "wrong views": World(
        replace(FINE, wrong_views=6), joints=True, kinds=("wrong_views",), words=("times the n",)
    ),
    # Lenses beyond their models.
    "wavy lens": World(replace(FINE, robot_sigma_m=1e-5), wavy, kinds=("lens_field",), of=PLACE),
    "wavy lens before lone tags": World(
        replace(FINE, robot_sigma_m=1e-5, target=LONE_TAGS),
        wavy,
        kinds=("lens_field",),
        words=("Or else the corners of lone tags were found off",),
    ),
    "focus follows the distance": World(FINE, breathing, kinds=("focus",)),
    "lens refocused once": World(
        FINE,
        zoomed_once(-0.005),
        causes=("focus",),
        words=(r"from view 9 on, its focal length is 0.5 % shorter",),
    ),
    "lens crept": World(
        replace(FINE, views=30),
        lambda cell: zoomed(cell, 0.012 * (time_of(cell) + 0.5)),
        causes=("focus",),
        words=(r"The lens crept.*its focal length became 1.2 % longer",),
    ),
    "images read while the arm creeps": World(
        replace(FINE, views=24, state_intrinsics=False),
        creeping,
        status="check",
        causes=("row_motion",),
        words=(r"first row and its last, by (\S+) px",),
        figure=(4.6, 0.7),
        never=frozenset({"wrong_views", "lens_field", "focus", "image_shifted"}),
    ),
    "paper that swells": World(
        replace(FINE, views=24),
        swelling,
        status="check",
        causes=("board_swells",),
        words=(r"The board grew by (\S+) % during the session",),
        figure=(0.2, 0.03),
        never=frozenset({"wrong_views", "arm_errors", "lens_grows", "window"}),
    ),
    "board that sags on the flange": World(
        replace(FINE, mount="eye-to-hand", views=24, state_intrinsics=False),
        sagging,
        causes=("board_sags",),
        words=(r"otherwise than upright, by (\S+) mm between",),
        figure=(0.5, 0.1),
        never=frozenset({"wrong_views", "row_motion", "focus", "lens_field", "arm_errors"}),
    ),
    # Poses that are not those of the images.
    "poses read on the way": World(
        FINE,
        on_the_way,
        status="bad",
        causes=("misread_poses",),
        words=(r"away from the next stop by (\S+) % of the way.*the pose was read later",),
        figure=(8.0, 1.0),
        of=NONE,
    ),
    "a height that was logged once": World(
        FINE,
        logged_once(2),
        causes=("misread_poses",),
        words=("^The robot's z is .* mm in all 20 rows, to the last digit",),
        of=NONE,
    ),
    "an angle that was logged once": World(
        FINE,
        logged_once(3),
        causes=("misread_poses",),
        words=("^The robot's angle about X is .* deg in all 20 rows.*moving axes ZYX",),
        of=NONE,
    ),
    "another tool midway": World(
        FINE,
        with_another_tool,
        words=(r"controller's tool .*by \((\S+), \S+, 60\) mm and 17 deg",),
        figure=(20.0, 0.5),
        of=NONE,
    ),
    # Boards that are not as drawn, or not as large as stated.
    "printed longer along one axis": World(
        FINE,
        printed([0.012, 0.0], [0.0, 0.0]),
        causes=("board_size",),
        # One fact is one cause.
        never=frozenset({"board_shape"}),
        words=(r"the board is (\S+) % longer along its x",),
        figure=(1.2, 0.05),
        of=NONE,
    ),
    "bent board": World(
        replace(FINE, board_bow_m=3e-4), joints=True, words=("not flat",), of=(0, 6)
    ),
    "stretched and sheared board": World(
        FINE,
        printed([-5e-4, 7.5e-4], [7.5e-4, 5e-4]),
        joints=True,
        seed=4,
        kinds=("board_shape",),
        words=("longer along its y than along its x, by 0.1 %", "rows and columns meet at 89.91"),
    ),
    "size within what is stated": World(
        replace(FINE, board_scale=1.002),
        joints=True,
        seed=3,
        status="good",
        words=(r"% larger than stated.*does not contradict the stated size \(to within 0.1 %\)",),
    ),
    # As after printing with `fit to page`: the robot's measure is all that is left.
    "size contradicted": World(
        replace(FINE, board_scale=0.97),
        seed=3,
        status="check",
        never=ARM,
        words=("The result takes the robot's scale",),
    ),
    # Arms that are off, and noise that is no error of the arm.
    "wrong arm": World(WRONG_ARM, kinds=("arm_errors",), slack=1.3),
    "wrong arm with joints": World(WRONG_ARM, joints=True, never=ARM, slack=1.3),
    "coarse noise": World(
        replace(FINE, robot_sigma_rad=5e-4, robot_sigma_m=3e-4), never=ARM, slack=1.3
    ),
    # Off by hardly more than the arm repeats to, in all parameters alike: offsets of the joints
    # explain most of what twelve views show, and would leave the first and last link for exact.
    "links off by little": World(
        replace(FINE, robot="ur5e", views=12, dh_sigma_m=5e-5, dh_sigma_rad=5e-5),
        joints=True,
        seed=1,
    ),
    # Views from about one distance determine neither lens nor board, whose size is known to 0.1 %.
    "a board within its size is no other lens": World(
        CellOptions(
            views=14,
            board_scale=1.0007,
            camera=CAMERAS["fine"],
            tilt_rad=(0.15, 0.5),
            roll_rad=3.1,
            distance_m=(0.45, 0.7),
            cut_views=0.0,
            pixel_sigma_px=0.1,
            robot_sigma_rad=9e-5,
        ),
        joints=True,
        seed=34,
        never=frozenset({"lens"}),
        of=NONE,
    ),
    # Tilted by 3 degrees, a robot's rotation error of 0.02 deg moves the offset by 2 mm.
    "weak motion": World(
        CellOptions(
            tilt_rad=(0.0, 0.06),
            distance_m=(0.25, 0.9),
            robot_sigma_m=1e-4,
            robot_sigma_rad=4e-4,
            state_intrinsics=False,
        ),
        joints=True,
        status="check",
        causes=("weak_motion",),
    ),
}


# Another world shows the same of a calibration.
ALIKE = {
    "a board within its size is no other lens", "an angle that was logged once",
    "an arm errs and nothing grows", "another tool midway",
    "board exchanged for the last views", "board exchanged midway",
    "board two sigma from its stated size", "board within its stated size, 1",
    "board within its stated size, 5", "bump", "coarse noise", "focus follows the distance",
    "lens crept", "lens refocused once", "lens zoomed midway", "lifted in the last views",
    "lifted", "links off by little", "poses read on the way", "printed longer along one axis",
    "rectified midway", "size within what is stated", "sound to hand", "sound",
    "stops err in groups", "views left out after a bump", "wavy lens before lone tags",
    "knocked by little", "knocked twice", "lens hit midway", "weak motion",
    "wrong arm with joints", "wrong views",
}  # fmt: skip


@pytest.mark.parametrize("name", [slow(name) if name in ALIKE else name for name in WORLDS])
def test_the_error_of_a_world_is_named_and_its_sigmas_hold(name):
    world = WORLDS[name]
    cell = world.change(simulate(replace(world.options, seed=world.seed)))
    known = calibrated(cell, joints=world.joints)
    verdict, kinds = known.verdict, {finding.kind for finding in known.verdict.findings}
    assert verdict.status == (world.status or verdict.status)
    assert [cause.kind for cause in verdict.causes][: len(world.causes)] == [*world.causes]
    assert set(world.kinds) <= kinds
    assert not world.never & kinds
    reasons = [*verdict.reasons, *known.reasons.values()]
    for pattern in world.words:
        assert any(re.search(pattern, reason) for reason in reasons), (pattern, reasons)
    if world.figure is not None:
        (found, *_) = (it for reason in reasons if (it := re.search(world.words[0], reason)))
        value, tolerance = world.figure
        assert float(found.group(1)) == pytest.approx(value, abs=tolerance)
    if cell.wrong_views or "wrong_views" in world.never:
        assert set(range(len(cell.corners))) - set(known.used) == set(cell.wrong_views)
    error = error_of(cell, known)[slice(*world.of)]
    covariance = known.assessment.fit.whole[slice(*world.of), slice(*world.of)]
    square = float(error @ np.linalg.solve(covariance, error))
    # Chi-square exceeds this in one case of a thousand.
    assert not len(error) or square < world.slack * chi2.ppf(0.999, len(error))


@pytest.mark.parametrize(
    ("change", "kind", "true"),
    [
        # What moves a frame is opened and fair in tests/fit/test_frames_that_move.py, too.
        slow(tilted, "base_tilts", TILT_RAD_M),
        slow(partial(stretched, axis=0), "x_stretches", np.array([3e-3])),
        (stretched, "y_stretches", np.array([3e-3])),
        slow(partial(stretched, axis=2), "z_stretches", np.array([3e-3])),
        (skewed, "axes_skew", np.array([2e-3, 0.0, 0.0])),
        (grown, "arm_grows", np.array([1e-3])),
        slow(crept, "base_creeps", np.pad(-CREEP_M, (3, 0))),
        slow(turned_beside, "base_creeps", None),
        slow(bent_bracket, "bracket_bends", None),
        (warmed, "lens_grows", np.array([1.5e-3 * (1.0 - np.exp(-3.0)), 0.0, 0.0])),
        (sagged, "lens_sags", 1e-3 * np.eye(9)[[3, 7]].sum(axis=0)),
        slow(short, "stops_short", None),
        (short_of_lines, "stops_short", np.array([-0.01, 0.0, 0.0, 0.0, 0.0, 0.0])),
        slow(short_of_places, "stops_short", np.array([0.0, 0.0, 0.0, 0.0, 0.0, -2e-3])),
        (onwards, "moves_on", None),
    ],
)
def test_an_error_that_grows_is_named_recovered_and_in_the_budget(change, kind, true):
    """With reach, time, or gravity; of time, from the end, at which it is zero."""
    cell = change(simulate(replace(FINE, views=30)))
    known = calibrated(cell, joints=False)
    assert kind in {finding.kind for finding in known.verdict.findings}
    assert kind in next(iter(known.assessment.budget_mm.values()))
    if true is None:
        return
    fit = known.assessment.fit
    ((_, name),) = fit.unknowns.all_of(kind)
    # Up to six values: beyond four sigma once in some thousand.
    values = fit.values((kind, name)) + known.cell_fit.sizes.steadied_by(kind, name)
    assert np.all(np.abs(values - true) < 4.0 * fit.sigmas((kind, name)))
    # The mean of what follows the posture is a base that stands otherwise, and no other camera.
    held = slice(6 if kind == "base_tilts" or issubclass(KINDS[kind], Stretches) else 12)
    sigmas = np.sqrt(np.diag(fit.whole))[:12]
    assert np.all(np.abs(error_of(cell, known)[held]) < 4.5 * sigmas[held])


def test_no_bracket_bends_by_degrees():
    """Such turns that follow gravity are of another cause, which is not named for it."""
    cell = simulate(replace(FINE, views=30))
    turned = np.cross(-cell.robot.base_from_flange[:, 2, :3], [0.0, 0.0, 1.0])
    poses = cell.robot.base_from_flange @ exp(np.pad(0.03 * turned, ((0, 0), (0, 3))))
    verdict = calibrated(reporting(cell, base_from_flange=poses), joints=False).verdict
    assert verdict.status != "good"
    assert "bracket_bends" not in {finding.kind for finding in verdict.findings}


@pytest.mark.slow
def test_a_bracket_that_bends_alone_is_within_its_sigmas():
    """Across its length, which looks much as if the base were lower and the camera farther."""
    squares = []
    for seed in range(4):
        cell = simulate(replace(FINE, views=26, seed=seed))
        down = -cell.robot.base_from_flange[:, 2, :3]
        across, turned = down * [1.0, 1.0, 0.0], np.cross(down, [0.0, 0.0, 1.0])
        bends = np.append(6e-3 * turned, 8e-4 * across, axis=1)
        poses = cell.robot.base_from_flange @ exp(-bends)
        known = calibrated(reporting(cell, base_from_flange=poses), joints=False)
        assert known.verdict.causes[0].kind == "bracket_bends"
        mean = exp(bends.mean(axis=0)) @ cell.transforms["flange_from_cam"]
        away = log(invert(mean) @ known.assessment.edges["cam"].matrix)
        covariance = known.assessment.edges["cam"].covariance
        squares.append(float(away @ np.linalg.solve(covariance, away)) / 6.0)
    # A bend that no view shows has the size of what they show, and of such a bracket is up to three
    # times as large, in one of six components: (9 + 5) / 6, and of four cells less than 4. Without
    # it, 8.
    assert 0.05 < np.mean(squares) < 4.0


@pytest.mark.parametrize("panes", seeds(1, 3))
def test_a_tilted_window_is_no_motion_and_its_lens_seems_elsewhere(panes):
    """Picks through it are from where its lens seems to be; 6 mm of glass, or 4 mm tilted more."""
    squares = []
    for seed in panes:
        thick_m, tilt = ((6e-3, 35.0), (6e-3, 30.0), (4e-3, 45.0))[seed]
        cell = simulate(replace(OPEN, views=24, seed=seed))
        points, camera = corner_positions(cell.options.target), cell.options.camera
        normal = Rotation.from_euler("zx", [40.0 * seed, tilt], degrees=True).as_matrix()[:, 2]

        def nearer(seen, normal=normal, thick_m=thick_m):
            """Snell's law: shifts along the normal by t (1 - tan inside / tan outside)."""
            outside = np.arccos(seen @ normal / np.linalg.norm(seen, axis=-1))
            inside = np.arcsin(np.sin(outside) / 1.52)
            share = 1.0 - np.tan(inside) / np.tan(outside)
            return thick_m * share[..., None] * normal

        looks = list[Corners]()
        for seen, pose in zip(cell.corners, cell.cam_from_target, strict=True):
            at = apply(pose, points[seen.ids])
            moved = project(camera, at - nearer(at)) - project(camera, at)
            looks.append(replace(seen, px=seen.px + moved))
        known = calibrated(showing(cell, looks), joints=False)
        assert known.verdict.causes[0].kind == "window", known.verdict
        assert not {"row_motion", "wrong_views"} & {one.kind for one in known.verdict.findings}
        seems = compose(np.eye(3), nearer(np.array([0.0, 0.0, 1.0])))
        place = cell.transforms["flange_from_cam"] @ seems
        squares.append(misfit(known.assessment.edges["cam"], place) / 6.0)
    # Six squares each; as motion of rows, or as a good result, it is 4 and more each.
    assert np.mean(squares) < chi2.ppf(0.999, 6 * len(panes)) / (6 * len(panes)), squares


@pytest.mark.slow
def test_a_bump_is_in_the_covariance():
    """The answer is between both places, and as far from each as it says."""
    cell = simulate(FINE)
    on_flange = cell.transforms["flange_from_cam"]
    later = on_flange @ exp(np.array([0.001, 0, 0, 0, 1.6e-3, 1.2e-3]))
    flange = cell.robot.base_from_flange.copy()
    flange[10:] = flange[10:] @ on_flange @ invert(later)
    known = calibrated(reporting(cell, base_from_flange=flange), joints=False)
    assert known.verdict.causes[0].kind == "moved_at_once"
    edge = known.assessment.edges["cam"]
    # Without the bump in it, the covariance is a tenth of what it has to be.
    assert misfit(edge, on_flange) + misfit(edge, later) < 2 * 6 * 1.5


@pytest.mark.slow
def test_the_views_after_a_bump_are_calibrated_as_advised(tmp_path, monkeypatch):
    """Picks come after the session, when the camera stands where it was last."""
    cell = simulate(OPEN)
    session = cell_session(later(9, camera_moved_m=2e-3)(cell), "bumped", seen="corners")
    monkeypatch.chdir(tmp_path)
    session.save("bumped")
    advised = calibrate(session).verdict.causes[0].do
    assert advised.words.endswith("or calibrate the 9 views after it alone.")
    assert advised.command == "visioncal calibrate SESSION -o NEW --views 9-17"
    options = ("calibrate", "bumped", "-o", "after", "--no-report", "--no-recording", "--views")
    assert visioncal(*options, "9-17").status == 0
    after = Calibration.load("after")
    assert {cause.kind for cause in after.verdict.causes} == {"few_stops"}
    assert [view.view for view in after.views] == list(range(9, 18))
    edge = after.edges["flange_from_cam"]
    moved = simulate(replace(OPEN, camera_moved_m=2e-3)).transforms["flange_from_cam"]
    away = invert(moved) @ edge.matrix
    # By chance one cell in a hundred is farther away.
    assert 1e3 * np.linalg.norm(away[:3, 3]) < 3.0 * edge.sigma_mm
    refused = visioncal(*options, "8-0")
    assert (refused.status, "as 1-12,14" in refused.said) == (2, True)
