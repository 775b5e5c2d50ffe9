"""Stops for a measuring instrument that reads a point or a probe on the flange.

The information of a stop is that of the fit: the position of a point, or the pose of a 6D probe,
with the instrument's noise at its distance and the robot's own, by the instrument's place, the
probe's, and the arm's errors.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag, qr

from visioncal.core.choices import Criterion
from visioncal.core.errors import DataError
from visioncal.core.linalg import gram
from visioncal.core.number_format import counted, figure
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.fit import Fit
from visioncal.estimation.problem_parts import ANYTHING
from visioncal.planning.candidates import unwound
from visioncal.planning.cell import InstrumentCell
from visioncal.planning.design import Accuracy, Design, choose_stops
from visioncal.planning.information import (
    WEAK_SIGMA,
    World,
    arm_sigma,
    arm_size,
    mean_square,
    with_arm_errors,
    workspace_jacobian,
)
from visioncal.planning.path import ROUNDS, left_candidates, order_stops
from visioncal.planning.purposes import Purpose
from visioncal.planning.visibility import Occlusion
from visioncal.robot.errors import TWIST_UNITS

# Condition of Phi^T Phi, in mm and mrad, up to which the linear solution is numerically stable.
STABLE = 1e6


@dataclass(frozen=True, eq=False)
class InstrumentPlan:
    """Chosen stops, in driving order."""

    cell: InstrumentCell
    purpose: Purpose
    criterion: Criterion
    q: FloatArray  # (k, n) joint angles of the stops [rad].
    via: tuple[FloatArray, ...]  # (k,) postures (j, n) on the way to each.
    design: Design
    candidates: FloatArray  # (c, n) joint angles of the possible stops [rad].
    recorded: FloatArray  # (r, n) joint angles of the stops that are added to [rad].

    @cached_property
    def _identifiable(self) -> IntArray:
        """Columns of the parameters that readings all over the workspace can determine."""
        # Pivots pick one parameter of each redundant combination (Khalil and Dombre 2002, 11.4).
        _, pivots, order = qr(self._phi(self.candidates), mode="economic", pivoting=True)
        sizes = np.abs(np.diag(pivots))
        # Share of the largest pivot from which a parameter is identifiable.
        return np.sort(order[: int(np.sum(sizes > 1e-6 * sizes[0]))])

    def _phi(self, q: FloatArray) -> FloatArray:
        """Jacobian of the readings by all parameters, in m and rad: the same in mm and mrad."""
        jacobian = readings(self.cell, self.purpose, q).slopes
        links = np.tile(TWIST_UNITS, self.cell.robot.joint_count) * arm_sigma(self.purpose)
        if "links" in self.purpose.blocks:
            jacobian[:, :, 12 : 12 + len(links)] *= arm_sigma(self.purpose) / links
        rows = jacobian if self.cell.are_poses else jacobian[:, 3:]
        return rows.reshape(-1, jacobian.shape[2])

    @property
    def parameters(self) -> int:
        """Number of identifiable parameters of arm and frames."""
        return len(self._identifiable)

    def condition(self, q: FloatArray | None = None) -> float:
        """Condition number of Phi^T Phi over the identifiable parameters, in mm and mrad.

        Of the planned stops with the recorded ones, or of others at (k, n) `q` [rad].
        """
        q = np.vstack([self.recorded, self.q]) if q is None else q
        return float(np.linalg.cond(self._phi(q)[:, self._identifiable])) ** 2

    def sentences(self, seed: int) -> tuple[str, ...]:
        """The accuracy by the stops, and by as many random ones, in words."""
        rng = np.random.default_rng(seed)
        count = len(self.q) + len(self.recorded)
        chance = rng.choice(len(self.candidates), min(count, len(self.candidates)), replace=False)
        after = self._accuracy(self.design.predicted)
        if len(self.recorded):
            after = f"{self._accuracy(self.design.before)} before, {after} after"
        condition, random = self.condition(), self.condition(self.candidates[chance])
        holds = "below" if condition < STABLE else "NOT below"
        return (
            f"{self.purpose.name}: {counted(len(self.q), 'stop')}, {self.criterion}-optimal among "
            f"{len(self.candidates)} possible ones; {self.purpose.errors}, predicted sigma: "
            f"{after}",
            f"condition of Phi^T Phi over {self.parameters} parameters in mm and mrad: "
            f"{condition:.2g}, {holds} the {STABLE:.0e} of a stable solution (random stops: "
            f"{random:.2g})",
        )

    def _accuracy(self, known: Accuracy) -> str:
        """An accuracy in words; of a point without its rotation."""
        if self.cell.are_poses or known.is_open:
            return known.words
        return f"{figure(known.mm)} mm"


def plan_for_instrument(
    cell: InstrumentCell,
    purpose: Purpose,
    count: int,
    criterion: Criterion = "D",
    *,
    possible: int = 1500,
    seed: int = 0,
    recorded: FloatArray | None = None,
    start_q: FloatArray | None = None,
) -> InstrumentPlan:
    """Chooses stops at which the instrument sees the probe, and a safe way through them.

    Args:
        cell: The cell, by rough guesses.
        purpose: The errors of the arm that are unknown.
        count: Number of stops.
        criterion: See `choose_stops`.
        possible: Number of candidates.
        seed: Random seed of these.
        recorded: (r, n) joint angles of stops that are recorded already [rad]; None for none.
        start_q: (n,) where the arm stands [rad]; None where that is not known.

    Raises:
        DataError: The cell allows too few stops, or no safe way connects them.
    """
    recorded = np.zeros((0, cell.robot.joint_count)) if recorded is None else recorded
    candidates = _candidates(cell, possible, count, seed)
    left = np.arange(len(candidates))
    with one_blas_thread():
        world = _world(cell, purpose, candidates, recorded)
        for attempt in range(ROUNDS):
            design = choose_stops([world.of_candidates(left)], count, criterion)
            q = candidates[left[design.rows]]
            route = order_stops(cell, start_q, q, seed)
            if not route.unreachable:
                # The way to the first stop is not known without a start.
                via = (*[np.zeros((0, q.shape[1]))] * (start_q is None), *route.segments)
                q = q[list(route.order)]
                return InstrumentPlan(
                    cell, purpose, criterion, q, via, design, candidates, recorded
                )
            chosen = left[design.rows]
            left = left_candidates(candidates, left, chosen, route, missed_only=not attempt)
            if len(left) < count:
                break
    raise DataError(
        f"plan: no safe way through {counted(count, 'stop')} was found.",
        culprits=tuple(route.unreachable.values()),
        next_step="Make room around the arm, lower --clearance-mm, or ask for fewer stops.",
    )


def _candidates(cell: InstrumentCell, possible: int, least: int, seed: int) -> FloatArray:
    """Postures (k, n) within limits [rad], clear of everything, with the probe in sight."""
    robot, margin = cell.robot, cell.limits.joint_margin_rad
    rng, collisions = np.random.default_rng(seed), cell.collisions()
    shade = Occlusion(cell, np.zeros((1, 3)))
    # Half a turn either way is enough to reach any posture.
    turn = np.where(robot.chain.prismatic, np.inf, np.pi)
    low, high = (
        np.maximum(robot.lower_rad + margin, -turn),
        np.minimum(robot.upper_rad - margin, turn),
    )
    kept, lost = list[FloatArray](), {"the clearance": 0, "a line of sight": 0}
    # Draws of postures, 1000 each.
    for _ in range(60):
        q = rng.uniform(low, high, (1000, len(low)))
        clear = collisions.first_contact(q) < 0
        q, lost["the clearance"] = q[clear], lost["the clearance"] + int((~clear).sum())
        flange = robot.base_from_flange(q)
        hidden = shade.behind_boxes(flange) | shade.behind_arm(q)
        lost["a line of sight"] += int(hidden.sum())
        kept += list(q[~hidden])
        if len(kept) >= possible:
            break
    if len(kept) < least:
        worst = max(lost, key=lambda limit: lost[limit])
        raise DataError(
            f"plan: {len(kept)} possible stops were found, but must be {least}; most in the way "
            f"is {worst}, which kept out {lost[worst]} postures.",
            culprits=[worst],
            next_step="Put the instrument where the arm comes less between it and the probe "
            "(--cam), or lower --clearance-mm.",
        )
    return unwound(cell, collisions, np.array(kept[:possible]))


def readings(cell: InstrumentCell, purpose: Purpose, q: FloatArray) -> Fit:
    """The readings at joints (k, n) [rad], by the cell's guesses."""
    flange = cell.robot.base_from_flange(q)
    bare = Fit.of_stops(cell.mount, (cell.x, cell.z), flange, cell.noise)
    sigma_rad = cell.instrument.sigma_rad if cell.are_poses else None
    variances = np.full((len(q), 6), ANYTHING if sigma_rad is None else sigma_rad**2)
    variances[:, 3:] = cell.instrument.sigmas_m(bare.measured[:, :3, 3])[:, None] ** 2
    covariance = variances[:, :, None] * np.eye(6)
    fit = Fit.of_stops(cell.mount, (cell.x, cell.z), flange, cell.noise, covariance)
    return with_arm_errors(cell, purpose, fit, q)


def _world(cell: InstrumentCell, purpose: Purpose, q: FloatArray, recorded: FloatArray) -> World:
    """Information of candidates (k, n) and of recorded stops (r, n) [rad]."""
    factors = readings(cell, purpose, q).whitened
    size, arm = factors.shape[2], arm_size(cell.robot, purpose)
    prior = block_diag(np.eye(12) * WEAK_SIGMA**-2.0, arm_sigma(purpose) ** -2.0 * np.eye(arm))
    known = np.zeros((size, size))
    if len(recorded):
        rows = readings(cell, purpose, recorded).whitened
        known = gram(rows, rows)
    place, turn = map(mean_square, workspace_jacobian(cell, purpose, np.zeros(3)))
    if not cell.are_poses:
        turn[6:9] = turn[:, 6:9] = 0.0  # A point has no rotation.
    none = np.zeros((len(q), 6, 0))
    return World(factors, prior, known, place, place, turn, none, np.zeros((size, 0)))
