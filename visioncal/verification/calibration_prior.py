"""The joint fit of a calibration as the prior of a later look at the same cell."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.core.codec import fault_words
from visioncal.core.errors import DataError
from visioncal.core.limits import CalibrationLimits
from visioncal.core.transforms import exp
from visioncal.core.types import FloatArray, IntArray, Target
from visioncal.estimation.appearance import Appearance, LensBoardParameters
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import ROBOT, Noise, State
from visioncal.results import HELD_BACK, Calibration
from visioncal.results.arm import FUNCTIONS
from visioncal.results.boards import calibrated_boards
from visioncal.results.sections import JointFit
from visioncal.robot.arm_model import ArmModel
from visioncal.robot.errors import posture_correlation
from visioncal.session.frames import edge_names
from visioncal.verification.model_evidence import CalibrationPosterior, RepeatedStops
from visioncal.vision.board_shape import boards_basis
from visioncal.vision.targets import numbered_positions

# Findings whose views are left out without a cause.
_NO_CAUSE = ("wrong_views", "lost_views", "unexplained")


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
    model: ArmModel | None  # The calibrated arm, for errors of its model.

    @classmethod
    def of(cls, calibration: Calibration) -> "CalibrationPrior":
        """Reads the prior from a calibration.

        Raises:
            DataError: The calibration has none, or it cannot be read.
        """
        label, fit = f"calibration {calibration.session_name!r}", calibration.joint_fit
        if fit is None:
            raise DataError(
                f"{label} holds no fit of a camera (joint_fit), as one by a measuring instrument.",
                next_step="Calibrate the new session, and compare both with visioncal diff.",
            )
        try:
            return _read(calibration, fit)
        except (LookupError, TypeError, ValueError) as error:
            raise DataError(
                f"{label}: joint_fit cannot be read: {fault_words(error)}.",
                culprits=["joint_fit"],
                next_step="Calibrate its session again.",
            ) from error

    @property
    def free(self) -> LensBoardParameters | None:
        """Calibrated lens and boards with their free values; None without camera or target."""
        calibration, camera = self.calibration, self.calibration.camera
        if camera is None or not self.targets:
            return None
        targets, size = tuple(self.targets.values()), len(self.fit.looks)
        boards = [board.shape for board in calibrated_boards(calibration)]
        return LensBoardParameters(
            Appearance(camera.camera, np.concatenate(boards)),
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
        names = ("combined_rotation_deg", "combined_translation_mm")
        if from_corners:
            names = ("robot_rotation_deg", "robot_translation_mm")
        if names[0] not in stated:
            # Poses of another origin than the calibration's have its total residuals.
            rms = self.calibration.rms
            stated = dict(zip(names, np.array([rms.deg or 0.0, rms.mm]) / np.sqrt(3), strict=True))
        intervals = {} if uncertainty is None else uncertainty.noise_95
        deg, mm = (max(stated[name], 0.5 * intervals.get(name, (0.0, 0.0))[1]) for name in names)
        deg, mm = self._with_strays(deg, mm)
        arm = self.calibration.arm
        if arm is not None and arm.level == FUNCTIONS:
            # Functions of the joints have the error of a left-out stop at a new stop.
            mm = max(mm, arm.chosen.held_out_mm / np.sqrt(3))
            deg = max(deg, (arm.chosen.held_out_deg or 0.0) / np.sqrt(3))
        return Noise.of_robot(float(np.deg2rad(deg)), 1e-3 * mm)

    def _with_strays(self, deg: float, mm: float) -> tuple[float, float]:
        """Noise per axis with the views that the calibration left out as no more than an arm errs.

        Without them a check of new stops finds a robot that scatters more than it did.
        """
        limits, views = CalibrationLimits(), self.calibration.views
        findings = self.calibration.verdict.findings
        explained = {view for one in findings if one.kind not in _NO_CAUSE for view in one.views}
        strays = [
            (view.residual_deg or 0.0, view.residual_mm)
            for view in views
            if not view.used and view.reason != HELD_BACK and view.view not in explained
            if view.residual_mm is not None and view.residual_mm < limits.scatter_mm[0]
            if (view.residual_deg or 0.0) < limits.scatter_deg[0]
        ]
        count = sum(view.used for view in views) + len(strays)
        is_of_arm = self.calibration.arm_errors is not None
        # Views that were left out without a cause are errors of the arm, which come again, from
        # this number and this share on; fewer are mistakes of rows.
        if not is_of_arm or len(strays) < max(3, 0.1 * count):
            return deg, mm
        share, squares = 1.0 - len(strays) / count, np.square(strays).sum(axis=0) / (3.0 * count)
        stray = np.sqrt(share * np.square((deg, mm)) + squares)
        deg, mm = np.maximum(stray, (deg, mm)).tolist()
        return deg, mm

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the estimated noise; limited, as more make no difference."""
        return min(self.calibration.noise_dof, 1e6)

    def belief(self, problem: Problem, boards: IntArray | None) -> CalibrationPosterior:
        """The prior of a check, by its problem.

        `boards` are the (n,) indices of those that its observations show; None where they are not
        compared with calibrated stops that they repeat.
        """
        noise = self.noise(from_corners=not problem.is_combined)
        repeated = None if boards is None else self._repeated(problem, boards)
        return CalibrationPosterior(self.state, self.covariance, noise, self.freedom, repeated)

    def _repeated(self, problem: Problem, boards: IntArray) -> RepeatedStops | None:
        """The calibrated observations that those of a check repeat; None for none."""
        calibrated, stops, count = self.fit.stops, problem.observations.stops, len(problem)
        poses = problem.poses[ROBOT][stops]
        if calibrated is None or not len(calibrated.views):
            return None
        correlation = posture_correlation(np.concatenate([poses, exp(calibrated.poses)]))
        alike = np.where(boards[:, None] == np.array(calibrated.boards), 1.0, 0.0)
        near = alike * correlation[:count, count:]
        nearest = near.argmax(axis=1)
        # Correlation of the arm's errors from which a stop repeats a calibrated one.
        repeating = np.flatnonzero(near.max(axis=1) > 0.5)
        chosen, first = np.unique(nearest[repeating], return_index=True)
        if not len(chosen):
            return None
        kept = np.append(np.arange(count), count + chosen)
        calibrated_stops = np.unique(calibrated.poses, axis=0, return_inverse=True)[1].reshape(-1)
        return RepeatedStops(
            repeating[first],
            calibrated.residuals[chosen],
            correlation[np.ix_(kept, kept)],
            np.append(stops, stops.max() + 1 + calibrated_stops[chosen]),
            calibrated.by_noise,
        )


