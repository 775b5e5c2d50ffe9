"""Torques of other units, other joints or the other sign, found by what the robot should need.

The robot's own inertias are off by a fifth, but a recording that is mistaken is off by far more. So
each mistake is tried out: the recording is taken as if it had been made, and what is predicted of
it is compared with what was measured, next to friction, which brakes.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.optimize import nnls

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, IntArray
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.model import sign
from visioncal.dynamics.motion import JointMotion, Measured
from visioncal.robot import Inertias, Robot, joint_torques

# So many samples are enough for a test; fewer, as of sweeps of single joints, are not.
_SAMPLES, _LEAST = 250, 100
# A mistake is named where undoing it divides the unexplained power of the torques by this much, and
# leaves of the joints concerned no more than this share.
_BETTER, _LEFT = 10.0, 0.5
# Two joints that are swapped are named where undoing it divides what a fit leaves by this much, all
# joints together, and leaves no more than this share: right recordings of exciting motions get
# worse by any swap, and those of slow sweeps, where friction is all there is, hardly change.
_FITS_BETTER, _FIT_LEFT = 10.0, 0.01
# Without inertias a mistake is named where undoing it divides what a fit leaves by this much, and
# leaves no more than this share; of right recordings it is divided by 1.2 at most.
_SURELY_BETTER, _EXPLAINED = 100.0, 0.1
# Of the power of a joint's torques so much is always left: noise, and inertias that are off.
_FLOOR = 0.01
# Inertias are off by less than these factors, and a torque on the motor's side, or in thousandths,
# by far more. They are read from joints of whose torque the links need at least this share.
_HIGH, _LOW, _SHARE = 5.0, 0.2, 0.3


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A recording as it would be without some mistake.

    Attributes:
        words: The mistake, in words; empty for the recording as it is.
        joints: The joints concerned.
        measured: The recording without it.
        predicted: (m, n) what the links should need [N m].
    """

    words: str
    joints: tuple[int, ...]
    measured: Measured
    predicted: FloatArray


def check_mistakes(base: BaseModel, streams: Sequence[Conditioned]) -> None:
    """Refuses recordings that are plainly mistaken.

    Without inertias a fit has to explain the torques: units and the sign of all of them are open
    then, as a heavier arm needs more.

    Raises:
        DataError: Torques or angles are of another joint, of the other sign, or in other units.
    """
    robot = base.model.robot
    for stream in streams:
        measured = _some(stream)
        if len(measured) < _LEAST:
            continue
        joints = tuple(range(measured.torques_nm.shape[1]))
        as_it_is = _Hypothesis("", joints, measured, _predicted(robot, measured.motion))
        if robot.inertias is None:
            found = _explained_better(base, as_it_is)
        else:
            found = _predicted_better(robot, as_it_is) or _fitted_better(base, as_it_is)
        if found is not None:
            raise DataError(
                f"{stream.label}: {found[0].words}: {found[1]}.",
                culprits=[f"joint {joint + 1}" for joint in found[0].joints],
                next_step="Mend the columns of the stream, or name the robot that was recorded.",
            )
        if robot.inertias is not None:
            _check_units(stream.label, robot, as_it_is)


