"""A live cell in memory: an arm on trapezoids, a camera that warps the board, a clock of its own.

Nothing waits: the clock is moved on by whoever sleeps, exposes or talks to a device.
"""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.types import Camera, FloatArray
from visioncal.estimation.problem_parts import Noise
from visioncal.live.drivers.protocols import ArmState, Frame, Safety
from visioncal.live.simulated.machine import Motion
from visioncal.planning.cell import Limits, PlanCell
from visioncal.planning.plan import Stop
from visioncal.planning.plan_file import PlanFile
from visioncal.planning.purposes import purpose_of
from visioncal.robot import Robot, load_robot
from visioncal.simulation import CellOptions, simulate
from visioncal.vision.boards.charuco import charuco_board
from visioncal.vision.camera import matrix_3x3

# Of the fakes: a controller's cycle, a camera's frame period and exposure [s].
CYCLE_S, PERIOD_S, EXPOSURE_S = 0.002, 1.0 / 30.0, 0.01
# A small image is enough for corners to a tenth of a pixel, and quick to make.
LENS = Camera("brown", (640, 400), np.array([500.0, 500.0, 320.0, 200.0]), np.zeros(5))
_PX_A_SQUARE = 40


@dataclass
class FakeClock:
    """Time that passes only when somebody lets it."""

    seconds: float = 1000.0

    def now(self) -> float:
        """The time [s]."""
        return self.seconds

    def sleep(self, seconds: float) -> None:
        """Lets time pass."""
        self.seconds += seconds

    def unix_offset_s(self) -> float:
        """What makes the time a UNIX time [s]."""
        return 1.7e9


@dataclass
class FakeArm:
    """An arm whose joints go straight to their goal by trapezoids, and what may befall it.

    For `trembling_s` after each motion it swings by `tremble_rad`, unseen by its own encoders if
    `hidden`. `fails_at` seconds after a motion began, `failure` happens: `gone`, or a stop by its
    name. `stale` names what it tells as it was at the beginning: `joints`.
    """

    cell: PlanCell
    clock: FakeClock
    q0: FloatArray
    name: str = "fake ur5e"
    trembling_s: float = 0.0
    tremble_rad: float = 0.0
    hidden: bool = False
    failure: str = ""
    fails_at: float = 0.1
    halted: int = 0
    moves: int = 0
    stale: str = ""
    motion: Motion | None = None
    _stuck: FloatArray | None = None

    def true_q(self, at: float) -> FloatArray:
        """Where the joints really are [rad]."""
        q, since = self._smooth(at)
        if since is not None and since < self.trembling_s:
            share = 1.0 - since / self.trembling_s
            q = q + self.tremble_rad * share * np.sin(2 * np.pi * 11.0 * since)
        return q

    def true_flange(self, at: float) -> FloatArray:
        """Where the flange really is."""
        return self.cell.robot.base_from_flange(self.true_q(at)[None])[0]

    def _smooth(self, at: float) -> tuple[FloatArray, float | None]:
        """The joints of the trapezoid, and for how long they have been at its end."""
        if self.motion is None:
            return self.q0, None
        since = at - self.motion.ends_s
        return self.motion.at(at)[0], since if since >= 0.0 else None

    @property
    def begun(self) -> float:
        """When the motion began [s]."""
        return np.inf if self.motion is None else self.motion.begins_s

    def state(self) -> ArmState:
        """What its encoders say."""
        self.clock.sleep(CYCLE_S)
        now = self.clock.now()
        fails = self.failure and now - self.begun > self.fails_at
        if fails and self.failure == "gone":
            raise DriverError("fake ur5e: the link is lost.", next_step="Check the cable.")
        safety: Safety = "normal"
        if fails and self.failure in ("protective-stop", "emergency-stop"):
            safety = self.failure
            self._freeze()
        q = self._smooth(now)[0] if self.hidden else self.true_q(now)
        if self._stuck is not None:
            q = self._stuck
        dq = np.zeros(6) if self._stuck is not None else self._speed(now)
        pose = self.cell.robot.base_from_flange(q[None])[0]
        if self.stale == "joints":
            q = self.q0
        load, driven = (1.25, np.array([0.0, 0.0, 0.04])), (np.full(6, 0.5), np.full(6, 31.0))
        return ArmState(now, pose, q.copy(), dq, np.eye(4), *load, *driven, safety)

    def _speed(self, now: float) -> FloatArray:
        step = 1e-3
        pose = self._smooth if self.hidden else lambda at: (self.true_q(at), None)
        return (pose(now)[0] - pose(now - step)[0]) / step

    def _freeze(self) -> None:
        if self._stuck is None:
            self._stuck = self._smooth(self.clock.now())[0]

    def start_move(self, q: FloatArray, *, speed: float, acceleration: float) -> None:
        """Begins a trapezoid."""
        now = self.clock.now()
        self.q0 = self._smooth(now)[0]
        self.motion = Motion(now, self.q0, np.array(q), speed, acceleration)
        self.moves += 1

    def moving(self) -> bool:
        """Whether the trapezoid has not ended."""
        self.clock.sleep(CYCLE_S)
        if self._stuck is not None:
            return False
        return self.motion is not None and self._smooth(self.clock.now())[1] is None

    def halt(self) -> None:
        """Stands still from now on."""
        self.halted += 1
        self._freeze()

    def close(self) -> None:
        """Nothing is open."""


