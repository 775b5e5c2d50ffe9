"""Detection of torques in other units, of other joints or of the other sign.

Each possible mistake is undone in turn, and the torques that the robot's own inertias then predict,
with friction, are compared with the measured ones. The inertias may be off by a fifth; a mistaken
recording is off by far more.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.optimize import nnls

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.model import JointMotion, Measured, sign
from visioncal.robot import Inertias, Robot, joint_torques

# Samples of a test, and the least number: sweeps of single joints have fewer.
_SAMPLES, _LEAST = 250, 100
# With inertias a mistake is reported where undoing it divides the torques' unexplained power by
# this factor, and leaves at most this share unexplained in the joints concerned.
_BETTER, _LEFT = 10.0, 0.5
# Swapped joints are reported where undoing the swap divides the fit's residual power, over all
# joints, by this factor, and leaves at most this share: correct recordings of exciting motions get
# worse by any swap, and slow sweeps, where friction is nearly all, hardly change.
_FITS_BETTER, _FIT_LEFT = 10.0, 0.01
# Without inertias a mistake is reported where undoing it divides the fit's residual power by this
# factor, and leaves at most this share; for correct recordings the factor is at most 1.2.
_SURELY_BETTER, _EXPLAINED = 100.0, 0.1
# Least share of a joint's torque power that counts as unexplained: noise, and wrong inertias.
_FLOOR = 0.01
# Torques whose scale to the predicted ones is outside these factors are in other units, such as
# motor-side torques; only joints of whose torque the links make up at least this share are tested.
_HIGH, _LOW, _SHARE = 5.0, 0.2, 0.3


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A recording with some mistake undone."""

    words: str  # The mistake, for the message; empty for the recording as it is.
    joints: tuple[int, ...]  # The joints concerned.
    measured: Measured  # The corrected recording.
    predicted: FloatArray  # (m, n) torques of the links by the robot's inertias [N m].


def check_recording(base: BaseModel, streams: Sequence[Conditioned]) -> None:
    """Refuses recordings that are plainly mistaken.

    Without inertias, mistakes are tested by a fit of all parameters, which cannot show the unit or
    sign that all torques share.

    Raises:
        DataError: Torques or angles are of another joint, of the other sign, or in other units.
    """
    robot = base.model.robot
    for stream in streams:
        measured = _sampled(stream)
        if len(measured) < _LEAST:
            continue
        joints = tuple(range(measured.torques_nm.shape[1]))
        as_it_is = _Hypothesis("", joints, measured, _predicted(robot, measured.motion))
        if robot.inertias is None:
            mistake = _explained_better(base, as_it_is)
        else:
            mistake = _predicted_better(robot, as_it_is) or _fitted_better(base, as_it_is)
        if mistake is not None:
            raise DataError(
                f"{stream.label}: {mistake[0].words}: {mistake[1]}.",
                culprits=[f"joint {joint + 1}" for joint in mistake[0].joints],
                next_step="Mend the columns of the stream, or name the robot that was recorded.",
            )
        if robot.inertias is not None:
            _check_units(stream.label, robot, as_it_is)


