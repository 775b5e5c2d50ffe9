"""Identifiability of a calibrated arm, and its predicted accuracy over its workspace."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.guess.joints import JointReading
from visioncal.core.choices import Convention
from visioncal.core.number_format import figure, listed
from visioncal.core.threads import one_blas_thread
from visioncal.core.types import FloatArray
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.armpair import ArmData, ArmPair
from visioncal.estimation.identifiability import (
    Identifiability,
    Indices,
    Jacobians,
    Move,
    joint_words,
    joints_to_move,
    missing_parameters,
    null_words,
)
from visioncal.estimation.parameters import (
    Parameter,
    free_parameters,
    parameter_jacobian,
    parameter_moves,
)
from visioncal.estimation.solve import whitened
from visioncal.estimation.stop_influence import stop_influence
from visioncal.estimation.workspace import postures
from visioncal.results.arm import (
    ArmParameter,
    ArmResult,
    Observability,
    StopInfluence,
    WorkspacePlace,
    WorkspaceSigma,
)
from visioncal.robot import (
    DHTable,
    Robot,
    convert_table,
    parallel_axes,
    table_from_document,
    table_of,
)

# Number of postures sampled for a map of the accuracy.
_PLACES = 200


@dataclass(frozen=True, eq=False)
class Estimate:
    """Estimate of one parameter of the arm's table, [rad or m]."""

    parameter: Parameter  # The parameter.
    nominal: float  # Its nominal value.
    identified: float  # Its estimate.
    # Standard deviation of the estimate. A parameter that the stops do not determine stays close to
    # its nominal value and keeps its prior sigma.
    sigma: float


@dataclass(frozen=True, eq=False)
class ArmIdentifiability:
    """Identifiability of the arm's parameters."""

    convention: Convention  # Convention of the table whose parameters are estimated.
    estimates: tuple[Estimate, ...]  # Its free parameters.
    # Numbers of parameters: identifiable by any stops, determined by these.
    counts: Identifiability
    # Observability indices; None where the stops determine nothing of the arm.
    indices: Indices | None
    # Undetermined combinations in words, first those that no stops determine.
    not_determined: tuple[str, ...]
    advice: str  # Which stops to add; empty where none would determine more.
    # (m,) share by which the mean predicted variance at `places` would grow without each stop, lens
    # and board held.
    influence: FloatArray
    places: FloatArray  # (k, 3) positions of the flange over the workspace, in the base frame [m].
    sigmas_m: FloatArray  # (k,) predicted position sigma of what the flange carries there [m].
    # (l, 3) positions of the flange at random postures within the stops' joint ranges [m].
    near: FloatArray
    near_sigmas_m: FloatArray  # (l,) the same sigma there [m].

    def add_to(
        self, result: ArmResult, robot: Robot, views: Sequence[int], lost: JointReading | None
    ) -> ArmResult:
        """Adds the identifiability to the arm's section of a calibration.

        Args:
            result: The section.
            robot: The nominal arm.
            views: (m,) view of each stop.
            lost: Reading of a joint with a lost zero.
        """
        ordered = sorted(
            zip(self.influence.tolist(), views, strict=True), key=lambda pair: -pair[0]
        )
        indices = self.indices
        figures = {} if indices is None else {"condition": indices.condition, **vars(indices)}
        return replace(
            result,
            convention=self.convention,
            parameters=tuple(_arm_parameter(estimate, robot, lost) for estimate in self.estimates),
            workspace_sigma_mm=WorkspaceSigma(
                1e3 * float(np.median(self.sigmas_m)), 1e3 * float(np.quantile(self.sigmas_m, 0.95))
            ),
            workspace_map=_map(self.places, self.sigmas_m),
            measured_map=_map(self.near, self.near_sigmas_m),
            observability=Observability(
                columns=self.counts.columns,
                identifiable=self.counts.identifiable,
                determined=self.counts.determined,
                **figures,
            ),
            not_determined=self.not_determined,
            stops=tuple(StopInfluence(view, share) for share, view in ordered),
        )