def _some(stream: Conditioned) -> Measured:
    """Samples from all over a stream at which all joints move, as they were before the filter."""
    piece = max(stream.pieces, key=lambda value: len(value.measured))
    good = np.flatnonzero(piece.there & ~piece.bad.any(axis=1))
    return piece.measured.chosen(good[:: max(len(good) // _SAMPLES, 1)])


def _predicted_better(robot: Robot, as_it_is: _Hypothesis) -> tuple[_Hypothesis, str] | None:
    """The mistake without which by far the most is as predicted, if there is one, and why."""
    before = _left(as_it_is)
    best, gain = None, np.log(_BETTER)
    for guess in _guesses(robot, as_it_is):
        after = _left(guess)
        better = float(np.sum(np.log(before / after)))
        if better > gain and after[list(guess.joints)].max() < _LEFT:
            best, gain = guess, better
    if best is None:
        return None
    joints = list(best.joints)
    shares = [100.0 * (1.0 - float(left[joints].mean())) for left in (_left(best), before)]
    return best, (
        f"so taken, {shares[0]:.0f} % of the torques of {_named(best.joints)} is explained by the "
        f"inertias of {robot.name} and by friction, instead of {max(shares[1], 0.0):.0f} %"
    )


def _fitted_better(base: BaseModel, as_it_is: _Hypothesis) -> tuple[_Hypothesis, str] | None:
    """Two exchanged joints, if a fit finds such a pair, and why."""
    # Where friction is most of their torques, predictions hardly show it; but no inertias at all
    # can explain the others' torques.
    before, predicted = _unfitted(base, as_it_is.measured), _left(as_it_is)
    best, gain = None, np.log(_FITS_BETTER)
    for guess in _swapped_joints(base.model.robot, as_it_is):
        if np.sum(np.log(predicted / _left(guess))) < -1.0:
            continue
        after = _unfitted(base, guess.measured)
        better = float(np.sum(np.log(before / after)))
        if better > gain and after.max() < _FIT_LEFT:
            best, gain = guess, better
    if best is None:
        return None
    times = float(np.exp(gain / len(as_it_is.joints)))
    return best, f"so taken, the best fit leaves {times:.2g} times less of the torques' power"


def _explained_better(base: BaseModel, as_it_is: _Hypothesis) -> tuple[_Hypothesis, str] | None:
    """The mistake without which a fit of any inertias leaves by far less, if there is one, and why.

    Slow sweeps tell the torques of two joints hardly from their angles: both are named.
    """
    before = _unfitted(base, as_it_is.measured)
    tried = []
    for guess in _guesses(base.model.robot, as_it_is):
        after = _unfitted(base, guess.measured)
        if after.max() < _EXPLAINED:
            tried.append((float(np.sum(np.log(before / after))), guess))
    gain, best = max(tried, key=lambda pair: pair[0], default=(0.0, as_it_is))
    if gain < np.log(_SURELY_BETTER):
        return None
    alike = [guess.words for more, guess in tried if more > gain - np.log(_FITS_BETTER)]
    times = float(np.exp(gain / len(as_it_is.joints)))
    why = f"so taken, the best fit leaves {times:.2g} times less of the torques' power a joint"
    return replace(best, words=", or ".join(alike)), why


def _unfitted(base: BaseModel, measured: Measured) -> FloatArray:
    """(n,) what the best fit leaves of the power of each joint's torques."""
    sizes = np.maximum(np.std(measured.torques_nm, axis=0), 1e-12)
    x = base.regressor(measured.motion) / sizes[:, None]
    y = measured.torques_nm / sizes
    rows = x.reshape(-1, base.rank)
    rows = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-12)
    values = np.linalg.lstsq(rows, y.ravel(), rcond=1e-9)[0]
    left = np.mean((y - (rows @ values).reshape(y.shape)) ** 2, axis=0)
    return np.asarray(np.maximum(left, 1e-12))


def _guesses(robot: Robot, as_it_is: _Hypothesis) -> Iterator[_Hypothesis]:
    """The recording without one mistake or another."""
    yield from _swapped_columns(robot, as_it_is)
    yield from _swapped_joints(robot, as_it_is)
    yield from _flipped(robot, as_it_is)
    measured, every = as_it_is.measured, as_it_is.joints
    motion, torques = measured.motion, measured.torques_nm
    words = "all torques have the other sign (what the links do to the drives)"
    flipped = replace(measured, torques_nm=-torques)
    yield replace(as_it_is, words=words, measured=flipped)
    words = "the joints are in the reverse order"
    yield _moved(robot, _reordered(motion, every[::-1]), torques[:, ::-1], words, every)
    yield _moved(robot, _scaled(motion, np.pi / 180.0), torques, "angles are in degrees", every)


def _swapped_columns(robot: Robot, as_it_is: _Hypothesis) -> Iterator[_Hypothesis]:
    """The recording without the torques, or the angles, of two joints swapped."""
    measured = as_it_is.measured
    for pair, order in _pairs(as_it_is):
        words = f"of joints {pair[0] + 1} and {pair[1] + 1} are swapped"
        swapped = replace(measured, torques_nm=measured.torques_nm[:, order])
        yield replace(as_it_is, words=f"the torques {words}", joints=pair, measured=swapped)
        turned = _reordered(measured.motion, order)
        yield _moved(robot, turned, measured.torques_nm, f"the angles {words}", pair)


def _swapped_joints(robot: Robot, as_it_is: _Hypothesis) -> Iterator[_Hypothesis]:
    """The recording without two joints taken for each other."""
    measured = as_it_is.measured
    for pair, order in _pairs(as_it_is):
        words = f"joints {pair[0] + 1} and {pair[1] + 1} are swapped, with angles and torques"
        turned = _reordered(measured.motion, order)
        yield _moved(robot, turned, measured.torques_nm[:, order], words, pair)


def _pairs(as_it_is: _Hypothesis) -> Iterator[tuple[tuple[int, int], IntArray]]:
    for one, other in combinations(as_it_is.joints, 2):
        order = np.array(as_it_is.joints)
        order[[one, other]] = other, one
        yield (one, other), order


def _flipped(robot: Robot, as_it_is: _Hypothesis) -> Iterator[_Hypothesis]:
    """The recording without the other sign of a joint's torque or angle."""
    measured = as_it_is.measured
    for joint in as_it_is.joints:
        signs = np.where(np.array(as_it_is.joints) == joint, -1.0, 1.0)
        flipped = replace(measured, torques_nm=measured.torques_nm * signs)
        words = f"the torque of joint {joint + 1} has the other sign than its angle"
        yield replace(as_it_is, words=words, joints=(joint,), measured=flipped)
        words = f"the angle of joint {joint + 1} has the other sign"
        turned = _scaled(measured.motion, signs)
        yield _moved(robot, turned, measured.torques_nm, words, (joint,))


def _moved(
    robot: Robot, motion: JointMotion, torques: FloatArray, words: str, joints: tuple[int, ...]
) -> _Hypothesis:
    return _Hypothesis(words, joints, Measured(motion, torques), _predicted(robot, motion))


def _predicted(robot: Robot, motion: JointMotion) -> FloatArray:
    inertias = robot.inertias or Inertias(np.zeros((robot.joint_count, 10)))
    return joint_torques(robot, inertias, motion.q, motion.dq, motion.ddq)


def _reordered(motion: JointMotion, order: Sequence[int] | IntArray) -> JointMotion:
    parts = (array[:, list(order)] for array in (motion.q, motion.dq, motion.ddq))
    return JointMotion(motion.times_s, *parts)


def _scaled(motion: JointMotion, by: FloatArray | float) -> JointMotion:
    return JointMotion(motion.times_s, by * motion.q, by * motion.dq, by * motion.ddq)


def _left(guess: _Hypothesis) -> FloatArray:
    """(n,) share of the power of each joint's torques that nothing explains."""
    return np.array([_fitted(guess, index)[1] for index in range(guess.predicted.shape[1])])


def _fitted(guess: _Hypothesis, joint: int) -> tuple[FloatArray, float]:
    """A joint's torques by multiples of what is predicted and of friction, none below zero."""
    dq, torques = guess.measured.motion.dq[:, joint], guess.measured.torques_nm[:, joint]
    columns = np.column_stack([guess.predicted[:, joint], sign(dq), dq])
    columns, about = columns - columns.mean(axis=0), torques - torques.mean()
    sizes = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    found, left = nnls(columns / sizes, about)
    power = max(float(about @ about), 1e-24)
    return found / sizes, max(left**2 / power, _FLOOR)


def _named(joints: tuple[int, ...]) -> str:
    return ("joint " if len(joints) == 1 else "joints ") + ", ".join(
        str(joint + 1) for joint in joints
    )


def _check_units(label: str, robot: Robot, guess: _Hypothesis) -> None:
    """Refuses torques that are multiples of what they should be."""
    scales = np.full(len(guess.joints), np.nan)
    for joint in guess.joints:
        found, left = _fitted(guess, joint)
        torques = guess.measured.torques_nm[:, joint]
        share = found[0] ** 2 * np.var(guess.predicted[:, joint]) / max(np.var(torques), 1e-24)
        if share > _SHARE and left < _LEFT:
            scales[joint] = found[0]
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
    """What torques are likely to be."""
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
