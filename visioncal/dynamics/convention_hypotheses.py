"""Detection of torques in other units, of other joints or of the other sign, and of other mounts.

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
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.conditioning import Conditioned
from visioncal.dynamics.model import JointMotion, Measured, sign
from visioncal.robot import Robot
from visioncal.robot.inertia import Inertias
from visioncal.robot.loads import gravity_words
from visioncal.robot.torques import body_regressor, joint_torques

# A mistake is reported where undoing it divides the torques' unexplained power by this factor, and
# leaves at most this share unexplained in the joints concerned: by known inertias, by the best fit.
# Best fits of correct recordings improve by a factor of 1.2 at most. Mistakes that are nearly as
# likely are named, too: slow sweeps hardly separate swapped torques from swapped angles.
_BETTER, _LEFT = 10.0, {True: 0.5, False: 0.1}
# Torques whose scale to the predicted ones is outside these factors are in other units, such as
# motor-side torques.
_HIGH, _LOW = 5.0, 0.2
# Cosine of the angle, 5 deg, up to which a mount is that of an axis, and levelled.
_ALIGNED = 0.9962


def check_recording(base: BaseModel, streams: Sequence[Conditioned]) -> None:
    """Refuses recordings that are plainly mistaken.

    Without inertias, mistakes are tested by a fit of all parameters, which cannot show the unit or
    sign that all torques share.

    Raises:
        DataError: Torques or angles are of another joint, of the other sign, or in other units.
    """
    for stream in streams:
        piece = max(stream.pieces, key=lambda value: len(value.measured))
        good = np.flatnonzero(piece.present & ~piece.invalid.any(axis=1))
        measured = piece.measured.chosen(good[:: max(len(good) // 250, 1)])
        # Least number of a test's samples: sweeps of single joints have fewer.
        if len(measured) >= 100:
            if base.model.robot.inertias is not None:
                _check_conventions(base, stream.label, measured, known=True)
                # A tool may multiply a wrist's torques.
                if _left_with_body(base.model.robot, measured).max() > _LEFT[False]:
                    _check_units(base.model.robot, stream.label, measured)
            # The prediction hardly shows exchanged joints whose torques are mostly friction.
            _check_conventions(base, stream.label, measured, known=False)


def _check_conventions(base: BaseModel, label: str, measured: Measured, *, known: bool) -> None:
    """Refuses a recording where undoing a mistake makes it explain far more of its torques."""
    robot = base.model.robot
    before, tried = _unexplained(base, measured, known=known), []
    mistakes = [*_mistakes(robot.joint_count), *_other_mounts(robot, measured, known=known)]
    for mistake in mistakes:
        undone = mistake.undone(measured)
        after = _unexplained(base, undone, known=known, gravity=mistake.gravity)
        gain = _gain(before, after)
        if gain > np.log(_BETTER) and after[[*mistake.joints]].max() < _LEFT[known]:
            tried.append((gain, mistake, after))
    if not tried:
        return
    gain, best, after = max(tried, key=lambda item: item[0])
    if known and _gain(before, _left_with_body(robot, measured)) > gain - np.log(_BETTER):
        return
    alike = [mistake.words for more, mistake, _ in tried if more > gain - np.log(_BETTER)]
    joints = [*best.joints]
    so_taken, as_it_is = (
        max(100.0 * (1.0 - float(shares[joints].mean())), 0.0) for shares in (after, before)
    )
    by = f"the inertias of {robot.name} and by friction" if known else "the best fit"
    step = "Mend the columns of the stream, or name the robot that was recorded."
    if best.gravity is not None:
        step = (
            f"Write gravity_m_s2 = {gravity_words(best.gravity)} under [robot] in session.toml if "
            "it is mounted so, or name the robot that was recorded."
        )
    raise DataError(
        f"{label}: {', or '.join(alike)}: so taken, {so_taken:.3g} % of the torques of "
        f"{_named(best.joints)} is explained by {by}, instead of {as_it_is:.3g} %.",
        culprits=[f"joint {joint + 1}" for joint in joints],
        next_step=step,
    )


def _gain(before: FloatArray, after: FloatArray) -> float:
    """Logarithm of the factor by which the unexplained power of all joints falls."""
    return float(np.sum(np.log(before / after)))


def _unexplained(
    base: BaseModel, measured: Measured, *, known: bool, gravity: FloatArray | None = None
) -> FloatArray:
    """(n,) share of each joint's torque power left by the `known` inertias, or by the best fit."""
    model, torques = base.model, measured.torques_nm
    if gravity is not None:
        model = replace(model, robot=replace(model.robot, gravity=gravity))
    robot = model.robot
    if known:
        predicted, joints = _predicted(robot, measured.motion), range(robot.joint_count)
        return np.array([_joint_fit(measured, predicted, joint)[1] for joint in joints])
    sizes = np.maximum(np.std(torques, axis=0), 1e-12)
    y = torques / sizes
    # Gravity along another axis has other base parameters.
    kept = base.independent if gravity is None else None
    rows = model.regressor(measured.motion, kept) / sizes[:, None]
    rows = rows.reshape(y.size, -1)
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
    gravity: FloatArray | None = None  # (3,) gravity in the base's frame, where another [m/s^2].

    def undone(self, measured: Measured) -> Measured:
        """The recording with the mistake undone."""
        motion = measured.motion
        parts = (array @ self.angles for array in (motion.q, motion.dq, motion.ddq))
        return Measured(JointMotion(motion.times_s, *parts), measured.torques_nm @ self.torques)


