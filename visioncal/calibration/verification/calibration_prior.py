"""What a calibration rests on, as a later look at the same cell needs it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import adjoint, invert, log
from visioncal.core.types import FloatArray, Target
from visioncal.estimation.appearance import (
    Appearance,
    LensBoardParameters,
    board_prior,
    boards_basis,
)
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.chain import edge_names
from visioncal.estimation.parts import Noise, State
from visioncal.results import Calibration
from visioncal.results.sections import BoardResult, FittedArm, JointFit, RigResult
from visioncal.robot import Robot, WeightFunctions
from visioncal.vision.camera import intrinsics
from visioncal.vision.targets import numbered_positions, target_from_document

# A scale that is known by more degrees of freedom is as good as known.
_MOST_FREEDOM = 1e6

ArmKind: TypeAlias = Literal["none", "model", "links", "poses"]


@dataclass(frozen=True, eq=False)
class CalibrationPrior:
    """The fit of a calibration: its unknowns, their covariance, and the noise.

    Attributes:
        calibration: Whose.
        targets: What was printed, by the session's names for it; that of an only one is empty.
        boards: (b,) places among the targets, of those that were placed.
        state: The edges of the camera and of these boards, and the k values of what all stops
            share: lens and boards, then the arm.
        covariance: (6 + 6 b + k, 6 + 6 b + k) of edges and values.
        looks: (l,) which values of lens and board are among them.
        arm: What the last of them are errors of.
        model: The calibrated arm, where they are of its model.
    """

    calibration: Calibration
    targets: Mapping[str, Target]
    boards: tuple[int, ...]
    state: State
    covariance: FloatArray
    looks: tuple[int, ...]
    arm: ArmKind
    model: ArmModel | None

    @classmethod
    def of(cls, calibration: Calibration) -> "CalibrationPrior":
        """Reads it from a calibration.

        Raises:
            DataError: The calibration does not say it: an instrument made it, or an older version.
        """
        if calibration.mount == "instrument":
            raise DataError(
                f"calibration {calibration.session_name!r} was made with a measuring instrument; "
                "only one with a camera can be verified.",
                next_step="Calibrate the new readings, and compare both with visioncal diff.",
            )
        fit = calibration.joint_fit
        if fit is None:
            raise DataError(
                f"calibration {calibration.session_name!r} does not hold the covariance of its "
                "fit (joint_fit): an older version made it.",
                next_step="Calibrate its recording again: visioncal calibrate recording.rrd -o "
                "FOLDER.",
            )
        try:
            return _read(calibration, fit)
        except (LookupError, TypeError, ValueError) as error:
            raise DataError(
                f"calibration {calibration.session_name!r}: joint_fit cannot be read: {error!r}.",
                culprits=["joint_fit"],
                next_step="Calibrate its session again.",
            ) from error

    @property
    def free(self) -> LensBoardParameters | None:
        """Lens and board as the calibration found them; None without a camera or a target."""
        camera = self.calibration.camera
        if camera is None or not self.targets:
            return None
        targets, size = tuple(self.targets.values()), len(self.looks)
        return LensBoardParameters(
            Appearance(camera.camera, _shape(self.calibration, self.targets)),
            boards_basis(targets),
            numbered_positions(targets),
            np.array(self.looks, dtype=np.int64),
            np.zeros(size, dtype=bool),
            np.zeros((size, size)),
            np.zeros(size),
        )

    def noise(self, *, from_corners: bool) -> Noise:
        """The noise of one stop: of the flange, or with that of the camera's poses as one.

        A level that the calibration knows badly is taken for what its 95 % interval allows.
        """
        stated, known = self.calibration.noise, self.calibration.uncertainty
        of = "robot" if from_corners else "combined"
        if f"{of}_rotation_deg" not in stated:
            # Poses of another origin than the calibration's: as they scattered there in all.
            rms = self.calibration.rms
            deg, mm = (rms.deg or 0.0) / np.sqrt(3), rms.mm / np.sqrt(3)
            return Noise.of_robot(float(np.deg2rad(deg)), 1e-3 * mm)
        intervals = {} if known is None else known.noise_95
        deg, mm = (
            max(stated[name], 0.5 * intervals.get(name, (0.0, 0.0))[1])
            for name in (f"{of}_rotation_deg", f"{of}_translation_mm")
        )
        arm = self.calibration.arm
        if arm is not None and arm.functions is not None:
            # What functions of the joints err by at a fresh stop is as at one that was left out.
            mm = max(mm, arm.chosen.held_out_mm / np.sqrt(3))
            deg = max(deg, (arm.chosen.held_out_deg or 0.0) / np.sqrt(3))
        return Noise.of_robot(float(np.deg2rad(deg)), 1e-3 * mm)

    @property
    def freedom(self) -> float:
        """Degrees of freedom that the noise was estimated with, at most as many as matter."""
        return min(self.calibration.noise_dof, _MOST_FREEDOM)

    def placed_anew(self, z: FloatArray, sigmas: FloatArray) -> "CalibrationPrior":
        """The same with an only board that lies somewhere else.

        Args:
            z: (4, 4) about where.
            sigmas: (6,) how roughly that is known.
        """
        covariance = self.covariance.copy()
        covariance[6:12], covariance[:, 6:12] = 0.0, 0.0
        covariance[6:12, 6:12] = np.diag(sigmas**2)
        moved = replace(self.state, edges=np.stack([self.state.edges[0], z]))
        return replace(self, state=moved, covariance=covariance)


def _read(calibration: Calibration, fit: JointFit) -> CalibrationPrior:
    names = fit.boards
    x_name, z_name = edge_names(calibration.mount)
    placed = [calibration.edges[f"{z_name}_{name}" if name else z_name].matrix for name in names]
    targets = {
        name: target_from_document(target, name or "target") for name, target in fit.targets.items()
    }
    values = np.zeros(0) if fit.arm is None else fit.arm.values
    jacobian = _jacobian(np.array(placed), len(fit.looks), len(values))
    if fit.covariance.shape != (jacobian.shape[1],) * 2:
        raise ValueError(f"covariance has the shape {fit.covariance.shape}")
    return CalibrationPrior(
        calibration,
        targets,
        tuple(list(targets).index(name) for name in names) if targets else (0,),
        State(
            np.stack([calibration.edges[x_name].matrix, *placed]),
            np.concatenate([np.zeros(len(fit.looks)), values]),
        ),
        jacobian @ fit.covariance @ jacobian.T,
        _looks(calibration, fit, targets),
        "none" if fit.arm is None else fit.arm.of,
        fitted_model(calibration.calibrated_robot, fit.arm),
    )


def _looks(
    calibration: Calibration, fit: JointFit, targets: Mapping[str, Target]
) -> tuple[int, ...]:
    """Places of the fit's free values among the lens's and then the targets'."""
    # Files of earlier versions know nothing of a board's shear, the last of its values: what
    # follows them lies one place farther for each board.
    only, camera = calibration.board, calibration.camera
    boards = [*calibration.boards.values(), *([] if only is None else [only])]
    if camera is None or all("shear" in board.shape for board in boards):
        return fit.looks
    sizes = [
        len(intrinsics(camera.camera)),
        *(len(board_prior(target)) for target in targets.values()),
    ]
    is_new = [
        at == size - 1 and kind != "points"
        for size, kind in zip(
            sizes, ("points", *(target.kind for target in targets.values())), strict=True
        )
        for at in range(size)
    ]
    return tuple(np.flatnonzero(~np.array(is_new))[list(fit.looks)].tolist())


