"""The joint fit of a calibration as the prior of a later look at the same cell."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import adjoint, exp, invert, log
from visioncal.core.types import FloatArray, IntArray, Target
from visioncal.estimation.appearance import (
    Appearance,
    LensBoardParameters,
    boards_basis,
    stated_board_sigma,
)
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.chain import edge_names
from visioncal.estimation.model_evidence import RepeatedStops
from visioncal.estimation.pose_errors import posture_correlation
from visioncal.estimation.problem_parts import Noise, State
from visioncal.results import Calibration
from visioncal.results.arm import FUNCTIONS
from visioncal.results.sections import BoardResult, FittedArm, JointFit, RigResult
from visioncal.robot import Robot, WeightFunctions
from visioncal.vision.targets import numbered_positions, target_from_document

# A noise scale with more degrees of freedom counts as known.
_MOST_FREEDOM = 1e6
# Correlation of the arm's errors from which a stop repeats a calibrated one.
_REPEATED = 0.5

ArmKind: TypeAlias = Literal["none", "model", "links", "poses"]


@dataclass(frozen=True, eq=False)
class CalibrationPrior:
    """The fit of a calibration: its unknowns, their covariance, and the noise."""

    calibration: Calibration  # The calibration.
    fit: JointFit  # Its section on the fit.
    # The printed targets by the session's names; that of an only one is empty.
    targets: Mapping[str, Target]
    boards: tuple[int, ...]  # (b,) indices, among the targets, of those with an edge.
    # The edges of the camera and of these boards, and the k values that all stops share: lens and
    # boards, then the arm.
    state: State
    covariance: FloatArray  # (6 + 6 b + k, 6 + 6 b + k) of edges and values.
    written: FloatArray  # (6 + 6 b + k, w) Jacobian of these by the unknowns as they are written.
    arm: ArmKind  # Parametrisation of the arm's errors.
    model: ArmModel | None  # The calibrated arm, for errors of its model.

    @classmethod
    def of(cls, calibration: Calibration) -> "CalibrationPrior":
        """Reads the prior from a calibration.

        Raises:
            DataError: The calibration has none: it was made with an instrument, or by an older
                version.
        """
        label, fit = f"calibration {calibration.session_name!r}", calibration.joint_fit
        if calibration.mount == "instrument":
            raise DataError(
                f"{label} was made with a measuring instrument; only one with a camera can be "
                "verified.",
                next_step="Calibrate the new readings, and compare both with visioncal diff.",
            )
        if fit is None:
            raise DataError(
                f"{label} does not hold the covariance of its fit (joint_fit): an older version "
                "made it.",
                next_step="Calibrate its recording again: visioncal calibrate recording.rrd -o "
                "FOLDER.",
            )
        try:
            return _read(calibration, fit)
        except (LookupError, TypeError, ValueError) as error:
            raise DataError(
                f"{label}: joint_fit cannot be read: {error!r}.",
                culprits=["joint_fit"],
                next_step="Calibrate its session again.",
            ) from error

    @property
    def free(self) -> LensBoardParameters | None:
        """Calibrated lens and boards with their free values; None without camera or target."""
        camera = self.calibration.camera
        if camera is None or not self.targets:
            return None
        targets, size = tuple(self.targets.values()), len(self.fit.looks)
        return LensBoardParameters(
            Appearance(camera.camera, _shape(self.calibration, self.targets)),
            boards_basis(targets),
            numbered_positions(targets),
            np.array(self.fit.looks, dtype=np.int64),
            np.zeros(size, dtype=bool),
            np.zeros((size, size)),
            np.zeros(size),
        )

    def noise(self, *, from_corners: bool) -> Noise:
        """The noise of one stop: of the flange, or of flange and measured poses combined.

        An uncertain level is raised to half the upper bound of its 95 % interval.
        """
        stated, uncertainty = self.calibration.noise, self.calibration.uncertainty
        of = "robot" if from_corners else "combined"
        if f"{of}_rotation_deg" not in stated:
            # Poses of another origin than the calibration's have its total residuals.
            rms = self.calibration.rms
            deg, mm = (rms.deg or 0.0) / np.sqrt(3), rms.mm / np.sqrt(3)
            return Noise.of_robot(float(np.deg2rad(deg)), 1e-3 * mm)
        intervals = {} if uncertainty is None else uncertainty.noise_95
        deg, mm = (
            max(stated[name], 0.5 * intervals.get(name, (0.0, 0.0))[1])
            for name in (f"{of}_rotation_deg", f"{of}_translation_mm")
        )
        arm = self.calibration.arm
        if arm is not None and arm.level == FUNCTIONS:
            # Functions of the joints have the error of a left-out stop at a new stop.
            mm = max(mm, arm.chosen.held_out_mm / np.sqrt(3))
            deg = max(deg, (arm.chosen.held_out_deg or 0.0) / np.sqrt(3))
        return Noise.of_robot(float(np.deg2rad(deg)), 1e-3 * mm)

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the estimated noise; limited, as more make no difference."""
        return min(self.calibration.noise_dof, _MOST_FREEDOM)

    def with_board_at(self, z: FloatArray, sigma: float) -> "CalibrationPrior":
        """Replaces the pose of a single board.

        Args:
            z: (4, 4) rough edge of the board.
            sigma: Its standard deviation about and along each axis [rad and m].
        """
        covariance = self.covariance.copy()
        covariance[6:12], covariance[:, 6:12] = 0.0, 0.0
        covariance[6:12, 6:12] = sigma**2 * np.eye(6)
        state = replace(self.state, edges=np.stack([self.state.edges[0], z]))
        return replace(self, state=state, covariance=covariance)

    def repeated(
        self, poses: FloatArray, boards: IntArray, stops: IntArray
    ) -> RepeatedStops | None:
        """The calibrated observations that those of a check repeat; None for none.

        Args:
            poses: (n, 4, 4) flange at each observation of the check.
            boards: (n,) index of the board that it shows.
            stops: (n,) its stop.
        """
        calibrated, count = self.fit.stops, len(poses)
        if calibrated is None or not len(calibrated.views):
            return None
        correlation = posture_correlation(np.concatenate([poses, exp(calibrated.poses)]))
        alike = np.where(boards[:, None] == np.array(calibrated.boards), 1.0, 0.0)
        near = alike * correlation[:count, count:]
        nearest = near.argmax(axis=1)
        repeating = np.flatnonzero(near.max(axis=1) > _REPEATED)
        chosen, first = np.unique(nearest[repeating], return_index=True)
        if not len(chosen):
            return None
        kept = np.append(np.arange(count), count + chosen)
        own = np.unique(calibrated.poses, axis=0, return_inverse=True)[1].reshape(-1)
        return RepeatedStops(
            repeating[first],
            calibrated.residuals[chosen],
            correlation[np.ix_(kept, kept)],
            np.append(stops, stops.max() + 1 + own[chosen]),
            self.written @ calibrated.by_noise @ self.written.T,
        )


