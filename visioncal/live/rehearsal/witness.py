"""The accuracy of a recording of a simulated cell, and of its calibration, by what really is."""

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import invert, log, pose_difference
from visioncal.core.types import FloatArray
from visioncal.live.capture.core import CaptureEvent
from visioncal.live.capture.drive import JointPace
from visioncal.live.capture.options import CaptureOptions
from visioncal.live.capture.take import TakenView
from visioncal.live.planning.read_back import PlanFile
from visioncal.live.rehearsal.bench import Bench
from visioncal.live.rehearsal.truth import TruthClient
from visioncal.results import Calibration
from visioncal.simulation.arms import forward

# One rehearsal in a thousand errs by more although nothing is wrong, with sigmas that much larger:
# corners of one board err alike by hundredths of a pixel and joints rest beside their encoders,
# which a covariance of independent noise counts for too little.
_CHANCE, _LARGER = 1e-3, 1.5


@dataclass(eq=False)
class Witness:
    """A watcher that asks where the arm really was in the middle of each exposure.

    Attributes:
        bench: The simulated cell.
        away_mm: How far the flange was from where the recorded joints have the same, true arm, for
            each view: what moved, and how exactly the arm comes back to a posture [mm].
    """

    bench: Bench
    away_mm: list[float] = field(default_factory=list)

    def stepped(self, step: CaptureEvent) -> None:
        """Looks at a view."""
        found = step.found
        if not isinstance(found, TakenView) or found.state.q is None:
            return
        with closing(TruthClient(self.bench.controller.host)) as truth:
            really = truth.state([found.frame.stamp_s]).base_from_flange[0]
        recorded = forward(self.bench.cell.truth.robot.true_arm, found.state.q[None])[0]
        self.away_mm.append(pose_difference(recorded, really)[0])


@dataclass(frozen=True)
class Pace:
    """How long the views of a recording took, each on average [s].

    Attributes:
        views: How many there are.
        motion_s: The motion alone, by speed and acceleration.
        driving_s: What it took beyond that, to begin and to end each part of the way.
        settling_s: Until all stood still.
        added_s: Everything else: pictures, detection, checks, writing.
        most_added_s: The same of the slowest view.
    """

    views: int
    motion_s: float
    driving_s: float
    settling_s: float
    added_s: float
    most_added_s: float


def pace_of(
    steps: Sequence[CaptureEvent], plan: PlanFile, start_q: FloatArray, options: CaptureOptions
) -> Pace:
    """Tells motion and settling from what a recording adds to them.

    Args:
        steps: A recording of a plan's stops from the first on, in their order.
        plan: The stops.
        start_q: (n,) where the arm stood in the beginning [rad].
        options: Speed and acceleration.
    """
    here, motions = start_q, []
    for _, stop in zip(steps, plan.stops, strict=False):
        way = [here, *stop.via, stop.q]
        motions.append(JointPace.of(options).way_s(way))
        here = stop.q
    times = [step.times for step in steps]
    motion_s, added = float(np.mean(motions)), [time.worked_s for time in times]
    return Pace(
        len(steps),
        motion_s,
        float(np.mean([time.moved_s for time in times])) - motion_s,
        float(np.mean([time.settled_s for time in times])),
        float(np.mean(added)),
        max(added),
    )


@dataclass(frozen=True)
class EdgeCheck:
    """Whether the errors of all edges together are what their covariance lets expect.

    Attributes:
        chi_square: Their squared length in sigmas.
        freedom: Of how many numbers.
        limit: The most that is believed.
    """

    chi_square: float
    freedom: int
    limit: float

    @property
    def passed(self) -> bool:
        """Whether they are believed."""
        return self.chi_square <= self.limit


def explained(calibration: Calibration, transforms: Mapping[str, FloatArray]) -> EdgeCheck:
    """Weighs the errors of all edges by their joint covariance.

    Args:
        calibration: The result.
        transforms: (4, 4) true edges by name.
    """
    away = np.concatenate(
        [log(invert(transforms[name]) @ edge.matrix) for name, edge in calibration.edges.items()]
    )
    squared = float(away @ np.linalg.solve(calibration.joint_covariance, away))
    return EdgeCheck(squared, away.size, _LARGER**2 * float(chi2_limit(_CHANCE, away.size)))
