"""Identifiability of a calibrated arm, and its predicted accuracy all over its workspace."""

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
from visioncal.estimation.excitation_advice import Move, joints_to_move
from visioncal.estimation.identifiability import (
    Identifiability,
    Indices,
    Jacobians,
    count_determined,
    identifiability,
)
from visioncal.estimation.null_space import (
    dominant_words,
    imitated,
    joint_words,
    null_of,
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

# So many places are enough for a map.
_PLACES = 200


@dataclass(frozen=True, eq=False)
class Estimate:
    """A number of the arm's table.

    Attributes:
        parameter: Which.
        nominal: As stated [rad or m].
        identified: As found.
        sigma: Standard deviation of what was found. What the stops do not determine keeps about
            what was stated, and the sigma of the arm's errors.
    """

    parameter: Parameter
    nominal: float
    identified: float
    sigma: float


@dataclass(frozen=True, eq=False)
class ArmIdentifiability:
    """Identifiability of the arm's parameters.

    Attributes:
        convention: Of the table whose numbers are estimated.
        estimates: Its numbers that are not held.
        counts: What the stops determine, and what any stops could.
        indices: How well; None where they determine nothing of the arm.
        not_determined: What they do not, in words: first what no stops determine.
        advice: What to do where other stops would determine more; empty where they would not.
        influence: (m,) by which share the mean predicted variance of the places below would grow
            without each stop, lens and board as they are.
        places: (k, 3) of the flange all over the workspace, in the base's frame [m].
        sigmas_m: (k,) predicted sigma of the place of what the flange carries there [m].
        near: (l, 3) of the flange at random postures in the ranges of the stops' joints [m].
        near_sigmas_m: (l,) the same sigma there [m].
    """

    convention: Convention
    estimates: tuple[Estimate, ...]
    counts: Identifiability
    indices: Indices | None
    not_determined: tuple[str, ...]
    advice: str
    influence: FloatArray
    places: FloatArray
    sigmas_m: FloatArray
    near: FloatArray
    near_sigmas_m: FloatArray

    def in_result(
        self, result: ArmResult, robot: Robot, views: Sequence[int], lost: JointReading | None
    ) -> ArmResult:
        """A section of a calibration, with this in it.

        Args:
            result: The section.
            robot: The nominal arm.
            views: (m,) by which views the stops go.
            lost: A joint whose zero was found far from where it was stated.
        """
        ordered = sorted(
            zip(self.influence.tolist(), views, strict=True), key=lambda pair: -pair[0]
        )
        return replace(
            result,
            convention=self.convention,
            parameters=tuple(_number(estimate, robot, lost) for estimate in self.estimates),
            workspace_sigma_mm=WorkspaceSigma(
                1e3 * float(np.median(self.sigmas_m)),
                1e3 * float(np.quantile(self.sigmas_m, 0.95)),
            ),
            workspace_map=_map(self.places, self.sigmas_m),
            measured_map=_map(self.near, self.near_sigmas_m),
            observability=self._observability(),
            not_determined=self.not_determined,
            stops=tuple(StopInfluence(view, share) for share, view in ordered),
        )

    def _observability(self) -> Observability:
        indices = self.indices
        figures = {} if indices is None else {"condition": indices.condition, **vars(indices)}
        return Observability(
            columns=self.counts.columns,
            identifiable=self.counts.identifiable,
            determined=self.counts.determined,
            **figures,
        )


def _map(places: FloatArray, sigmas_m: FloatArray) -> tuple[WorkspacePlace, ...]:
    rows = np.column_stack([places, 1e3 * sigmas_m])[:_PLACES]
    return tuple(WorkspacePlace(*row) for row in rows.tolist())


def _number(estimate: Estimate, robot: Robot, lost: JointReading | None) -> ArmParameter:
    joint, nominal = estimate.parameter.joint, estimate.nominal
    if lost is not None and estimate.parameter.name == "theta_rad":
        # The fit starts where the zero was found; what is reported starts where it was stated.
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
    """Says what the stops determine of an arm, and how accurate it is.

    Args:
        arm: What was seen of it.
        convention: Of the table that is wanted; None for the stated one, or Hayati's where axes are
            nearly parallel, which has no leap there.
    """
    anywhere = postures(arm.model.robot)
    shares = np.random.default_rng(0).uniform(size=(_PLACES, arm.q.shape[1]))
    near = arm.q.min(axis=0) + shares * np.ptp(arm.q, axis=0)
    with one_blas_thread():
        numbers = _numbers(arm.model, convention)
        weight = arm.pair.weight(arm.noise, arm.measured)
        by_arm, by_numbers = _at(arm, anywhere, weight), _by_numbers(arm, numbers, anywhere, weight)
        counts, null = identifiability(_at_stops(arm), by_arm), null_of(by_numbers)
        missing = None
        if counts.missing.size:
            missing = _Missing(
                imitated(by_numbers, by_arm, counts.missing), _moves(arm, counts, weight)
            )
        place = arm.place_jacobian(anywhere)[0]
        sigmas_m, near_sigmas_m = (arm.place_sigmas_m(array) for array in (anywhere, near))
        fitted = (arm.problem, arm.state, arm.noise)
        influence = stop_influence(*fitted, arm.stops, place, arm.chain)
    nominal = arm.model.nominal
    return ArmIdentifiability(
        convention=numbers.before.convention,
        estimates=tuple(_estimates(arm, numbers)),
        counts=counts,
        indices=Indices.of(counts.values, len(arm.stops)) if len(counts.values) else None,
        not_determined=(
            *null_words(null, numbers.parameters, nominal),
            *([_missing_words(missing, numbers.parameters, nominal)] if missing else []),
        ),
        advice=_advice(missing, counts, numbers.parameters, nominal) if missing else "",
        influence=influence,
        places=arm.model.robot.base_from_flange(anywhere)[:, :3, 3],
        sigmas_m=sigmas_m,
        near=arm.model.robot.base_from_flange(near)[:, :3, 3],
        near_sigmas_m=near_sigmas_m,
    )


@dataclass(frozen=True, eq=False)
class _Numbers:
    """The arm's table as stated and as found, and how its free numbers (k) move with the errors."""

    before: DHTable
    after: DHTable
    parameters: tuple[Parameter, ...]
    moves: FloatArray


@dataclass(frozen=True, eq=False)
class _Missing:
    """What numbers of the table (k, n) do what is not determined, and the joints to move."""

    changes: FloatArray
    moves: tuple[Move, ...]


def _numbers(model: ArmModel, convention: Convention | None) -> _Numbers:
    before = _stated_table(model.nominal)
    if convention is None and parallel_axes(model.nominal).any():
        convention = "hayati"
    before = convert_table(before, convention or before.convention)
    after = table_of(model.bare, before.convention, like=before)
    parameters = free_parameters(model, before)
    return _Numbers(before, after, parameters, parameter_moves(model, after, parameters))


def _stated_table(robot: Robot) -> DHTable:
    if "convention" in robot.document:
        return table_from_document(robot.document)
    return table_of(robot, "standard")


def _at_stops(arm: ArmData) -> Jacobians:
    """The stops' slopes, in units of their noise."""
    _, jacobian = whitened(arm.problem, arm.state, arm.noise, arm.measured)
    flat = jacobian.reshape(-1, arm.problem.size)
    return Jacobians(flat[:, arm.frames], flat[:, arm.columns[arm.model.is_kept]] * arm.error_rad)


def _at(arm: ArmData, q: FloatArray, weight: FloatArray) -> Jacobians:
    """Slopes at any postures, in units of a noise like the stops'."""
    flange = arm.model.base_from_flange(q)
    return _through(arm.pair, flange, arm.model.kept_basis(q) * arm.error_rad, weight)


def _by_numbers(arm: ArmData, numbers: _Numbers, q: FloatArray, weight: FloatArray) -> Jacobians:
    """Slopes by the nominal arm's numbers, whose axes are exactly as they are meant."""
    model, parameters = arm.model, numbers.parameters
    moved = parameter_jacobian(numbers.before, parameters, q, model.flange_from_reported)
    flange = model.nominal.base_from_flange(q) @ model.flange_from_reported
    return _through(arm.pair, flange, moved * [parameter.unit for parameter in parameters], weight)


def _through(pair: ArmPair, flange: FloatArray, moved: FloatArray, weight: FloatArray) -> Jacobians:
    """Slopes of the pair by the frames at both ends, and by (k, 6, p) motions of the flange."""
    carried = weight @ pair.at(flange)[0].by_errors
    frames, arm = carried @ pair.frame_jacobian(flange), carried @ moved
    return Jacobians(frames.reshape(-1, 12), arm.reshape(-1, moved.shape[2]))


def _moves(arm: ArmData, counts: Identifiability, weight: FloatArray) -> tuple[Move, ...]:
    """The joints that would determine what is missing, for noise that is alike at all stops."""

    def count(q: FloatArray) -> int:
        return count_determined(_at(arm, q, weight))

    return joints_to_move(arm.model.robot, arm.q, count, counts.identifiable - counts.determined)


def _estimates(arm: ArmData, numbers: _Numbers) -> Iterator[Estimate]:
    links = arm.error_rad * arm.model.weights.get("links", 1.0)
    sigmas = np.sqrt(np.einsum("ij,jk,ik->i", numbers.moves, arm.arm_covariance, numbers.moves))
    for parameter, sigma, moves in zip(numbers.parameters, sigmas, numbers.moves, strict=True):
        # Where the base or the flange takes a number's place it is as open as it was beforehand.
        known = 0.0 if moves.any() else links * parameter.unit
        yield Estimate(
            parameter,
            parameter.value(numbers.before),
            parameter.value(numbers.after),
            float(max(sigma, known)),
        )


def _missing_words(missing: _Missing, parameters: Sequence[Parameter], robot: Robot) -> str:
    named = dominant_words(missing.changes, parameters, robot)
    if not missing.moves:
        return f"these stops do not determine {named}"
    first, *others = (
        (joint_words(move.joint, robot), _length(move.moved, move.joint, robot))
        for move in missing.moves
    )
    moved = listed(
        [f"{first[0]} moved by {first[1]}", *(f"{name} by {way}" for name, way in others)]
    )
    return f"{moved} only, too little to determine {named}"


def _advice(
    missing: _Missing, counts: Identifiability, parameters: Sequence[Parameter], robot: Robot
) -> str:
    further = "Add stops in which the arm stands otherwise, all over the workspace."
    if missing.moves:
        joints = [
            f"joint {move.joint + 1} by {_length(move.wanted, move.joint, robot)}"
            for move in missing.moves
        ]
        further = f"Add stops that move {listed(joints)} or more."
    return (
        f"The stops determine {counts.determined} of the {counts.identifiable} identifiable values "
        f"of this arm and its frames: {_missing_words(missing, parameters, robot)}. What is not "
        f"determined stays about as stated. {further}"
    )


def _length(way: float, joint: int, robot: Robot) -> str:
    if robot.chain.prismatic[joint]:
        return f"{figure(1e3 * way)} mm"
    return f"{figure(float(np.rad2deg(way)))} deg"
