"""Simulated arms: published geometry, errors, deflection, heat, forward and inverse kinematics.

The chain is implemented here in plain numpy, independent of the application's robot model, so that
an error in the chain cannot cancel out.

A joint is heated by its motor's current and cooled by the ambient air: a first-order RC element,
integrated exactly for a duty that is constant between samples. The link after a joint follows the
joint's temperature and expands in proportion, and the joint's zero drifts.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from visioncal.core.choices import SIMULATED_ARMS
from visioncal.core.codec import Finite, NotNegative, Strict
from visioncal.core.errors import DataError
from visioncal.core.number_format import known_name
from visioncal.core.transforms import cross, exp
from visioncal.core.types import FloatArray

_QUARTER, _HALF_TURN = 0.5 * np.pi, np.pi
# Ripples per turn of a strain-wave gear of ratio 100: two per turn of its wave generator.
_TEETH = 200
# Nodes per turn of the joints' error functions, which are linear in between.
_NODES = 1440
GRAVITY = np.array([0.0, 0.0, -9.80665])
# Masses [kg] and centres of mass [m] in the link frames, from Universal Robots, "DH parameters for
# calculations of kinematics and dynamics"; round numbers for the other arm.
BODIES: Mapping[str, Sequence[tuple[float, Sequence[float]]]] = {
    "ur3e": (
        (1.98, (0.0, -0.02, 0.0)),
        (3.4445, (0.13, 0.0, 0.1157)),
        (1.437, (0.05, 0.0, 0.0238)),
        (0.871, (0.0, 0.0, 0.01)),
        (0.805, (0.0, 0.0, 0.01)),
        (0.261, (0.0, 0.0, -0.02)),
    ),
    "ur5e": (
        (3.761, (0.0, -0.02561, 0.00193)),
        (8.058, (0.2125, 0.0, 0.11336)),
        (2.846, (0.15, 0.0, 0.0265)),
        (1.37, (0.0, -0.0018, 0.01634)),
        (1.3, (0.0, 0.0018, 0.01634)),
        (0.365, (0.0, 0.0, -0.001159)),
    ),
    "ur10e": (
        (7.369, (0.021, 0.0, 0.027)),
        (13.051, (0.38, 0.0, 0.158)),
        (3.989, (0.24, 0.0, 0.068)),
        (2.1, (0.0, 0.007, 0.018)),
        (1.98, (0.0, 0.007, 0.018)),
        (0.615, (0.0, 0.0, -0.026)),
    ),
    "generic-6r-1800": (
        (120.0, (-0.1, 0.1, 0.0)),
        (75.0, (-0.45, 0.0, 0.1)),
        (60.0, (-0.05, 0.0, 0.15)),
        (25.0, (0.0, -0.3, 0.0)),
        (10.0, (0.0, 0.0, 0.03)),
        (5.0, (0.0, 0.0, -0.04)),
    ),
}
JOINTS = 6


@dataclass(frozen=True, eq=False)
class DhArm:
    """A serial arm in standard Denavit-Hartenberg form.

    Link i is `Rz(q_i + offset_i) Tz(d_i) Tx(a_i) Rx(alpha_i) Ry(beta_i)`, or `Rz(offset_i)
    Tz(d_i + q_i) ...` of a joint that slides by q_i [m]. The last rotation is
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
    slides: tuple[int, ...] = ()  # The joints that slide, from 0.

    @property
    def is_planar(self) -> bool:
        """Whether the flange turns about the vertical alone."""
        return self.a.size < JOINTS


@dataclass(frozen=True)
class Payload(Strict):
    """A load on the flange, and a force on it."""

    kg: NotNegative = 0.0  # Mass [kg].
    # Centre of mass in the flange frame [m].
    centre_m: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    # Force on the flange's origin, in the base frame [N].
    force_n: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)

    def row(self) -> dict[str, float]:
        """Values of a session's payload columns."""
        centre = {
            f"payload_{name}_m": value for name, value in zip("xyz", self.centre_m, strict=True)
        }
        force = {f"force_{name}_n": value for name, value in zip("xyz", self.force_n, strict=True)}
        return {"payload_kg": self.kg} | centre | force