def _jacobian(placed: FloatArray, looks: int, arm: int) -> FloatArray:
    """How edges and values move with the unknowns as they are written.

    Written are the camera's edge and the first board's, then lens and boards, then where each
    further board lies from the first, and the arm.

    Args:
        placed: (b, 4, 4) the boards' edges.
        looks: How many values are of lens and boards.
        arm: How many are of the arm.
    """
    edges, behind = 6 + 6 * len(placed), 6 * len(placed) + 6 + looks
    jacobian = np.zeros((edges + looks + arm, behind + arm))
    jacobian[:12, :12] = np.eye(12)
    jacobian[edges : edges + looks, 12 : 12 + looks] = np.eye(looks)
    jacobian[edges + looks :, behind:] = np.eye(arm)
    for row, carried in enumerate(adjoint(invert(placed[1:]) @ placed[0])):
        # z_k exp(d_k) = z_1 exp(d_1) exp(-d) target_1_from_target_k
        mine, at = slice(12 + 6 * row, 18 + 6 * row), 12 + looks + 6 * row
        jacobian[mine, 6:12], jacobian[mine, at : at + 6] = carried, -carried
    return jacobian


def fitted_model(arm: Robot | None, fitted: FittedArm | None) -> ArmModel | None:
    """The arm's model at what was found, so that no errors are left to be added."""
    # Its geometry is in the arm; what goes by the loads of a stop is in the values.
    if fitted is None or fitted.of != "model" or arm is None:
        return None
    reported, weights = fitted.flange_from_reported, fitted.weights
    if reported is None or weights is None:
        raise ValueError("arm.flange_from_reported or arm.weights is missing")
    mounted = np.zeros((arm.joint_count + 1, 6))
    mounted[-1] = log(invert(reported))
    parts, shape = fitted.weight_functions, (4 * arm.joint_count, -1)
    return ArmModel(
        arm.corrected(mounted),
        reported,
        weights,
        np.zeros(len(fitted.values)) if fitted.by_stop is None else fitted.by_stop,
        1.0 if fitted.torque_nm is None else fitted.torque_nm,
        fitted.yielding,
        None if parts is None else WeightFunctions(tuple(part.reshape(shape) for part in parts)),
    )


def _shape(calibration: Calibration, targets: Mapping[str, Target]) -> FloatArray:
    """(s,) what the targets were found to be like; those that were not looked at are as stated."""
    found: dict[str, BoardResult | RigResult] = {**calibration.boards, **calibration.rigs}
    only = calibration.board or calibration.rig
    if only is not None:
        found[""] = only
    stated = {name: np.zeros(len(board_prior(target))) for name, target in targets.items()}
    return np.concatenate(
        [array + found[name].values if name in found else array for name, array in stated.items()]
    )
