"""Simulated arms: Universal Robots' published geometry, forward and inverse kinematics.

The chain is implemented here in plain numpy, independent of the application's robot model, so that
an error in the chain cannot cancel out.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from visioncal.core.choices import SIMULATED_ARMS
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.transforms import cross
from visioncal.core.types import FloatArray

_HALF_TURN = np.pi
# Ripples per turn of a strain-wave gear of ratio 100: two per turn of its wave generator.
_TEETH = 200
# Nodes per turn of the joints' error functions, which are linear in between.
_NODES = 1440


@dataclass(frozen=True, eq=False)
class DhArm:
    """A serial arm of revolute joints in standard Denavit-Hartenberg form.

    Link i is `Rz(q_i + offset_i) Tz(d_i) Tx(a_i) Rx(alpha_i) Ry(beta_i)`. The last rotation is
    Hayati's (1983): where two axes are nearly parallel, the other four parameters cannot represent
    their misalignment about y. It is zero in every nominal arm.
    """

    name: str  # Name of the model.
    a: FloatArray  # (n,) lengths along the links' x [m].
    d: FloatArray  # (n,) offsets along the joint axes [m].
    alpha: FloatArray  # (n,) twists about x [rad].
    beta: FloatArray  # (n,) Hayati's twists about y [rad].
    offset: FloatArray  # (n,) joint angles at which the encoders read zero [rad].
    # (4, n) periodic joint errors: sine and cosine amplitudes at the joint's angle, from
    # eccentricity, and of the gear's ripple [rad].
    waves: FloatArray
    # (k, n) further joint errors at k angles over a turn [rad]; None for none.
    beyond: FloatArray | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmErrors:
    """Standard deviations of a real arm's parameters from the nominal ones."""

    dh_sigma_m: float = 0.0  # Every length a and d [m].
    dh_sigma_rad: float = 0.0  # Every alpha, beta and joint offset [rad].
    offset_sigma_rad: float = 0.0  # Joint offsets, in addition to `dh_sigma_rad` [rad].
    # Sine and cosine amplitudes of the joint errors at the joint's angle [rad].
    eccentricity_sigma_rad: float = 0.0
    ripple_sigma_rad: float = 0.0  # Likewise for the gear's ripple, many times per turn [rad].
    # Further joint errors as arbitrary functions of the angle [rad].
    function_sigma_rad: float = 0.0
    function_length_rad: float = 0.06  # Correlation length of these functions [rad].


@dataclass(frozen=True, eq=False)
class Reach:
    """Result of the inverse kinematics."""

    joints: FloatArray  # (m, n) joint angles [rad], valid where `solved`.
    solved: npt.NDArray[np.bool_]  # (m,) whether the pose was reached within the joints' limits.
    # (m,) smallest singular value of the Jacobian with lengths in units of the arm's reach; zero in
    # a singular posture.
    dexterity: FloatArray