def _mistakes(joints: int) -> Iterator[_Mistake]:
    """All mistakes that are tested."""
    same, every = np.eye(joints), tuple(range(joints))
    double_swaps = []
    for first, second in combinations(every, 2):
        pair, swap = (first, second), same.copy()
        swap[[first, second]] = same[[second, first]]
        words = f"of joints {first + 1} and {second + 1} are swapped"
        yield _Mistake(f"the torques {words}", pair, same, swap)
        yield _Mistake(f"the angles {words}", pair, swap, same)
        words = f"joints {first + 1} and {second + 1} are swapped, with angles and torques"
        double_swaps.append(_Mistake(words, pair, swap, swap))
    yield from double_swaps
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


def _other_mounts(robot: Robot, measured: Measured, *, known: bool) -> Iterator[_Mistake]:
    """Gravity along each other axis of the base, or as `known` inertias show it."""
    same, every = np.eye(robot.joint_count), tuple(range(robot.joint_count))
    size = float(np.linalg.norm(robot.gravity))
    axes = [sense * size * axis for axis in np.eye(3) for sense in (1.0, -1.0)]
    others = [*axes]
    if known:
        found = size * _gravity_direction(robot, measured)
        if max(axis @ found for axis in axes) < _ALIGNED * size**2:
            others.append(found)
    for gravity in others:
        if gravity @ robot.gravity < _ALIGNED * size**2:
            words = (
                f"the base is not mounted as stated, but has gravity along {gravity_words(gravity)}"
            )
            yield _Mistake(words, every, same, same, gravity)


def _gravity_direction(robot: Robot, measured: Measured) -> FloatArray:
    """(3,) direction of gravity in the base's frame by known inertias, beside friction."""
    still, *axes = (
        _predicted(replace(robot, gravity=gravity), measured.motion) for gravity in np.eye(4, 3, -1)
    )
    columns = np.stack([axis - still for axis in axes], axis=-1)
    found, _ = _beside_friction(measured, still, columns)
    return np.asarray(found / max(float(np.linalg.norm(found)), 1e-12))


def _left_with_body(robot: Robot, measured: Measured) -> FloatArray:
    """(n,) share of torque power left by known inertias with an unknown body on the flange."""
    motion, inertias = measured.motion, robot.inertias
    onto = body_regressor(robot, motion.q, motion.dq, motion.ddq)
    body, left = _beside_friction(measured, _predicted(robot, motion), onto)
    # No arm carries more than it weighs.
    lighter = inertias is not None and 0.0 < body[0] < inertias.masses.kg.sum()
    return left if lighter else np.ones_like(left)