def _read(calibration: Calibration, fit: JointFit) -> CalibrationPrior:
    names, stops = fit.boards, fit.stops
    x_name, z_name = edge_names(calibration.mount)
    # The only board may have a name in the session, and so in its transform.
    lone = next((name for name in calibration.edges if name != x_name), z_name)
    edges = (x_name, *(f"{z_name}_{name}" if name else lone for name in names))
    targets = {board.name: board.target for board in calibrated_boards(calibration)}
    values = np.zeros(0) if fit.arm is None else fit.arm.values
    size, count = 6 * len(edges), 6 * len(edges) + len(fit.looks) + len(values)
    if fit.covariance.shape != (count, count) or not np.allclose(
        fit.covariance[:size, :size], calibration.joint_covariance, rtol=1e-6, atol=0.0
    ):
        raise ValueError("covariance is not that of the transforms")
    if stops is not None and not (
        stops.poses.shape == stops.residuals.shape == (len(stops.boards), 6)
        and stops.by_noise.shape == fit.covariance.shape
    ):
        raise ValueError(f"stops have {len(stops.boards)} boards and other shapes")
    fit = fit.shown
    values = np.zeros(0) if fit.arm is None else fit.arm.values
    return CalibrationPrior(
        calibration,
        fit,
        targets,
        tuple(list(targets).index(name) for name in names) if targets else (0,),
        State(
            np.stack([calibration.edges[name].matrix for name in edges]),
            np.concatenate([np.zeros(len(fit.looks)), values]),
        ),
        fit.covariance,
        None if fit.arm is None else fit.arm.model(calibration.calibrated_robot),
    )