def ur_arm(name: str) -> DhArm:
    """Nominal arm of Universal Robots' e-Series by the manufacturer's values.

    Source: Universal Robots, "DH parameters for calculations of kinematics and dynamics".

    Args:
        name: `ur3e`, `ur5e` or `ur10e`.

    Returns:
        The nominal arm, from the controller's base frame to the flange.

    Raises:
        DataError: Another name was given.
    """
    # d1, a2, a3, d4, d5, d6 [m]
    published = {
        "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
        "ur5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
        "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    }
    if name not in published:
        raise DataError(
            f"simulation: the arm {name!r} is not known, only {', '.join(SIMULATED_ARMS)} are.",
            culprits=["robot"],
            next_step=did_you_mean(name, SIMULATED_ARMS) or "Name one of these.",
        )
    d1, a2, a3, d4, d5, d6 = published[name]
    quarter = 0.5 * np.pi
    return DhArm(
        name=name,
        a=np.array([0.0, a2, a3, 0.0, 0.0, 0.0]),
        d=np.array([d1, 0.0, 0.0, d4, d5, d6]),
        alpha=np.array([quarter, 0.0, 0.0, quarter, -quarter, 0.0]),
        beta=np.zeros(6),
        offset=np.zeros(6),
        waves=np.zeros((4, 6)),
    )


def industrial_arm() -> DhArm:
    """Nominal arm of 1.8 m reach in the proportions of a medium industrial robot.

    It is no actual model: round numbers, a shoulder with an offset from the first axis, and a
    spherical wrist.
    """
    quarter = 0.5 * np.pi
    return DhArm(
        name="generic-6r-1800",
        a=np.array([0.18, 0.8, 0.18, 0.0, 0.0, 0.0]),
        d=np.array([0.5, 0.0, 0.0, 0.8, 0.0, 0.13]),
        alpha=np.array([-quarter, 0.0, -quarter, quarter, -quarter, 0.0]),
        beta=np.zeros(6),
        offset=np.array([0.0, -quarter, 0.0, 0.0, 0.0, np.pi]),
        waves=np.zeros((4, 6)),
    )


def arm_named(name: str) -> DhArm:
    """Nominal arm by name: Universal Robots', or `generic-6r-1800`.

    Raises:
        DataError: There is no arm of that name.
    """
    return industrial_arm() if name == "generic-6r-1800" else ur_arm(name)


def disturb(arm: DhArm, errors: ArmErrors, rng: np.random.Generator) -> DhArm:
    """Draws a real arm around a nominal one.

    The same generator state gives the same error directions, whatever their size.
    """
    draws, waves = rng.standard_normal((6, arm.a.size)), rng.standard_normal((4, arm.a.size))
    sizes = np.repeat([errors.eccentricity_sigma_rad, errors.ripple_sigma_rad], 2)
    # Drawn only if needed, so that later draws do not change.
    beyond = _functions(errors, arm.a.size, rng) if errors.function_sigma_rad else arm.beyond
    return replace(
        arm,
        a=arm.a + errors.dh_sigma_m * draws[0],
        d=arm.d + errors.dh_sigma_m * draws[1],
        alpha=arm.alpha + errors.dh_sigma_rad * draws[2],
        beta=arm.beta + errors.dh_sigma_rad * draws[3],
        offset=arm.offset + errors.dh_sigma_rad * draws[4] + errors.offset_sigma_rad * draws[5],
        waves=arm.waves + sizes[:, None] * waves,
        beyond=beyond,
    )


def _functions(errors: ArmErrors, joints: int, rng: np.random.Generator) -> FloatArray:
    """(k, n) random smooth periodic functions: filtered white noise on a circle."""
    angles = np.linspace(0.0, 2.0 * np.pi, _NODES, endpoint=False)
    kernel = np.exp(-2.0 * np.sin(0.5 * angles) ** 2 / errors.function_length_rad**2)
    power = np.sqrt(np.maximum(np.fft.rfft(kernel).real, 0.0))[:, None]
    white = np.fft.rfft(rng.standard_normal((_NODES, joints)), axis=0)
    return np.asarray(errors.function_sigma_rad * np.fft.irfft(power * white, _NODES, axis=0))


def reach_m(arm: DhArm) -> float:
    """Length of the stretched upper arm and forearm [m]."""
    return float(np.abs(arm.a).sum())


def link_frames(arm: DhArm, joints: FloatArray) -> FloatArray:
    """Link frames of (m, n) joint angles [rad].

    Returns:
        (m, n + 1, 4, 4) `base_from_link`, from the base itself to the flange.
    """
    frames = np.empty((len(joints), arm.a.size + 1, 4, 4))
    frames[:, 0] = np.eye(4)
    for i in range(arm.a.size):
        frames[:, i + 1] = frames[:, i] @ _link(arm, i, joints[:, i])
    return frames


def forward(arm: DhArm, joints: FloatArray) -> FloatArray:
    """Forward kinematics: (m, n) joint angles [rad] to (m, 4, 4) `base_from_flange`."""
    return link_frames(arm, joints)[:, -1]


def inverse(arm: DhArm, base_from_flange: FloatArray, seeds: FloatArray) -> Reach:
    """Inverse kinematics by damped least squares, of (m, 4, 4) poses from (m, n) starts [rad].

    Method: Wampler (1986). The damping decreases with the error, so that the iteration ends as
    Newton's method and reaches machine precision. The elbow is within half a turn, and every other
    joint within a turn.
    """
    joints = seeds.copy()
    scale = np.repeat([1.0, 1.0 / reach_m(arm)], 3)
    for _ in range(60):
        jacobian, error = _linearise(arm, joints, base_from_flange, scale)
        size = np.einsum("mi,mi->m", error, error)
        if size.max() < 1e-26:
            break
        damping = np.minimum(0.02, size)[:, None, None] * np.eye(6)
        gram = jacobian @ np.swapaxes(jacobian, 1, 2) + damping + 1e-14 * np.eye(6)
        step = np.swapaxes(jacobian, 1, 2) @ np.linalg.solve(gram, error[..., None])
        joints += np.clip(step[..., 0], -0.5, 0.5)
    jacobian, error = _linearise(arm, joints, base_from_flange, scale)
    # The joint angles closest to the seeds.
    joints = seeds + ((joints - seeds + _HALF_TURN) % (2.0 * _HALF_TURN) - _HALF_TURN)
    limits = np.full(arm.a.size, 2.0 * _HALF_TURN)
    limits[2] = _HALF_TURN
    within = np.all(np.abs(joints) < limits, axis=1)
    return Reach(
        joints=joints,
        solved=within & (np.linalg.norm(error, axis=1) < 1e-9),
        dexterity=np.asarray(np.linalg.svd(jacobian, compute_uv=False)[:, -1], dtype=float),
    )


def _link(arm: DhArm, i: int, angle: FloatArray) -> FloatArray:
    """(m, 4, 4) `link_from_next` of joint i."""
    joint_angle = angle + arm.offset[i]
    if arm.waves[:, i].any():
        phases = [np.sin(angle), np.cos(angle), np.sin(_TEETH * angle), np.cos(_TEETH * angle)]
        joint_angle = joint_angle + arm.waves[:, i] @ np.array(phases)
    if arm.beyond is not None:
        nodes = np.linspace(0.0, 2.0 * np.pi, len(arm.beyond), endpoint=False)
        joint_angle = joint_angle + np.interp(angle, nodes, arm.beyond[:, i], period=2.0 * np.pi)
    cos_q, sin_q = np.cos(joint_angle), np.sin(joint_angle)
    cos_a, sin_a = np.cos(arm.alpha[i]), np.sin(arm.alpha[i])
    matrices = np.zeros((angle.size, 4, 4))
    matrices[:, 0, 0], matrices[:, 0, 1] = cos_q, -sin_q * cos_a
    matrices[:, 0, 2], matrices[:, 0, 3] = sin_q * sin_a, arm.a[i] * cos_q
    matrices[:, 1, 0], matrices[:, 1, 1] = sin_q, cos_q * cos_a
    matrices[:, 1, 2], matrices[:, 1, 3] = -cos_q * sin_a, arm.a[i] * sin_q
    matrices[:, 2, 1], matrices[:, 2, 2], matrices[:, 2, 3] = sin_a, cos_a, arm.d[i]
    matrices[:, 3, 3] = 1.0
    if arm.beta[i] == 0.0:
        return matrices
    cos_b, sin_b = np.cos(arm.beta[i]), np.sin(arm.beta[i])
    hayati = np.eye(4)
    hayati[0, 0], hayati[0, 2], hayati[2, 0], hayati[2, 2] = cos_b, sin_b, -sin_b, cos_b
    return matrices @ hayati


def _linearise(
    arm: DhArm, joints: FloatArray, goal: FloatArray, scale: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Geometric Jacobian (m, 6, n) and pose error (m, 6), in the base frame and scaled."""
    frames = link_frames(arm, joints)
    axes, origins = frames[:, :-1, :3, 2], frames[:, :-1, :3, 3]
    tip = frames[:, -1]
    levers = cross(axes, tip[:, None, :3, 3] - origins)
    jacobian = np.swapaxes(np.concatenate([axes, levers], axis=2), 1, 2)
    # Half the sum of the axes' cross products: zero if the rotations agree, and also at a
    # difference of half a turn, which is handled separately.
    tip_axes, goal_axes = (np.swapaxes(array[:, :3, :3], 1, 2) for array in (tip, goal))
    rotation = 0.5 * cross(tip_axes, goal_axes).sum(axis=1)
    opposed = np.einsum("mij,mij->m", tip[:, :3, :3], goal[:, :3, :3]) < 0.0
    rotation[opposed] *= 2.0 / np.maximum(np.linalg.norm(rotation[opposed], axis=1), 1e-3)[:, None]
    translation = goal[:, :3, 3] - tip[:, :3, 3]
    error = np.concatenate([rotation, translation], axis=1)
    return jacobian * scale[:, None], error * scale
