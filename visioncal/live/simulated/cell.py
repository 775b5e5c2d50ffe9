"""A simulated cell to record live: the truth, what its user would know of it, and its devices."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from visioncal.core.errors import DriverError
from visioncal.core.transforms import exp
from visioncal.core.types import Camera, FloatArray
from visioncal.live.capture.cell import HostClock, LiveCell
from visioncal.live.capture.recording import CaptureEvent
from visioncal.live.capture.take import TakenView
from visioncal.live.drivers.protocols import Frame
from visioncal.live.drivers.ur import UrArm
from visioncal.live.simulated.controller import spawn
from visioncal.live.simulated.machine import ControllerOptions, TrueState
from visioncal.planning.cell import TYPICAL_NOISE, TYPICAL_PX, Limits, PlanCell
from visioncal.robot import load_robot
from visioncal.simulation import CellOptions, SimulatedCell, simulate
from visioncal.simulation.arms import ArmOptions
from visioncal.simulation.render import LiveView

# Errors of the user's guesses of both edges, as measured by ruler and by eye [m, rad].
GUESS_M, GUESS_RAD = 0.02, float(np.deg2rad(5.0))
_ROBOT = "ur5e"
# Joint offsets that have changed since the factory calibration.
_WORN = ArmOptions(offset_sigma_rad=3e-4)


class SimulatedCamera:
    """Camera device that observes a simulated cell with the arm's true joints.

    It free-runs as a real camera does: exposures start at regular times, whether or not requested.

    Args:
        cell: The cell: its true arm, edges and lens, its board and its noise. Its true arm must be
            the one whose joints are given.
        true_joints: Returns the arm's true joints, (k, n) [rad], at k past moments of the monotonic
            clock, (k,) [s]. After its DriverError the last known joints are used: a camera goes on
            working when a controller dies.
        rate_hz: Pictures per second.
        exposure_s: Exposure time [s].
        clock: The clock.
    """

    name = "simulated camera"

    def __init__(
        self,
        cell: SimulatedCell,
        true_joints: Callable[[FloatArray], FloatArray],
        *,
        rate_hz: float = 15.0,
        exposure_s: float = 0.008,
        clock: HostClock | None = None,
    ) -> None:
        self._view, self._true_joints = LiveView(cell), true_joints
        self._clock = clock or HostClock()
        self._rate_hz, self._exposure_s = rate_hz, exposure_s
        self._start = self._clock.now()
        self._last: FloatArray | None = None
        self.is_unplugged = False
        self.resolution = cell.camera().camera.resolution
        # The cell's stated intrinsics.
        self.factory: Camera | None = cell.stated[""] if cell.camera().state_intrinsics else None
        settings: dict[str, str | float] = {"exposure_us": 1e6 * exposure_s, "rate_hz": rate_hz}
        self.settings: Mapping[str, str | float] = MappingProxyType(settings)

    def frame(self, *, timeout_s: float = 1.0) -> Frame:
        """Returns a picture whose exposure began after the call; raises DriverError."""
        requested_at = self._clock.now()
        exposure_s, rate_hz = self._exposure_s, self._rate_hz
        start = self._start + np.ceil((requested_at - self._start) * rate_hz) / rate_hz
        is_late = start + exposure_s > requested_at + timeout_s
        if is_late or self.is_unplugged:
            self._clock.sleep(timeout_s)
            raise DriverError(
                f"The {self.name} gave no picture within {timeout_s:g} s.",
                culprits=[self.name],
                next_step="Look at its cable and its power.",
            )
        self._clock.sleep(max(start + exposure_s - requested_at, 0.0))
        middle_s = start + 0.5 * exposure_s
        try:
            joints = self._true_joints(np.linspace(start, start + exposure_s, 5))
        except DriverError:
            if self._last is None:
                raise
            joints = self._last
        self._last = joints[-1:]
        return Frame(self._view.picture(joints), middle_s, exposure_s)

    def close(self) -> None:
        """Holds no resources."""


class Bench:
    """A simulated cell with a camera on the flange of a UR; the same seed gives the same cell.

    Where joints slipped, each stands by `slip_rad` beyond what its encoder reads.

    Once started, its controller is another process, and its camera renders the truth. It
    notes the truth of each view.

    Attributes:
        truth: The true arm, edges, lens and board.
        known: The user's prior knowledge: rough guesses and the factory's lens.
        views: The arm's true state in the middle of each view's exposure, with the view.
    """

    def __init__(self, seed: int, slip_rad: tuple[float, ...] = ()) -> None:
        options = CellOptions(robot=_ROBOT, views=1, cut_views=0.0, seed=seed)
        self._options = ControllerOptions(robot=_ROBOT, seed=seed, errors=_WORN, slip_rad=slip_rad)
        cell = simulate(options)
        true_arm = replace(cell.robot, true_arm=self._options.true_arm)
        self.truth = replace(cell, robots={"": true_arm})
        draws = np.random.default_rng([seed, 101]).standard_normal((2, 2, 3))
        directions = draws / np.linalg.norm(draws, axis=2, keepdims=True)
        errors = exp((directions * np.array([[GUESS_RAD], [GUESS_M]])).reshape(2, 6))
        x, z = self.truth.transforms.values()
        per_axis = float(np.sqrt(3.0))
        self.known = PlanCell(
            options.mount,
            load_robot(_ROBOT),
            self.truth.stated[""],
            options.target,
            x @ errors[0],
            z @ errors[1],
            GUESS_RAD / per_axis,
            GUESS_M / per_axis,
            TYPICAL_NOISE,
            TYPICAL_PX,
            # The floor is 0.1 m below base and board.
            Limits(floor_m=min(0.0, float(z[2, 3])) - 0.1),
        )
        self.views: list[tuple[TakenView, TrueState]] = []

    def start(self, q: FloatArray) -> None:
        """Starts the controller, its arm at a posture [rad]; raises DriverError."""
        self.controller = spawn(replace(self._options, q=tuple(q.tolist())))

    @contextmanager
    def connected(self) -> Iterator[LiveCell]:
        """Opens the arm as a recording does, and closes it; raises DriverError."""
        camera = SimulatedCamera(
            self.truth, lambda at_s: self.controller.state(at_s.tolist()).q, rate_hz=30.0
        )
        with closing(UrArm(self.controller.host)) as arm:
            yield LiveCell(arm, camera)

    def close(self) -> None:
        """Ends the controller."""
        self.controller.close()

    def note(self, step: CaptureEvent) -> None:
        """Notes the truth of a view."""
        if isinstance(step.found, TakenView):
            state = self.controller.state([step.found.frame.stamp_s])
            self.views.append((step.found, state))