@dataclass
class FakeCamera:
    """A camera that sees the board where the true arm has it, blurred while that moves."""

    arm: FakeArm
    lens: Camera = LENS
    name: str = "fake camera"
    hidden_at: tuple[int, ...] = ()
    factory: Camera | None = None
    settings: dict[str, str | float] = field(default_factory=lambda: {"exposure_us": 10000.0})
    frames: int = 0
    noise: float = 1.0
    exposures: dict[float, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        target = self.arm.cell.target
        board = charuco_board(target)
        size = (target.columns * _PX_A_SQUARE, target.rows * _PX_A_SQUARE)
        self._print = cv2.copyMakeBorder(
            board.generateImage(size), *(_PX_A_SQUARE // 2,) * 4, cv2.BORDER_CONSTANT, value=255
        )
        width, height = self.lens.resolution
        # Fresh noise is a part of a larger picture of it, which is quicker than drawing it anew.
        self._rng = np.random.default_rng(3)
        self._noise = self._rng.standard_normal((height + 50, width + 50)).astype(np.float32)

    @property
    def resolution(self) -> tuple[int, int]:
        """Of the lens."""
        return self.lens.resolution

    def frame(self, **_: float) -> Frame:
        """A picture of the true arm's view, smeared where that moves."""
        self.frames += 1
        begun = self.arm.clock.now()
        middle = begun + 0.5 * EXPOSURE_S
        self.arm.clock.sleep(PERIOD_S)
        self.exposures[middle] = self.arm.true_flange(middle)
        moments = begun + EXPOSURE_S * np.array([0.1, 0.5, 0.9])
        poses = [self.arm.true_flange(moment) for moment in moments]
        if np.allclose(poses[0], poses[2], atol=1e-7):
            poses = poses[1:2]
        image = np.mean([self._seen(pose) for pose in poses], axis=0)
        if self.arm.moves in self.hidden_at:
            image = np.full_like(image, 110.0)
        top, left = self._rng.integers(0, 50, 2)
        height, width = image.shape
        noisy = image + self.noise * self._noise[top : top + height, left : left + width]
        return Frame(np.clip(np.rint(noisy), 0, 255).astype(np.uint8), middle, EXPOSURE_S)

    def _seen(self, base_from_flange: FloatArray) -> FloatArray:
        cell = self.arm.cell
        pose = cell.seen_from(base_from_flange[None])[0]
        scale = cell.target.square_m / _PX_A_SQUARE
        edge = 0.5 * cell.target.square_m
        board_from_px = np.array([[scale, 0, -edge], [0, scale, -edge], [0, 0, 1.0]])
        board_from_px[:2, 2] += 0.5 * scale
        warp = matrix_3x3(self.lens) @ pose[:3, [0, 1, 3]] @ board_from_px
        flags = cv2.INTER_AREA
        size = self.lens.resolution
        seen = cv2.warpPerspective(self._print, warp, size, flags=flags, borderValue=120)
        return cv2.GaussianBlur(seen, (0, 0), 0.7).astype(np.float32)

    def close(self) -> None:
        """Nothing is open."""


def true_cell(options: CellOptions) -> PlanCell:
    """The cell as it is, but for the arm's errors."""
    x, z = simulate(replace(options, views=1, motion="free")).transforms.values()
    noise = Noise.of_robot(options.robot_sigma_rad, options.robot_sigma_m)
    arm, seen = load_robot(options.robot), (options.camera, options.target)
    return PlanCell(options.mount, arm, *seen, x, z, 0.0, 0.0, noise, options.pixel_sigma_px)


def postures_in_view(options: CellOptions, count: int) -> FloatArray:
    """(k, n) random postures from which the simulated camera sees the whole board [rad]."""
    free = replace(options, views=count, motion="free", branches=True, roll_rad=np.pi)
    return simulate(replace(free, cut_views=0.0)).robot.joints


def fake_plan(stops: int = 5, seed: int = 2) -> PlanFile:
    """A plan whose stops all see the board; its ways are not looked at."""
    drawn = {"views": stops, "seed": seed, "cut_views": 0.0}
    options = CellOptions(robot="ur5e", camera=LENS, **drawn)
    # The simulated camera sits close to the wrist: the links are thin, so that nothing is near.
    document = load_robot("ur5e").document
    joints = [{**value, "body_radius_m": 0.01} for value in document["joint"]]
    thin = Robot.from_document({**document, "joint": joints})
    limits = Limits(clearance_m=0.0, floor_m=None)
    cell = replace(true_cell(options), limits=limits, robot=thin)
    q = simulate(options).robot.joints
    none = np.zeros((0, 6))
    planned = tuple(Stop(at, value, none, f"words of stop {at}") for at, value in enumerate(q, 1))
    return PlanFile(cell, purpose_of("hand-eye"), planned, "0" * 64, q[0] + 0.002)


def fake_devices(plan: PlanFile, **changes) -> tuple[FakeArm, FakeCamera]:
    """An arm that stands at the plan's start, and a camera."""
    start = plan.stops[0].q if plan.start_q is None else plan.start_q
    arm = FakeArm(plan.cell, FakeClock(), start, **changes)
    return arm, FakeCamera(arm, plan.cell.camera)