def _map(places: FloatArray, sigmas_m: FloatArray) -> tuple[WorkspacePlace, ...]:
    rows = np.column_stack([places, 1e3 * sigmas_m])[:_PLACES]
    return tuple(WorkspacePlace(*row) for row in rows.tolist())


def _arm_parameter(estimate: Estimate, robot: Robot, lost: JointReading | None) -> ArmParameter:
    joint, nominal = estimate.parameter.joint, estimate.nominal
    if lost is not None and estimate.parameter.name == "theta_rad":
        # The fit starts at the zero that was found; changes are reported from the stated one.
        nominal -= float(robot.chain.functions[joint, 1] * lost.zeros[joint])
    return ArmParameter(
        joint=robot.joint_names[joint],
        name=estimate.parameter.name,
        nominal=nominal,
        identified=estimate.identified,
        change=estimate.identified - nominal,
        sigma=estimate.sigma,
    )


def identify_arm(arm: ArmData, convention: Convention | None = None) -> ArmIdentifiability:
    """Computes which parameters of an arm the stops determine, and how accurate the arm is.

    Args:
        arm: The observations of the arm.
        convention: Convention of the table; None for the stated one, or Hayati's where axes are
            nearly parallel, as it has no singularity there.
    """
    anywhere = postures(arm.model.robot)
    shares = np.random.default_rng(0).uniform(size=(_PLACES, arm.q.shape[1]))
    near = arm.q.min(axis=0) + shares * np.ptp(arm.q, axis=0)
    with one_blas_thread():
        tables = _tables(arm.model, convention)
        weight = arm.pair.weight(arm.noise, arm.measured)
        by_errors = _error_jacobians(arm, anywhere, weight)
        by_parameters = _parameter_jacobians(arm, tables, anywhere, weight)
        counts = Identifiability.of(_jacobians_at_stops(arm), by_errors)
        words = [*null_words(by_parameters, tables.parameters, arm.model.nominal)]
        advice = ""
        if counts.missing.size:
            named = missing_parameters(
                by_parameters, by_errors, counts.missing, tables.parameters, arm.model.nominal
            )
            moves = _moves(arm, counts, weight)
            words.append(_missing_words(named, moves, arm.model.nominal))
            advice = _advice(words[-1], moves, counts, arm.model.nominal)
        place = arm.place_jacobian(anywhere)[0]
        sigmas_m, near_sigmas_m = (arm.place_sigmas_m(array) for array in (anywhere, near))
        fitted = (arm.problem, arm.state, arm.noise)
        influence = stop_influence(*fitted, arm.stops, place, arm.chain)
    return ArmIdentifiability(
        convention=tables.before.convention,
        estimates=tuple(_estimates(arm, tables)),
        counts=counts,
        indices=Indices.of(counts.values, len(arm.stops)) if len(counts.values) else None,
        not_determined=tuple(words),
        advice=advice,
        influence=influence,
        places=arm.model.robot.base_from_flange(anywhere)[:, :3, 3],
        sigmas_m=sigmas_m,
        near=arm.model.robot.base_from_flange(near)[:, :3, 3],
        near_sigmas_m=near_sigmas_m,
    )


@dataclass(frozen=True, eq=False)
class _Tables:
    """Nominal and calibrated tables, and the Jacobian (k, p) of the k free parameters by errors."""

    before: DHTable
    after: DHTable
    parameters: tuple[Parameter, ...]
    jacobian: FloatArray


def _tables(model: ArmModel, convention: Convention | None) -> _Tables:
    nominal = model.nominal
    has_table = "convention" in nominal.document
    before = table_from_document(nominal.document) if has_table else table_of(nominal, "standard")
    if convention is None and parallel_axes(nominal).any():
        convention = "hayati"
    before = convert_table(before, convention or before.convention)
    after = table_of(model.bare, before.convention, like=before)
    parameters = free_parameters(model, before)
    return _Tables(before, after, parameters, parameter_moves(model, after, parameters))