def _read(calibration: Calibration, fit: JointFit) -> CalibrationPrior:
    names = fit.boards
    x_name, z_name = edge_names(calibration.mount)
    boards = [calibration.edges[f"{z_name}_{name}" if name else z_name].matrix for name in names]
    targets = {
        name: target_from_document(target, name or "target") for name, target in fit.targets.items()
    }
    values = np.zeros(0) if fit.arm is None else fit.arm.values
    jacobian = _jacobian(np.array(boards), len(fit.looks), len(values))
    if fit.covariance.shape != (jacobian.shape[1],) * 2:
        raise ValueError(f"covariance has the shape {fit.covariance.shape}")
    stops = fit.stops
    if stops is not None and not (
        stops.poses.shape == stops.residuals.shape == (len(stops.boards), 6)
        and stops.by_noise.shape == fit.covariance.shape
    ):
        raise ValueError(f"stops have {len(stops.boards)} boards and other shapes")
    return CalibrationPrior(
        calibration,
        fit,
        targets,
        tuple(list(targets).index(name) for name in names) if targets else (0,),
        State(
            np.stack([calibration.edges[x_name].matrix, *boards]),
            np.concatenate([np.zeros(len(fit.looks)), values]),
        ),
        jacobian @ fit.covariance @ jacobian.T,
        jacobian,
        "none" if fit.arm is None else fit.arm.of,
        fitted_model(calibration.calibrated_robot, fit.arm),
    )


def _jacobian(boards: FloatArray, looks: int, arm: int) -> FloatArray:
    """Jacobian of edges and values with respect to the unknowns as they are written.

    Written are the edges of the camera and of the first board, then lens and boards, then the
    pose of each further of the (b, 4, 4) boards relative to the first, and the arm.
    """
    edges = 6 + 6 * len(boards)
    jacobian = np.eye(edges + looks + arm)
    # Rows in the order of edges and values.
    order = [*range(12), *range(12 + looks, edges + looks), *range(12, 12 + looks)]
    jacobian[: edges + looks] = jacobian[order]
    for index, transform in enumerate(adjoint(invert(boards[1:]) @ boards[0])):
        # z_k exp(d_k) = z_1 exp(d_1) exp(-d) target_1_from_target_k
        row, column = 12 + 6 * index, 12 + looks + 6 * index
        jacobian[row : row + 6, 6:12] = transform
        jacobian[row : row + 6, column : column + 6] = -transform
    return jacobian


def fitted_model(arm: Robot | None, fitted: FittedArm | None) -> ArmModel | None:
    """The arm's model linearised at its estimate; None for errors of another kind."""
    # The geometry is part of the arm; errors that depend on the loads of a stop are in the values.
    if fitted is None or fitted.of != "model" or arm is None:
        return None
    flange_from_reported, weights = fitted.flange_from_reported, fitted.weights
    if flange_from_reported is None or weights is None:
        raise ValueError("arm.flange_from_reported or arm.weights is missing")
    mounted = np.zeros((arm.joint_count + 1, 6))
    mounted[-1] = log(invert(flange_from_reported))
    parts, shape = fitted.weight_functions, (4 * arm.joint_count, -1)
    return ArmModel(
        arm.corrected(mounted),
        flange_from_reported,
        weights,
        np.zeros(len(fitted.values)) if fitted.by_stop is None else fitted.by_stop,
        1.0 if fitted.torque_nm is None else fitted.torque_nm,
        fitted.yielding,
        None if parts is None else WeightFunctions(tuple(part.reshape(shape) for part in parts)),
    )


def _shape(calibration: Calibration, targets: Mapping[str, Target]) -> FloatArray:
    """(s,) estimated shape values of the targets; zero for those that were not estimated."""
    shapes: dict[str, BoardResult | RigResult] = {**calibration.boards, **calibration.rigs}
    only = calibration.board or calibration.rig
    if only is not None:
        shapes[""] = only
    stated = {name: np.zeros(len(stated_board_sigma(target))) for name, target in targets.items()}
    return np.concatenate(
        [zeros + shapes[name].values if name in shapes else zeros for name, zeros in stated.items()]
    )
