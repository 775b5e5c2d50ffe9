"""Predicted probability that picks land within a tolerance after a plan, and what limits it.

A pick is that of the verdict (`calibration.stages.need`): the camera observes an object as a stop
observes its target, and the robot goes there. Included are the errors of the camera's pose and the
noise of the flange at the pick, and at the observation where the flange carries the camera, those
of a lens that the stops determine, and those of an arm that recorded stops show, by which the
controller's own poses miss where targets are not corrected. The error of detecting the object is
not. Of a board that differs from its stated size by more than noise shows, the pick may be off by
more; the plan gives the share from which the need is not met.

A verdict judges by the noise that its own stops show. A plan counts as much as nine of ten sessions
of so many stops show at most, so that these meet the need.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.limits import NeedLimits
from visioncal.core.number_format import figure, percent
from visioncal.core.prediction import at_points, through, to_points
from visioncal.core.quantiles import chi2_limit, root_of
from visioncal.core.tolerance_probability import chance_within
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray, IntArray, Mask, Need
from visioncal.planning.cell import PlanCell
from visioncal.planning.information import (
    RecordedStops,
    World,
    is_of_lens,
    located_jacobian,
    parameters_of,
    shown_fit,
)
from visioncal.robot.errors import link_basis
from visioncal.vision.targets import corner_positions

# Share of sessions that show more noise than a plan counts.
_LARGER_NOISE = 0.1


def pick_jacobian(
    cell: PlanCell, q: FloatArray, recorded: RecordedStops | None, world: World
) -> FloatArray:
    """Jacobian (k, 6, p + a) of picks of things that the camera sees where stops see the board.

    Errors of the arm's links that recorded stops show act at the look, at the pick, and on the
    edges, which take up what is the same at all stops: the whole chain counts (as in
    `calibration.stages.need`), and else the camera's edge and lens alone.

    Args:
        cell: The cell.
        q: (k, n) joint angles of the stops [rad].
        recorded: Stops that were recorded already.
        world: Information on the p unknowns, and a that a fit does not estimate.

    Returns:
        By the errors of `World.joint_covariance`, of rotation [rad] and position [m], in the axes
        of what carries the camera: the flange, or the base. The size of things is not that of the
        board.
    """
    free, size = parameters_of(cell, recorded, estimates_lens=True), len(world.prior)
    jacobian = np.zeros((len(q), 6, size + world.unestimated.shape[2]))
    places, count, turn = corner_positions(cell.target), 12 + len(free.columns), cell.x[:3, :3]
    middle = places.mean(axis=0)
    if recorded is None or recorded.arm is None:
        slopes = located_jacobian(shown_fit(cell, q, recorded, free), middle)
    else:
        arm, of_boards = recorded.arm, free.columns[~is_of_lens(free)]
        # A thing's place does not follow the shape of the board, whose middle does.
        by_shape = free.basis[recorded.first_corner :][: len(places)].mean(axis=0)
        by_boards = by_shape[:, of_boards - len(free.appearance.values) + by_shape.shape[1]]
        basis = arm.sigma * link_basis(cell.robot, q)
        fit = shown_fit(cell, q, recorded, free, by_boards)
        fit = fit.with_arm(fit.robots[0], replace(arm, basis=basis))
        turn = turn @ cell.cam_from_target(q)[:, :3, :3]
        slopes = turned(turn, to_points(middle) @ fit.slopes)
        first = size - basis.shape[2] if arm.is_estimated else size
        jacobian[:, :, first : first + basis.shape[2]] = slopes[:, :, count:]
    jacobian[:, :, :count] = slopes[:, :, :count]
    if recorded is not None and recorded.arm_picks is not None:
        # Errors of an arm do to the edges, and at look and pick, what the recorded stops show.
        root = recorded.edge_error_root
        jacobian[:, :, size : size + root.shape[1]] = jacobian[:, :, :12] @ root
    return jacobian


def pick_misses(cell: PlanCell, q: FloatArray, recorded: RecordedStops | None) -> FloatArray | None:
    """(k, 6) known errors of picks by the controller's own poses, in the axes of `pick_jacobian`.

    One that carries its camera looks in the posture of one stop and picks in that of another. None
    where targets are corrected, or no errors of the arm are estimated.
    """
    if recorded is None or recorded.arm_values is None:
        return None
    flange, middle = cell.robot.base_from_flange(q), corner_positions(cell.target).mean(axis=0)
    carrying = flange if cell.mount == "eye-in-hand" else np.eye(4)
    places = (carrying @ cell.x @ cell.cam_from_target(q) @ [*middle, 1.0])[:, :3]
    twists = adjoint(flange) @ link_basis(cell.robot, q) @ recorded.arm_values
    missed = (to_points(places) @ twists[:, :, None])[:, :, 0]
    if cell.mount == "eye-to-hand":
        return missed
    missed = missed - np.roll(missed, 1, axis=0)
    return turned(invert(flange)[:, :3, :3], missed[:, :, None])[:, :, 0]


def turned(rotations: FloatArray, errors: FloatArray) -> FloatArray:
    """Errors (k, 6, ...) of rotation and position along other axes, by (k, 3, 3) rotations."""
    return np.concatenate([rotations @ errors[:, :3], rotations @ errors[:, 3:]], axis=1)


@dataclass(frozen=True, eq=False)
class Picking:
    """Picks after a calibration from some candidates of a plan."""

    cells: Sequence[PlanCell]  # The guessed cell, and draws from its uncertainty.
    worlds: Sequence[World]  # The candidates' information in each of these.
    q: FloatArray  # (k, n) joint angles of the candidates [rad].
    need: Need  # Tolerance of the picks.
    recorded: RecordedStops | None = None  # Stops that were recorded already.

    @cached_property
    def _sights(self) -> tuple[tuple[FloatArray, FloatArray, FloatArray | None], ...]:
        """Picks at some candidates in each cell, by the unknowns and by the robot's noise.

        Each has an (m, 6, p + a) Jacobian, (2, m, 6, 6) covariances by the levels of rotation and
        position of this noise, at observation and pick, and (m, 6) known errors.
        """
        q = self.q[np.linspace(0, len(self.q) - 1, min(40, len(self.q))).astype(np.int64)]
        sights = list[tuple[FloatArray, FloatArray, FloatArray | None]]()
        for cell, world in zip(self.cells, self.worlds, strict=True):
            jacobian = pick_jacobian(cell, q, self.recorded, world)
            known = None if self.recorded is None else self.recorded.arm_picks
            if known is not None:
                halves = np.tile(0.5 * known[np.arange(len(q)) % len(known)], (2, 1, 1, 1))
                sights.append((jacobian, halves, None))
                continue
            # In the axes of what carries the camera: the flange, or the base.
            levels = cell.noise.robots[0][:, None] ** 2 * np.repeat(np.eye(2), 3, axis=1)
            covariances = np.tile((levels[:, None] * np.eye(6))[:, None], (1, len(q), 1, 1))
            if cell.mount == "eye-in-hand":
                middle = corner_positions(cell.target).mean(axis=0)
                points = (cell.x @ cell.cam_from_target(q) @ [*middle, 1.0])[:, :3]
                covariances += at_points(levels[:, None, :, None] * np.eye(6), points)
            sights.append((jacobian, covariances, pick_misses(cell, q, self.recorded)))
        return tuple(sights)

    @cached_property
    def _is_lens(self) -> Mask:
        """Mask of those free parameters of lens and boards that are the lens's."""
        return is_of_lens(parameters_of(self.cells[0], self.recorded, estimates_lens=True))

    @property
    def lens(self) -> IntArray:
        """Columns of the lens."""
        return 12 + np.flatnonzero(self._is_lens)

    @property
    def boards(self) -> IntArray:
        """Columns of the boards."""
        return 12 + np.flatnonzero(~self._is_lens)

    @cached_property
    def _held(self) -> IntArray:
        """Columns of a stated size of the board, which a calibration holds."""
        return self.boards[: 0 if self.recorded else None]

    def chance(
        self,
        rows: IntArray,
        *,
        size_share: float | None = None,
        known: IntArray | None = None,
        is_exact: bool = False,
        is_corrected: bool = False,
    ) -> float:
        """Probability that a pick lands within tolerance, calibrated from (m,) candidates.

        Args:
            rows: The candidates.
            size_share: Share by which the board differs from its stated size; None where it differs
                by no more than such stops show by chance.
            known: Columns that would be known; None for none.
            is_exact: Whether the robot would have no noise at observation and pick.
            is_corrected: Whether targets would be corrected for the calibrated arm.
        """
        turn_rad = np.inf if self.need.deg is None else float(np.deg2rad(self.need.deg))
        shift_m = np.inf if self.need.mm is None else 1e-3 * self.need.mm
        # Degrees of freedom of all noise, and of the robot's levels. A level that the noise of
        # corners hides is estimated from few: these are twice the square of its relative precision,
        # by the Fisher information of its square.
        stops = len(rows) + (0 if self.recorded is None else self.recorded.stops)
        # Recorded stops add as much as candidates do.
        each = self._known_levels[rows if len(rows) else slice(None)].mean(axis=0)
        by_level = (stops - 2) * each
        freedom = np.maximum([6 * stops - 12, *by_level], 1.0)
        growth, *levels = chi2_limit(_LARGER_NOISE, freedom) / freedom
        chances = []
        for (jacobian, noise, misses), world in zip(self._sights, self.worlds, strict=True):
            covariance, offsets = world.joint_covariance(rows), None if is_corrected else misses
            by_size, held_variances = covariance[:, self._held], np.diag(covariance)[self._held]
            square = (
                chi2_limit(_LARGER_NOISE, 1) * held_variances
                if size_share is None
                else size_share**2
            )
            # A verdict counts what the stops show of a held size by chance: its square is one of
            # a normal variable.
            covariance = growth * covariance + (by_size * square / held_variances**2) @ by_size.T
            if known is not None and len(known):
                cross = covariance[:, known]
                covariance = covariance - cross @ np.linalg.solve(cross[known], cross.T)
            covariances = through(jacobian, covariance)
            if not is_exact:
                covariances += np.einsum("l,lmij->mij", levels, noise)
            last = float(freedom[-1])
            chances.append(chance_within(covariances, turn_rad, shift_m, last, offsets))
        return float(np.mean(chances))

    @cached_property
    def _known_levels(self) -> FloatArray:
        """(k, 2) degrees of freedom that each candidate adds to the robot's levels of noise."""
        cell, factors = self.cells[0], self.worlds[0].factors[:, :6]
        # The carried edge moves with the flange.
        edge, first = (cell.x, 0) if cell.mount == "eye-in-hand" else (cell.z, 6)
        by_flange = factors[:, :, first : first + 6] @ adjoint(invert(edge))
        noise = by_flange.reshape(-1, 6, 2, 3) * cell.noise.robots[0][:, None]
        squares = np.einsum("kild,kjld->klij", noise, noise)
        return np.asarray(np.sum(squares**2, axis=(2, 3)))

    def condition(self, rows: IntArray) -> str:
        """Condition on the board's size on which (m,) stops meet the need, in words.

        It is empty where the board may differ by its stated sigma.
        """
        least = NeedLimits.probability[0]
        if not len(self._held):
            return ""
        sigma = float(self.worlds[0].prior[self._held[0], self._held[0]] ** -0.5)
        if self.chance(rows, size_share=sigma) >= least:
            return ""
        within = root_of(
            *(lambda share: least - self.chance(rows, size_share=share), 0.0, sigma, 0.01 * sigma)
        )
        return (
            f"as long as the board is as large as stated to {figure(100.0 * within)} %, which its "
            "square_sigma_m does not promise: measure it over its whole width, and state square_m "
            "and square_sigma_m"
        )

    def remedy(self, rows: IntArray) -> str:
        """Remedy that raises the probability with (m,) stops most, in words, and to how much."""
        by_words = {
            'a lens that is known (matrix, distortion and intrinsics = "hold" in session.toml)': (
                self.chance(rows, known=self.lens)
            ),
            "a board measured over its whole width (square_m and a smaller square_sigma_m)": (
                self.chance(rows, known=self.boards)
            ),
            "a robot without noise at the pick": self.chance(rows, is_exact=True),
            "a correction of each target for the calibrated arm (visioncal correct; corrected = "
            "true in [need])": self.chance(rows, is_corrected=True),
        }
        words, best = max(by_words.items(), key=lambda item: item[1])
        if best < self.chance(rows) + 0.01:
            return "a nearer camera or a larger board helps."
        rest = "" if best >= NeedLimits.probability[0] else "; so does a nearer camera"
        return f"{words} helps most, and would give {percent(best)}{rest}."

    def fewest(self, rows: IntArray) -> tuple[int, float]:
        """Least number of the first candidates that are enough, and the probability to reach.

        This is the required one, or nearly that of all of them.
        """
        # Stops that together add less to the probability are left out.
        share = min(NeedLimits.probability[0], self.chance(rows) - 0.01)
        # The probability rises with each stop: bisection.
        least, most = 0, len(rows)
        while least < most:
            middle = (least + most) // 2
            if self.chance(rows[:middle]) >= share:
                most = middle
            else:
                least = middle + 1
        return least, share