def _beside_friction(
    measured: Measured, known: FloatArray, columns: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(c,) factors of (m, n, c) columns in torques beyond (m, n) known ones, (n,) share left."""
    rows = []
    for joint, speeds in enumerate(measured.motion.dq.T):
        friction = np.column_stack([sign(speeds), speeds, np.ones_like(speeds)])
        torques = measured.torques_nm[:, joint]
        parts = np.column_stack([columns[:, joint], torques - known[:, joint]])
        parts = parts / max(float(np.std(torques)), 1e-12)
        rows.append(parts - friction @ np.linalg.lstsq(friction, parts, rcond=None)[0])
    stacked = np.concatenate(rows)
    factors = np.linalg.lstsq(stacked[:, :-1], stacked[:, -1], rcond=1e-9)[0]
    left = [np.mean((part[:, -1] - part[:, :-1] @ factors) ** 2) for part in rows]
    # See `_joint_fit`.
    return np.asarray(factors), np.maximum(left, 0.01)


def _predicted(robot: Robot, motion: JointMotion) -> FloatArray:
    """(m, n) torques of the links by the robot's inertias [N m]."""
    inertias = robot.inertias or Inertias(np.zeros((robot.joint_count, 10)))
    return joint_torques(robot, inertias, motion.q, motion.dq, motion.ddq)


def _joint_fit(measured: Measured, predicted: FloatArray, joint: int) -> tuple[FloatArray, float]:
    """Non-negative fit of a joint's torques: factors of prediction and friction, share left."""
    dq, torques = measured.motion.dq[:, joint], measured.torques_nm[:, joint]
    columns = np.column_stack([predicted[:, joint], sign(dq), dq])
    columns, centred = columns - columns.mean(axis=0), torques - torques.mean()
    sizes = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    factors, left = nnls(columns / sizes, centred)
    power = max(float(centred @ centred), 1e-24)
    # Noise and wrong inertias leave at least a hundredth.
    return factors / sizes, max(left**2 / power, 0.01)


def _named(joints: tuple[int, ...]) -> str:
    return ("joint " if len(joints) == 1 else "joints ") + ", ".join(
        str(joint + 1) for joint in joints
    )


def described_scales(robot: Robot, measured: Measured) -> FloatArray:
    """(n,) torques of the links over those by the robot's inertias; nan where they hardly show."""
    predicted, scales = _predicted(robot, measured.motion), np.full(robot.joint_count, np.nan)
    for joint in range(robot.joint_count):
        factors, left = _joint_fit(measured, predicted, joint)
        power = max(float(np.var(measured.torques_nm[:, joint])), 1e-24)
        share = factors[0] ** 2 * np.var(predicted[:, joint]) / power
        # Only joints of whose torque the links make up at least this share are tested.
        if share > 0.3 and left < _LEFT[True]:
            scales[joint] = factors[0]
    return scales


def _check_units(robot: Robot, label: str, measured: Measured) -> None:
    """Refuses torques whose scale to the predicted ones shows another unit."""
    scales = described_scales(robot, measured)
    wrong = np.flatnonzero((scales > _HIGH) | (scales < _LOW))
    if not len(wrong):
        return
    tested = np.isfinite(scales).sum()
    subject = "the torques" if len(wrong) == tested else f"the torques of {_named(tuple(wrong))}"
    scale = float(np.median(scales[wrong]))
    if scale > 200.0:
        unit = "are they mN m, or mA for A?"
    elif scale > _HIGH:
        unit = "are they of another unit, or currents with gains that are too large?"
    elif scale < 1.0 / 30.0:
        unit = (
            f"are they those of the motors, before gears of a ratio of about {1.0 / scale:.0f}, or "
            "currents?"
        )
    else:
        unit = "are they of another unit, or currents with gains that are too small?"
    raise DataError(
        f"{label}: {subject} are {figure(scale)} times what the inertias of {robot.name} need; "
        f"{unit}",
        culprits=[f"{label}, tau{index + 1}_nm" for index in wrong],
        next_step="Torques are those of the joints, behind the gears, in N m. Currents belong into "
        "current1_a ... [A], and --gains turns them into torques.",
    )