def _sampled(stream: Conditioned) -> Measured:
    """Unfiltered samples, spread over a stream, at which all torques are valid."""
    piece = max(stream.pieces, key=lambda value: len(value.measured))
    good = np.flatnonzero(piece.present & ~piece.invalid.any(axis=1))
    return piece.measured.chosen(good[:: max(len(good) // _SAMPLES, 1)])


def _predicted_better(robot: Robot, as_it_is: _Hypothesis) -> tuple[_Hypothesis, str] | None:
    """The mistake whose correction makes the prediction fit far better, and why; else None."""
    before = _unexplained_shares(as_it_is)
    best, gain = None, np.log(_BETTER)
    for mistake in _mistakes(robot.joint_count):
        hypothesis = mistake.undone(robot, as_it_is)
        after = _unexplained_shares(hypothesis)
        better = float(np.sum(np.log(before / after)))
        if better > gain and after[list(hypothesis.joints)].max() < _LEFT:
            best, gain = hypothesis, better
    if best is None:
        return None
    joints = list(best.joints)
    percent = [
        100.0 * (1.0 - float(shares[joints].mean()))
        for shares in (_unexplained_shares(best), before)
    ]
    return best, (
        f"so taken, {percent[0]:.0f} % of the torques of {_named(best.joints)} is explained by "
        f"the inertias of {robot.name} and by friction, instead of {max(percent[1], 0.0):.0f} %"
    )


def _fitted_better(base: BaseModel, as_it_is: _Hypothesis) -> tuple[_Hypothesis, str] | None:
    """Two swapped joints, if a fit shows such a pair, and why; else None."""
    # The prediction hardly shows it where their torques are mostly friction; but then no inertias
    # at all explain the other joints' torques.
    before, predicted = _residual_power(base, as_it_is.measured), _unexplained_shares(as_it_is)
    best, gain = None, np.log(_FITS_BETTER)
    for mistake in _mistakes(len(as_it_is.joints)):
        if mistake.angles is not mistake.torques:
            continue
        hypothesis = mistake.undone(base.model.robot, as_it_is)
        if np.sum(np.log(predicted / _unexplained_shares(hypothesis))) < -1.0:
            continue
        after = _residual_power(base, hypothesis.measured)
        better = float(np.sum(np.log(before / after)))
        if better > gain and after.max() < _FIT_LEFT:
            best, gain = hypothesis, better
    if best is None:
        return None
    times = float(np.exp(gain / len(as_it_is.joints)))
    return best, f"so taken, the best fit leaves {times:.2g} times less of the torques' power"


def _explained_better(base: BaseModel, as_it_is: _Hypothesis) -> tuple[_Hypothesis, str] | None:
    """The mistake whose correction makes the best fit far better, and why; else None.

    Slow sweeps hardly separate swapped torques from swapped angles: both are named.
    """
    before = _residual_power(base, as_it_is.measured)
    tried = []
    for mistake in _mistakes(len(as_it_is.joints)):
        hypothesis = mistake.undone(base.model.robot, as_it_is)
        after = _residual_power(base, hypothesis.measured)
        if after.max() < _EXPLAINED:
            tried.append((float(np.sum(np.log(before / after))), hypothesis))
    gain, best = max(tried, key=lambda pair: pair[0], default=(0.0, as_it_is))
    if gain < np.log(_SURELY_BETTER):
        return None
    alike = [hypothesis.words for more, hypothesis in tried if more > gain - np.log(_FITS_BETTER)]
    times = float(np.exp(gain / len(as_it_is.joints)))
    why = f"so taken, the best fit leaves {times:.2g} times less of the torques' power a joint"
    return replace(best, words=", or ".join(alike)), why


def _residual_power(base: BaseModel, measured: Measured) -> FloatArray:
    """(n,) share of the power of each joint's torques that the best fit leaves."""
    sizes = np.maximum(np.std(measured.torques_nm, axis=0), 1e-12)
    x = base.regressor(measured.motion) / sizes[:, None]
    y = measured.torques_nm / sizes
    rows = x.reshape(-1, base.rank)
    rows = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-12)
    values = np.linalg.lstsq(rows, y.ravel(), rcond=1e-9)[0]
    left = np.mean((y - (rows @ values).reshape(y.shape)) ** 2, axis=0)
    return np.asarray(np.maximum(left, 1e-12))


@dataclass(frozen=True, eq=False)
class _Mistake:
    """A possible mistake, with the (n, n) matrices that undo it in rows of angles and torques."""

    words: str
    joints: tuple[int, ...]  # The joints concerned.
    angles: FloatArray
    torques: FloatArray

    def undone(self, robot: Robot, as_it_is: _Hypothesis) -> _Hypothesis:
        """The recording with the mistake undone."""
        motion, torques = as_it_is.measured.motion, as_it_is.measured.torques_nm @ self.torques
        parts = (array @ self.angles for array in (motion.q, motion.dq, motion.ddq))
        motion = JointMotion(motion.times_s, *parts)
        measured = Measured(motion, torques)
        return _Hypothesis(self.words, self.joints, measured, _predicted(robot, motion))


def _mistakes(joints: int) -> Iterator[_Mistake]:
    """All mistakes that are tested."""
    same, every = np.eye(joints), tuple(range(joints))
    both = []
    for first, second in combinations(every, 2):
        pair, swap = (first, second), same.copy()
        swap[[first, second]] = same[[second, first]]
        words = f"of joints {first + 1} and {second + 1} are swapped"
        yield _Mistake(f"the torques {words}", pair, same, swap)
        yield _Mistake(f"the angles {words}", pair, swap, same)
        words = f"joints {first + 1} and {second + 1} are swapped, with angles and torques"
        both.append(_Mistake(words, pair, swap, swap))
    yield from both
    for joint in every:
        flip = np.diag(np.where(np.arange(joints) == joint, -1.0, 1.0))
        words = f"the torque of joint {joint + 1} has the other sign than its angle"
        yield _Mistake(words, (joint,), same, flip)
        yield _Mistake(f"the angle of joint {joint + 1} has the other sign", (joint,), flip, same)
    yield _Mistake(
        "all torques have the other sign (what the links do to the drives)", every, same, -same
    )
    yield _Mistake("the joints are in the reverse order", every, same[::-1], same[::-1].copy())
    yield _Mistake("angles are in degrees", every, np.pi / 180.0 * same, same)


def _predicted(robot: Robot, motion: JointMotion) -> FloatArray:
    inertias = robot.inertias or Inertias(np.zeros((robot.joint_count, 10)))
    return joint_torques(robot, inertias, motion.q, motion.dq, motion.ddq)


def _unexplained_shares(hypothesis: _Hypothesis) -> FloatArray:
    """(n,) share of the power of each joint's torques that prediction and friction leave."""
    return np.array(
        [_joint_fit(hypothesis, index)[1] for index in range(hypothesis.predicted.shape[1])]
    )


def _joint_fit(hypothesis: _Hypothesis, joint: int) -> tuple[FloatArray, float]:
    """Non-negative fit of a joint's torques: factors of prediction and friction, share left."""
    dq, torques = hypothesis.measured.motion.dq[:, joint], hypothesis.measured.torques_nm[:, joint]
    columns = np.column_stack([hypothesis.predicted[:, joint], sign(dq), dq])
    columns, centred = columns - columns.mean(axis=0), torques - torques.mean()
    sizes = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    factors, left = nnls(columns / sizes, centred)
    power = max(float(centred @ centred), 1e-24)
    return factors / sizes, max(left**2 / power, _FLOOR)


def _named(joints: tuple[int, ...]) -> str:
    return ("joint " if len(joints) == 1 else "joints ") + ", ".join(
        str(joint + 1) for joint in joints
    )


def _check_units(label: str, robot: Robot, hypothesis: _Hypothesis) -> None:
    """Refuses torques whose scale to the predicted ones shows another unit."""
    scales = np.full(len(hypothesis.joints), np.nan)
    for joint in hypothesis.joints:
        factors, left = _joint_fit(hypothesis, joint)
        torques = hypothesis.measured.torques_nm[:, joint]
        share = (
            factors[0] ** 2 * np.var(hypothesis.predicted[:, joint]) / max(np.var(torques), 1e-24)
        )
        if share > _SHARE and left < _LEFT:
            scales[joint] = factors[0]
    wrong = np.flatnonzero((scales > _HIGH) | (scales < _LOW))
    if not len(wrong):
        return
    tested = np.isfinite(scales).sum()
    whose = "the torques" if len(wrong) == tested else f"the torques of {_named(tuple(wrong))}"
    scale = float(np.median(scales[wrong]))
    raise DataError(
        f"{label}: {whose} are {scale:.3g} times what the inertias of {robot.name} need; "
        f"{_unit(scale)}",
        culprits=[f"{label}, tau{index + 1}_nm" for index in wrong],
        next_step="Torques are those of the joints, behind the gears, in N m. Currents belong into "
        "current1_a ... [A], and --gains turns them into torques.",
    )


def _unit(scale: float) -> str:
    """The likely unit of torques with that scale, as a question."""
    if scale > 200.0:
        return "are they mN m, or mA for A?"
    if scale > _HIGH:
        return "are they of another unit, or currents with gains that are too large?"
    if scale < 1.0 / 30.0:
        return (
            f"are they those of the motors, before gears of a ratio of about {1.0 / scale:.0f}, or "
            "currents?"
        )
    return "are they of another unit, or currents with gains that are too small?"