def _jacobians_at_stops(arm: ArmData) -> Jacobians:
    """Whitened Jacobians of the stops by frames and arm errors."""
    _, jacobian = whitened(arm.problem, arm.state, arm.noise, arm.measured)
    flat = jacobian.reshape(-1, arm.problem.size)
    return Jacobians(flat[:, arm.frames], flat[:, arm.columns[arm.model.is_kept]] * arm.error_rad)


def _error_jacobians(arm: ArmData, q: FloatArray, weight: FloatArray) -> Jacobians:
    """Jacobians by frames and arm errors at (k, n) postures, weighted as for the stops' noise."""
    flange = arm.model.base_from_flange(q)
    return _pair_jacobians(
        arm.pair, flange, arm.model.basis_without_harmonics(q) * arm.error_rad, weight
    )


def _parameter_jacobians(
    arm: ArmData, tables: _Tables, q: FloatArray, weight: FloatArray
) -> Jacobians:
    """Jacobians by frames and table parameters, at the nominal arm with its exact axes."""
    model, parameters = arm.model, tables.parameters
    jacobian = parameter_jacobian(tables.before, parameters, q, model.flange_from_reported)
    flange = model.nominal.base_from_flange(q) @ model.flange_from_reported
    units = [parameter.unit for parameter in parameters]
    return _pair_jacobians(arm.pair, flange, jacobian * units, weight)


def _pair_jacobians(
    pair: ArmPair, flange: FloatArray, flange_jacobian: FloatArray, weight: FloatArray
) -> Jacobians:
    """Jacobians of the pair by the frames at both ends, and through a (k, 6, p) flange Jacobian."""
    by_flange = weight @ pair.at(flange)[0].by_errors
    frames, arm = by_flange @ pair.frame_jacobian(flange), by_flange @ flange_jacobian
    return Jacobians(frames.reshape(-1, 12), arm.reshape(-1, flange_jacobian.shape[2]))


def _moves(arm: ArmData, counts: Identifiability, weight: FloatArray) -> tuple[Move, ...]:
    """Joint moves that would determine what is missing, assuming equal noise at all stops."""

    def count(q: FloatArray) -> int:
        return _error_jacobians(arm, q, weight).count_determined()

    return joints_to_move(arm.model.robot, arm.q, count, counts.identifiable - counts.determined)


def _estimates(arm: ArmData, tables: _Tables) -> Iterator[Estimate]:
    links = arm.error_rad * arm.model.weights.get("links", 1.0)
    jacobian = tables.jacobian
    sigmas = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, arm.arm_covariance, jacobian))
    for parameter, sigma, row in zip(tables.parameters, sigmas, jacobian, strict=True):
        # A parameter that base or flange absorbs keeps its prior sigma.
        prior_sigma = 0.0 if row.any() else links * parameter.unit
        yield Estimate(
            parameter,
            parameter.value(tables.before),
            parameter.value(tables.after),
            float(max(sigma, prior_sigma)),
        )


def _missing_words(named: str, moves: Sequence[Move], robot: Robot) -> str:
    if not moves:
        return f"these stops do not determine {named}"
    first, *others = (
        (joint_words(move.joint, robot), _distance_words(move.moved, move.joint, robot))
        for move in moves
    )
    moved = listed(
        [f"{first[0]} moved by {first[1]}", *(f"{name} by {distance}" for name, distance in others)]
    )
    return f"{moved} only, too little to determine {named}"


def _advice(words: str, moves: Sequence[Move], counts: Identifiability, robot: Robot) -> str:
    further = "Add stops in which the arm stands otherwise, all over the workspace."
    if moves:
        joints = [
            f"joint {move.joint + 1} by {_distance_words(move.wanted, move.joint, robot)}"
            for move in moves
        ]
        further = f"Add stops that move {listed(joints)} or more."
    return (
        f"The stops determine {counts.determined} of the {counts.identifiable} identifiable values "
        f"of this arm and its frames: {words}. What is not "
        f"determined stays about as stated. {further}"
    )


def _distance_words(distance: float, joint: int, robot: Robot) -> str:
    if robot.chain.prismatic[joint]:
        return f"{figure(1e3 * distance)} mm"
    return f"{figure(float(np.rad2deg(distance)))} deg"
