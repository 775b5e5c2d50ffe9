"""A guard of a calibration: says after every look of a working cell whether it still holds."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np

from visioncal.core.arguments import check_fields, typed
from visioncal.core.codec import within
from visioncal.core.errors import DataError
from visioncal.core.limits import FAR_M
from visioncal.core.transforms import invert, rigid_fault, robot_part
from visioncal.core.types import Corners, FloatArray
from visioncal.estimation.fit import Fit
from visioncal.results import Calibration
from visioncal.robot.arm_model import ArmModel
from visioncal.robot.errors import TURN_PER_M, ArmErrors, link_basis, posture_features
from visioncal.verification.calibration_prior import CalibrationPrior
from visioncal.verification.change_hypotheses import BOARD, CAMERA, JOINT, MOTION_UNITS
from visioncal.verification.guard_detector import (
    CANDIDATE,
    ChangeKind,
    Detector,
    LookRows,
    accepted,
    counted,
    estimate,
    limit,
    step,
    weighed,
)
from visioncal.vision.corners import CornerStack, far_outside, reproject
from visioncal.vision.pnp import ViewPoses
from visioncal.vision.poses import determines_pose
from visioncal.vision.targets import first_corners

NONE = "none of these"


@dataclass(frozen=True, eq=False, kw_only=True)
class Look:
    """A target seen from a known pose of the robot."""

    time_s: float  # When it was seen, on any clock that only goes forward [s].
    base_from_flange: FloatArray | None = None  # (4, 4) as the robot reported it.
    # (4, 4) pose of the target, or its corners in the image: one of the two.
    cam_from_target: FloatArray | None = None
    corners: Corners | None = None
    joints_rad: FloatArray | None = None  # (n,) joint angles [rad]; a calibrated arm needs them.
    target: str = ""  # Name of the target; of several.

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("base_from_flange", "cam_from_target"):
            pose = getattr(self, name)
            fault = "" if pose is None else rigid_fault(pose)
            if pose is not None and not fault and np.abs(pose[:3, 3]).max() > FAR_M:
                fault = "its offset looks like millimetres, but must be in metres"
            if fault:
                raise DataError(
                    f"look at {self.time_s:g} s: {name} must be a pose, but {fault}.",
                    culprits=[name],
                )
        if (self.cam_from_target is None) == (self.corners is None):
            raise DataError(
                f"look at {self.time_s:g} s: cam_from_target or corners is needed, one of the two.",
                culprits=["cam_from_target", "corners"],
                next_step="Send looks that show the target alone.",
            )
        # After one in other units every look in seconds would be too early.
        if not abs(self.time_s) < 1e11:
            words = f"look: time_s is {self.time_s:g}, but must be seconds of under 3000 years."
            raise DataError(words, culprits=["time_s"])


@dataclass(frozen=True, kw_only=True)
class PossibleCause:
    """A possible change."""

    cause: str  # `camera`, `board NAME`, `joint 3`, or `none of these`.
    probability: float  # Its probability among all, given that something has changed.
    mm: float | None = None  # Estimated distance, of the camera or the board's origin [mm].
    sigma_mm: float | None = None  # Its standard deviation [mm].
    deg: float | None = None  # Estimated angle [deg].
    sigma_deg: float | None = None  # Its standard deviation [deg].


@dataclass(frozen=True, kw_only=True)
class Guarded:
    """The state of the calibration after the looks so far."""

    look: int  # Number of looks.
    time_s: float  # Time of the last [s].
    holds: bool  # Whether the calibration holds; once not, until it is acknowledged.
    evidence: float  # The statistic over its limit.
    causes: tuple[PossibleCause, ...] = ()  # Where it does not hold: the likeliest first.
    # When it changed: 95 % interval [s].
    changed_s: tuple[float, float] | None = None

    @property
    def document(self) -> dict[str, Any]:
        """A document for JSON, without unknown values."""
        causes = [
            {name: value for name, value in vars(cause).items() if value is not None}
            for cause in self.causes
        ]
        parts = {**vars(self), "causes": causes}
        return {name: value for name, value in parts.items() if value not in ([], None)}


class Guard:
    """Watches a calibration by every look of its working cell; see `guard_detector`."""

    @typed
    def __init__(
        self,
        calibration: Calibration | Path | str,
        *,
        false_alarm_looks: Annotated[float, within(100.0, 1e9)] = 10_000.0,
        slow_mm: Annotated[float, within(0.0, 10.0)] = 0.05,
        camera: str | None = None,
        robot: str | None = None,
        target: str | None = None,
    ) -> None:
        """Starts to guard a calibration.

        Args:
            calibration: The calibration, or the path of its folder or calibration.json.
            false_alarm_looks: Mean number of looks from one false alarm to the next.
            slow_mm: Standard deviation of motions that are no fault, over hours, of camera and
                board, each per axis [mm]; 2 mrad a millimetre of rotation. The value is learned.
            camera: The camera's name, where the calibration is of a whole cell.
            robot: The robot's name, likewise.
            target: The target's name, likewise.

        Raises:
            DataError: The calibration contains no covariance of its fit, the choice is ambiguous,
                or a number is out of its range.
        """
        if not isinstance(calibration, Calibration):
            calibration = Calibration.load(calibration)
        self.prior = prior = CalibrationPrior.of(calibration.of(camera, robot, target))
        self._looks, self._is_changed = false_alarm_looks, False
        # The lens's errors that go with those of the frames, and what is left of them.
        edges = 6 * len(prior.state.edges)
        edge_covariance, cross = prior.covariance[:edges, :edges], prior.covariance[edges:, :edges]
        self._gain = np.linalg.solve(edge_covariance, cross.T).T
        self._rest = prior.covariance[edges:, edges:] - self._gain @ cross.T
        # Made once: a look takes milliseconds.
        self._free, self._arm = prior.free, prior.model
        nominal, joints = prior.calibration.calibrated_robot, np.zeros(0)
        if self._arm is None and nominal is not None:
            self._arm = ArmModel(nominal, np.eye(4), {}, np.zeros(0))
        if self._arm is not None:
            joints = np.where(self._arm.robot.chain.prismatic, 1.0, TURN_PER_M)
        self._units = np.append(np.tile(MOTION_UNITS, edges // 6), joints)
        names = tuple(prior.targets) or ("",)
        self._boards = [f"{BOARD} {names[at]}".strip() for at in prior.boards]
        # Kinds of causes are equally likely, and causes of one kind.
        share = 1.0 / (2.0 + bool(len(joints)))
        self._kinds = [ChangeKind(CAMERA, tuple(range(6)), share)]
        for at, name in enumerate(self._boards, 1):
            columns = tuple(range(6 * at, 6 * at + 6))
            self._kinds.append(ChangeKind(name, columns, share / len(self._boards)))
        for at in range(len(joints)):
            self._kinds.append(ChangeKind(f"{JOINT} {at + 1}", (edges + at,), share / len(joints)))
        self._kinds.append(ChangeKind(NONE, (), share))
        self._other = ChangeKind(NONE, tuple(range(edges + len(joints))), share)
        self._noise = prior.noise(from_corners=self._free is not None)
        # An arm that is off by a millimetre has zeros that are off by a milliradian.
        zeros = np.full(len(joints), self._noise.robots[0, 1])
        self._state = Detector.of(edge_covariance, 1e-3 * slow_mm, zeros)

    @property
    def holds(self) -> bool:
        """Whether the calibration holds, by the looks so far."""
        return not self._is_changed

    @typed
    def update(self, look: Look) -> Guarded:
        """Takes one more look; in some milliseconds, whatever their number.

        Raises:
            DataError: The look is earlier than the last, or lacks what the calibration needs;
                nothing has changed then.
        """
        return self.take(self.rows(look))

    def take(self, rows: LookRows) -> Guarded:
        """Takes one more look, by its rows; see `update`."""
        if self._state.looks and rows.time_s < self._state.time_s:
            raise DataError(
                f"look at {rows.time_s:.10g} s: it is earlier than the last, at "
                f"{self._state.time_s:.10g} s.",
                culprits=["time_s"],
                next_step="Send looks in the order of their times, by one clock.",
            )
        state = step(self._state, rows, is_learning=not self._is_changed)
        statistic = self._statistic(state)
        evidence = float(statistic.sum()) / limit(state, self._looks)
        if not self._is_changed:
            state = counted(state, statistic)
        self._state, self._is_changed = state, self._is_changed or evidence >= 1.0
        found = self._found() if self._is_changed else {}
        return Guarded(
            look=int(state.looks),
            time_s=rows.time_s,
            holds=not self._is_changed,
            evidence=evidence,
            **found,
        )

    def _statistic(self, state: Detector) -> FloatArray:
        """(c,) by candidates, whose sum is that of the test."""
        # Beyond any limit, and no overflow.
        scores = np.minimum(weighed(state, self._kinds, self._units), 300.0)
        return np.asarray(np.exp(scores).sum(axis=0))

    def _judged(self) -> tuple[tuple[ChangeKind, ...], FloatArray, int, FloatArray]:
        """Kinds of a change, their probabilities at the likeliest candidate, it, and (c,) all."""
        kinds = (*self._kinds, self._other)
        scores = weighed(self._state, kinds, self._units, is_raw=True)
        by_time = np.exp(scores - scores.max()).sum(axis=0)
        candidate = int(by_time.argmax())
        # The change is judged at the likeliest time.
        shares = np.exp(scores[:, candidate] - scores[:, candidate].max())
        return kinds, shares / shares.sum(), candidate, by_time

    def _found(self) -> dict[str, Any]:
        """Causes and the time of the change."""
        (kinds, shares, candidate, by_time), causes = self._judged(), []
        # Of none, within what looks' rows say and beyond it.
        kinds, shares = (*kinds[:-2], kinds[-1]), np.append(shares[:-2], shares[-2:].sum())
        born = self._state.born
        for at in np.argsort(-shares).tolist():
            kind = kinds[at]
            size: dict[str, float] = {}
            if kind is not self._other:
                change, covariance = estimate(self._state, kind, candidate, self._units)
                # A joint's zero is an angle, or the offset of a sliding joint.
                parts = {"deg": slice(0, 3), "mm": slice(3, 6)}
                if len(change) == 1:
                    is_sliding = self._units[kind.columns[0]] == 1.0
                    parts = {"mm" if is_sliding else "deg": slice(0, 1)}
                for unit, part in parts.items():
                    factor = 1e3 if unit == "mm" else np.rad2deg(1.0)
                    length = float(np.linalg.norm(change[part]))
                    along = change[part] / max(length, 1e-12)
                    sigma = float(np.sqrt(along @ covariance[part, part] @ along))
                    signed = float(change[0]) if len(change) == 1 else length
                    size |= {unit: factor * signed, f"sigma_{unit}": factor * sigma}
            causes.append(PossibleCause(cause=kind.name, probability=float(shares[at]), **size))
        passed = np.cumsum(by_time) / by_time.sum()
        first, last = np.searchsorted(passed, [0.025, 0.975])
        last = min(int(last), len(born) - 1)
        return {"causes": tuple(causes), "changed_s": (float(born[first, 1]), float(born[last, 2]))}

    def acknowledge(self) -> None:
        """Ends an alarm: the change that was found is as it should be, and the guard goes on."""
        state = self._state
        if self._is_changed:
            kinds, shares, candidate, _ = self._judged()
            # False alarms just pass the limit, and what is true leaves it far behind.
            shares /= 1.0 + 100.0 * limit(state, self._looks) / self._statistic(state).sum()
            state = accepted(state, kinds, shares, candidate, self._units)
        self._state, self._is_changed = state, False

    def rows(self, look: Look) -> LookRows:
        """The rows of a look: its residual, covariance and Jacobians; see `update`."""
        prior = self.prior
        label, targets = f"look at {look.time_s:g} s", tuple(prior.targets)
        if look.target not in (*targets, "") or (not look.target and len(prior.boards) > 1):
            known = ", ".join(targets) or "without a name"
            raise DataError(
                f"{label}: its target is {look.target!r}, and those calibrated with are {known}.",
                culprits=["target"],
                next_step="Name the one that it shows.",
            )
        board = prior.boards[0] if not look.target else targets.index(look.target)
        flange, errors, fitted = look.base_from_flange, None, prior.fit.arm
        edges = len(self._gain.T)
        offsets = np.zeros((6, len(self._units) - edges))
        missing = {
            "base_from_flange": flange is None and prior.model is None,
            "joints_rad": fitted is not None and look.joints_rad is None,
        }
        if lacks := [name for name, is_missing in missing.items() if is_missing]:
            raise DataError(
                f"{label}: it has no {lacks[0]}, which this calibration needs.", culprits=lacks
            )
        if look.joints_rad is not None and self._arm is not None:
            joints, count = look.joints_rad[None], self._arm.robot.joint_count
            if joints.shape != (1, count) or not np.isfinite(joints).all():
                raise DataError(
                    f"{label}: joints_rad is {look.joints_rad.tolist()}, but must be {count}.",
                    culprits=["joints_rad"],
                )
            # Beyond two turns there are few joints, and their degrees are there at once.
            if (np.abs(joints) > 4.0 * np.pi)[:, ~self._arm.robot.chain.prismatic].any():
                raise DataError(
                    f"{label}: joints_rad is {look.joints_rad.tolist()}, in degrees by its size, "
                    "but must be in radians.",
                    culprits=["joints_rad"],
                )
            offsets = self._arm.columns("offsets", joints)[0]
            if prior.model is not None:
                flange = prior.model.base_from_flange(joints)[0]
            if fitted is not None:
                robot, is_of_links = self._arm.robot, fitted.of == "links"
                basis = link_basis(robot, joints) if is_of_links else self._arm.basis(joints)
                errors = ArmErrors(basis, 1.0, np.inf, of_links=True)
        flange = np.eye(4) if flange is None else flange
        pose, covariance, effects = self._posed(look, board, flange, label), None, []
        if self._free is not None:
            covariance = pose.covariance[:1]
            effects = [self._free.effect(pose.shared_jacobian[:1])]
        fit = Fit.of_stops(
            prior.calibration.mount,
            prior.state.edges,
            flange[None],
            self._noise,
            covariance,
            effects,
            measured=pose.cam_from_target[:1],
            targets=(self._boards[prior.boards.index(board)],),
            order=self._boards,
        )
        fit = (fit if errors is None else fit.with_arm(fit.robots[0], errors)).at(prior.state)
        linear = fit.problem.linear(fit.state)
        # A true difference acts against the prediction.
        jacobian = -linear.jacobian[0]
        by_edges, by_values = jacobian[:, :edges], jacobian[:, edges:]
        by_arm = linear.by_errors[0] * np.repeat(self._noise.robots[0], 3)
        by_arm = by_arm @ by_arm.T
        # Share of the arm's error, in variance, that counts as noise of the look in any case.
        return LookRows(
            time_s=look.time_s,
            residual=linear.residuals[0],
            covariance=fit.problem.total_covariance(linear, self._noise)[0]
            + by_values @ self._rest @ by_values.T
            - (1.0 - 0.1) * by_arm,
            by_edges=by_edges + by_values @ self._gain,
            by_motion=by_edges,
            by_joints=-linear.by_flanges[0] @ offsets,
            posture=posture_features(flange[None])[0],
            by_arm=by_arm,
        )

    def _posed(self, look: Look, board: int, flange: FloatArray, label: str) -> ViewPoses:
        """The look's pose of its target, with covariance and Jacobian by lens and board."""
        calibration, free, pose = self.prior.calibration, self._free, look.cam_from_target
        lens, none = calibration.camera, np.zeros((1, 6, 6))
        if free is None or lens is None:
            if pose is None:
                raise DataError(
                    f"{label}: it has corners, and the calibration was made from measured poses.",
                    culprits=["corners"],
                    next_step="Send cam_from_target, as measured when it was calibrated.",
                )
            return ViewPoses(0, None, pose[None], (0,), none, none[:, :, :0])
        limits = [*first_corners(tuple(self.prior.targets.values())), len(free.positions)]
        first, end = limits[board : board + 2]
        if look.corners is None and pose is not None:
            # As if all corners had been seen.
            points, ids = free.positions + free.basis @ free.appearance.board, np.arange(first, end)
            seen, start = Corners(0, ids, np.zeros((len(ids), 2)), 0.0), pose
            stack = CornerStack.of({0: seen}, points)
            px = reproject(stack, free.appearance.camera, pose[None], lens=False).px
        else:
            # The predicted pose is the start, which is nearer than a planar target's mirrored pose.
            robot, (x, *z) = robot_part(flange[None], calibration.mount)[0], self.prior.state.edges
            start = invert(robot @ x) @ z[self.prior.boards.index(board)]
            seen = look.corners or Corners(0, np.arange(0), np.zeros((0, 2)), 0.0)
            size = lens.camera.resolution
            if (outside := far_outside(seen.px, size)).any():
                u_px, v_px = seen.px[outside][0].tolist()
                raise DataError(
                    f"{label}: its corner at ({u_px:g}, {v_px:g}) px lies far outside the "
                    f"calibrated camera's image of {size[0]} x {size[1]} px.",
                    culprits=["corners"],
                    next_step="Send pixels of its whole raw image.",
                )
            px = lens.in_model(seen.px, float(start[2, 3]))
            seen = replace(seen, view=0, ids=seen.ids + first)
        is_known = np.all((seen.ids >= first) & (seen.ids < end))
        if not is_known or not determines_pose(free.positions[seen.ids]):
            raise DataError(
                f"{label}: its {len(seen.ids)} corners do not determine the target's pose: that "
                f"takes four of {end - first}, of which two lie off every line.",
                culprits=["corners"],
            )
        seen = replace(seen, px=px)
        view = ViewPoses(0, seen, start[None], (0,), none, none[:, :, :0], board, int(first))
        return free.posed([view], calibration.noise["pixel_px"])[0]

    @property
    def document(self) -> dict[str, Any]:
        """All that a restart needs beside the calibration; for JSON."""
        state = {name: values.tolist() for name, values in vars(self._state).items()}
        created = self.prior.calibration.created
        kept = {"calibration": created, "is_changed": self._is_changed, "state": state}
        return {**kept, "sha256": self._state.digest()}

    def restore(self, document: Mapping[str, Any]) -> Self:
        """Goes on from an earlier `document` of the same calibration's guard.

        Raises:
            DataError: It is of another calibration, or damaged.
        """
        fault, values = "", dict[str, FloatArray]()
        try:
            if document["calibration"] != self.prior.calibration.created:
                fault = "it is of another calibration"
            for name, now in vars(self._state).items():
                kept = np.array(document["state"][name], dtype=float)
                count = (len(document["state"]["born"]),) if name in CANDIDATE else now.shape[:1]
                values[name] = kept.reshape((*count, *now.shape[1:]))
            state, is_changed = Detector(**values), bool(document["is_changed"])
            if not fault and document["sha256"] != state.digest():
                fault = "its numbers are not those that were kept"
        except (LookupError, TypeError, ValueError) as error:
            fault = fault or repr(error)
        if fault:
            raise DataError(
                f"guard: the state that was kept cannot be used: {fault}.",
                next_step="Delete it; the guard then learns anew.",
            )
        self._state, self._is_changed = state, is_changed
        return self
