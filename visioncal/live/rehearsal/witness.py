"""Accuracy of a recording of a simulated cell, and of its calibration, against the truth."""

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
from visioncal.live.planning.plan_file import PlanFile
from visioncal.live.rehearsal.bench import Bench
from visioncal.live.rehearsal.truth import TruthClient
from visioncal.results import Calibration
from visioncal.simulation.arms import forward

# False-alarm probability of the chi-square test, and factor on the sigmas: errors of one board's
# corners are correlated by hundredths of a pixel, and joints deviate from their encoders, which a
# covariance of independent noise underestimates.
_CHANCE, _SIGMA_FACTOR = 1e-3, 1.5


@dataclass(eq=False)
class Witness:
    """Watcher that compares recorded poses with the true ones at the middle of each exposure.

    Attributes:
        away_mm: Distance of the true flange from that of the true arm at the recorded joints, for
            each view: residual motion and repeatability [mm].
    """

    bench: Bench
    away_mm: list[float] = field(default_factory=list)

    def stepped(self, step: CaptureEvent) -> None:
        """Compares a view."""
        view = step.found
        if not isinstance(view, TakenView) or view.state.q is None:
            return
        with closing(TruthClient(self.bench.controller.host)) as truth:
            true_flange = truth.state([view.frame.stamp_s]).base_from_flange[0]
        recorded = forward(self.bench.cell.truth.robot.true_arm, view.state.q[None])[0]
        self.away_mm.append(pose_difference(recorded, true_flange)[0])


@dataclass(frozen=True)
class Pace:
    """Mean durations of the views of a recording [s].

    Attributes:
        motion_s: Motion, by speed and acceleration.
        driving_s: Overhead of starting and ending each part of the path.
        settling_s: Settling of arm and image.
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
    """Splits the duration of a recording from joints (n,) [rad] into motion, settling and the rest.

    The results are those of the plan's stops from the first on, in order.
    """
    q, motions = start_q, []
    for _, stop in zip(steps, plan.stops, strict=False):
        path = [q, *stop.via, stop.q]
        motions.append(JointPace.of(options).path_duration_s(path))
        q = stop.q
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
    """Chi-square test of the errors of all edges.

    Attributes:
        chi_square: Squared Mahalanobis distance of the errors.
        freedom: Degrees of freedom.
        limit: Limit of the test.
    """

    chi_square: float
    freedom: int
    limit: float

    @property
    def passed(self) -> bool:
        """Whether the errors are consistent with their covariance."""
        return self.chi_square <= self.limit


def check_edges(calibration: Calibration, transforms: Mapping[str, FloatArray]) -> EdgeCheck:
    """Tests the errors of all edges against true ones (4, 4) by name, with the joint covariance."""
    twists = np.concatenate(
        [log(invert(transforms[name]) @ edge.matrix) for name, edge in calibration.edges.items()]
    )
    squared = float(twists @ np.linalg.solve(calibration.joint_covariance, twists))
    return EdgeCheck(
        squared, twists.size, _SIGMA_FACTOR**2 * float(chi2_limit(_CHANCE, twists.size))
    )