@dataclass(frozen=True, eq=False, kw_only=True)
class ArmOptions:
    """An arm, standard deviations of the real one from it, and its payloads."""

    dh_sigma_m: NotNegative = 0.0  # Every length a and d [m].
    dh_sigma_rad: NotNegative = 0.0  # Every alpha, beta and joint offset [rad].
    offset_sigma_rad: NotNegative = 0.0  # Joint offsets, in addition to `dh_sigma_rad` [rad].
    # Sine and cosine amplitudes of the joint errors at the joint's angle [rad].
    eccentricity_sigma_rad: NotNegative = 0.0
    # Likewise for the gear's ripple, many times per turn [rad].
    ripple_sigma_rad: NotNegative = 0.0
    # Further joint errors as arbitrary functions of the angle [rad].
    function_sigma_rad: NotNegative = 0.0
    function_length_rad: NotNegative = 0.06  # Correlation length of these functions [rad].
    robot: str = "ur10e"  # A name among `SIMULATED_ARMS`.
    robot_sigma_m: NotNegative = 3e-5  # Repeatability of the flange's position, per axis [m].
    robot_sigma_rad: NotNegative = 5e-5  # Repeatability of its rotation, per axis [rad].
    # Compliance of each joint; empty for a rigid arm.
    compliance_rad_per_nm: tuple[NotNegative, ...] = ()
    payloads: tuple[Payload, ...] = ()  # Payloads, cycled over the stops; empty for none.
    # Whether the controller compensates what the arm's own weight bends: only loads show then.
    weight_compensated: bool = False
    # Backlash of each joint; empty for none. With backlash, stops are approached from alternating
    # sides.
    backlash_rad: tuple[Finite, ...] = ()

    @property
    def sigma(self) -> FloatArray:
        """(6,) repeatability of the flange: rotation [rad], translation [m]."""
        return np.repeat([self.robot_sigma_rad, self.robot_sigma_m], 3)

    def loads(self, stops: int) -> tuple[Payload, ...]:
        """Payload of each of `stops` stops; empty without payloads."""
        loads = self.payloads
        return tuple(loads[at % len(loads)] for at in range(stops)) if loads else ()

    def approach(self, stops: int) -> FloatArray | None:
        """(stops,) side from which stops are approached, +1 or -1; None without backlash."""
        return np.where(np.arange(stops) % 2, 1.0, -1.0) if self.backlash_rad else None

    def built(self, rng: np.random.Generator) -> DhArm:
        """Draws the real arm.

        The same generator state gives the same error directions, whatever their size.
        """
        arm = arm_named(self.robot)
        draws, waves = rng.standard_normal((6, arm.a.size)), rng.standard_normal((4, arm.a.size))
        sizes = np.repeat([self.eccentricity_sigma_rad, self.ripple_sigma_rad], 2)
        beyond = arm.beyond
        # Drawn only if needed, so that later draws do not change.
        if self.function_sigma_rad:
            # Smooth periodic functions: filtered white noise on a circle.
            angles = np.linspace(0.0, 2.0 * np.pi, _NODES, endpoint=False)
            kernel = np.exp(-2.0 * np.sin(0.5 * angles) ** 2 / self.function_length_rad**2)
            power = np.sqrt(np.maximum(np.fft.rfft(kernel).real, 0.0))[:, None]
            white = np.fft.rfft(rng.standard_normal((_NODES, arm.a.size)), axis=0)
            beyond = self.function_sigma_rad * np.fft.irfft(power * white, _NODES, axis=0)
        return replace(
            arm,
            a=arm.a + self.dh_sigma_m * draws[0],
            d=arm.d + self.dh_sigma_m * draws[1],
            alpha=arm.alpha + self.dh_sigma_rad * draws[2],
            beta=arm.beta + self.dh_sigma_rad * draws[3],
            offset=arm.offset + self.dh_sigma_rad * draws[4] + self.offset_sigma_rad * draws[5],
            waves=arm.waves + sizes[:, None] * waves,
            beyond=beyond,
        )

    def flange_at(
        self,
        arm: DhArm,
        q: FloatArray,
        payloads: Sequence[Payload] = (),
        approach: FloatArray | None = None,
    ) -> FloatArray:
        """Flange poses (k, 4, 4) of a real arm, before repeatability errors.

        `q` are (k, n) encoder angles [rad]. Without payloads there are none; without sides of
        approach (k,), the arm is in the middle of its backlash.

        Raises:
            DataError: There is not one compliance or backlash per joint.
        """
        for name, values in (
            ("compliance", self.compliance_rad_per_nm),
            ("backlash", self.backlash_rad),
        ):
            if len(values) not in (0, q.shape[1]):
                raise DataError(
                    f"simulation: {len(values)} values of {name} for {q.shape[1]} joints."
                )
        if approach is not None and self.backlash_rad:
            # A joint that approached from above stops short of its encoder angle.
            q = q + 0.5 * approach[:, None] * np.array(self.backlash_rad)
        bent = loaded_joints(arm, self.compliance_rad_per_nm, q, payloads)
        if self.weight_compensated:
            bent = bent - loaded_joints(arm, self.compliance_rad_per_nm, q) + q
        return forward(arm, bent)

    def jitter(self, stops: int, rng: np.random.Generator) -> FloatArray:
        """(stops, 4, 4) repeatability errors of the flange, in its own frame."""
        return exp(rng.standard_normal((stops, 6)) * self.sigma)


@dataclass(frozen=True, eq=False)
class Reach:
    """Result of the inverse kinematics."""

    joints: FloatArray  # (m, n) joint angles [rad], valid where `solved`.
    solved: npt.NDArray[np.bool_]  # (m,) whether the pose was reached within the joints' limits.
    # (m,) smallest singular value of the Jacobian with lengths in units of the arm's reach; zero in
    # a singular posture.
    dexterity: FloatArray