@dataclass(frozen=True)
class NeedPlanned:
    """Predicted probability that picks land within tolerance."""

    need: Need
    before: float  # Probability without the planned stops.
    probability: float  # The same with them.
    best: float  # The same with all candidates.
    limits: str  # Its limit, in words; empty where the need is met.
    condition: str = ""  # Condition on which the need is met, in words; empty where there is none.

    @property
    def met(self) -> bool:
        """Whether the probability is high enough."""
        return self.probability >= NeedLimits.probability[0]


def need_planned(picking: Picking, rows: IntArray, count: int) -> NeedPlanned:
    """Predicts picks after a plan of at most `count` stops (m,), and states what limits them."""
    every, least = np.arange(len(picking.q)), NeedLimits.probability[0]
    probability, best = picking.chance(rows), picking.chance(every)
    words = ""
    if probability < least:
        stops = f"{len(rows)} stops predict that {percent(probability)} of picks land within "
        words = f"{stops}{words_of(picking.need)}, but must predict {percent(least)}. "
    if words and best >= least:
        words += f"More than {count} stops are needed: all candidates give {percent(best)}."
    elif words:
        words += (
            f"More stops cannot reach it: all candidates together give {percent(best)}. Of what "
            f"can, {picking.remedy(every)}"
        )
    before, condition = picking.chance(rows[:0]), "" if words else picking.condition(rows)
    return NeedPlanned(picking.need, before, probability, best, words, condition)


def words_of(need: Need) -> str:
    """States a tolerance in words: `0.3 mm and 0.1 deg`."""
    return " and ".join(
        f"{figure(value)} {unit}"
        for value, unit in ((need.mm, "mm"), (need.deg, "deg"))
        if value is not None
    )


def check_need(need: Need, judged: str) -> None:
    """Refuses a need that a plan cannot be made for; raises DataError."""
    for name, value in (("mm", need.mm), ("deg", need.deg)):
        if value is not None and not 0.0 < value < np.inf:
            raise DataError(
                f"the need is {value} {name}, but must be a number above zero.",
                culprits=[f"need_{name}"],
            )
    if judged != "sight":
        raise DataError(
            "a need is of picks by the camera, and these stops are for the arm.",
            culprits=["need"],
            next_step="Plan for hand-eye, or leave the need out.",
        )