def arm_named(name: str) -> DhArm:
    """Nominal arm by name, from the controller's base frame to the flange.

    Those of Universal Robots' e-Series have the manufacturer's values ("DH parameters for
    calculations of kinematics and dynamics"). `generic-6r-1800` is no actual model: round numbers
    in the proportions of a medium industrial robot of 1.8 m reach, with a shoulder offset from the
    first axis and a spherical wrist; so is `generic-scara-600`, of two arms and a quill.

    Raises:
        DataError: There is no arm of that name.
    """
    # d1, a2, a3, d4, d5, d6 [m]
    published = {
        "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
        "ur5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
        "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    }
    known_name("simulated arm", name, SIMULATED_ARMS, "robot", "Name one of these.")
    a, d, quarters = [0.18, 0.8, 0.18, 0, 0, 0], [0.5, 0, 0, 0.8, 0, 0.13], [-1, 0, -1, 1, -1, 0]
    if name in published:
        d1, a2, a3, d4, d5, d6 = published[name]
        a, d, quarters = [0.0, a2, a3, 0, 0, 0], [d1, 0, 0, d4, d5, d6], [1, 0, 0, 1, -1, 0]
    elif name == "generic-scara-600":
        a, d, quarters = [0.325, 0.275, 0, 0], [0.4, 0, 0, 0.05], [0, 2, 0, 0]
    none = np.zeros((4, len(a)))
    offset, slides = none[0].copy(), (2,) if len(a) < JOINTS else ()
    if name == "generic-6r-1800":
        offset[[1, 5]] = -_QUARTER, _HALF_TURN
    alpha = _QUARTER * np.array(quarters)
    return DhArm(name, np.array(a), np.array(d), alpha, none[0], offset, none, slides=slides)


def drawn_postures(arm: DhArm, count: int, rng: np.random.Generator) -> FloatArray:
    """(count, n) random postures: angles up to 2.5 rad, and strokes [m]."""
    q = rng.uniform(-2.5, 2.5, (count, arm.a.size))
    # Stroke of a joint that slides [m].
    q[:, arm.slides] = 0.2 * (0.5 + q[:, arm.slides] / 5.0)
    return q


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


def loaded_joints(
    arm: DhArm, compliance: Sequence[float], joints: FloatArray, payloads: Sequence[Payload] = ()
) -> FloatArray:
    """True joint angles under load.

    Args:
        arm: Real arm.
        compliance: Compliance of each joint [rad/(N m)]; empty for a rigid arm.
        joints: (m, n) encoder angles [rad].
        payloads: m payloads, one per stop; empty for none.

    Returns:
        (m, n) equivalent angles of a rigid arm [rad].
    """
    sagged = joints
    if arm.slides and any(compliance):
        raise DataError(f"simulation: the joints of the {arm.name} do not bend by weight.")
    # Each changes the levers by about a hundredth.
    for _ in range(8 if any(compliance) else 0):
        sagged = joints + np.array(compliance) * load_torques(arm, sagged, payloads)
    return sagged


def load_torques(arm: DhArm, joints: FloatArray, payloads: Sequence[Payload]) -> FloatArray:
    """(m, n) torques of weight and force on the joints [N m]: moments about the axes.

    They are computed from the simulated arm's own frames, independent of the application's model.
    """
    frames = link_frames(arm, joints)
    kg, centres = (np.array(pair) for pair in zip(*BODIES[arm.name], strict=True))
    weights = kg[:, None] * GRAVITY
    lever = frames[:, 1:, :3, :3] @ centres[:, :, None]
    places = lever[..., 0] + frames[:, 1:, :3, 3]
    forces = np.broadcast_to(weights, places.shape)
    if payloads:
        tip = frames[:, -1]
        payload_centres = np.array([payload.centre_m for payload in payloads])
        payload_places = np.einsum("mij,mj->mi", tip[:, :3, :3], payload_centres) + tip[:, :3, 3]
        load = np.array([payload.kg for payload in payloads])[:, None] * GRAVITY
        flange_forces = np.array([payload.force_n for payload in payloads])
        places = np.concatenate([places, payload_places[:, None], tip[:, None, :3, 3]], axis=1)
        forces = np.concatenate([forces, load[:, None], flange_forces[:, None]], axis=1)
    torques = np.empty(joints.shape)
    for joint in range(joints.shape[1]):
        axis, origin = frames[:, joint, :3, 2], frames[:, joint, :3, 3]
        # Links after the joint load it; payload and force come after all links.
        moments = np.cross(places[:, joint:] - origin[:, None], forces[:, joint:])
        torques[:, joint] = np.einsum("mi,mki->m", axis, moments)
    return torques


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
    joint_angle, d = angle + arm.offset[i], arm.d[i]
    if i in arm.slides:
        joint_angle, d = np.full(angle.shape, arm.offset[i]), arm.d[i] + angle
    elif arm.waves[:, i].any():
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
    matrices[:, 2, 1], matrices[:, 2, 2], matrices[:, 2, 3] = sin_a, cos_a, d
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
    slides = np.isin(np.arange(arm.a.size), arm.slides)[:, None]
    levers, axes = np.where(slides, axes, levers), np.where(slides, 0.0, axes)
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
