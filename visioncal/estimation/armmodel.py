"""An arm whose errors are being estimated: its model, and how its flange moves with them."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from visioncal.core.quantiles import f_limit
from visioncal.core.transforms import adjoint, invert, log, mean_transform
from visioncal.core.types import FloatArray, Mask
from visioncal.estimation.arm import TWIST_UNITS, ArmErrors
from visioncal.robot import Loads, Robot, WeightFunctions, bent_joints

# Columns of a joint's function (see `Robot.function_jacobian`) that a block changes.
_FUNCTIONS = {"offsets": (0,), "ratios": (1,), "eccentricity": (2, 3)}
# What goes by the loads of a stop, and by the side from which it was approached; the others are
# the same at all stops.
COMPLIANCE, BACKLASH, WEIGHT = "compliance", "backlash", "weight"
# Functions of the joints beyond their eccentricity.
HARMONICS = "harmonics"
RIGID = ("links", *_FUNCTIONS)
# The mean of fewer twists says nothing of their noise; that of noise is beyond with this chance.
_FEWEST_TWISTS, _BY_CHANCE = 6, 1e-3


@dataclass(frozen=True, eq=False)
class ArmModel:
    """A robot's nominal model and the present values of its errors.

    Attributes:
        nominal: The model as stated.
        flange_from_reported: (4, 4) the frame of the reported poses in the model's flange.
        weights: The blocks by name with the size of their errors, as a share of the first's:
            `offsets` of the joints, `links` (each by six, behind its joint), `ratios` of the gears,
            `eccentricity` (sine and cosine of each joint), `compliance` and `backlash` of each
            joint, how far it yields to the `weight` of links whose masses are not known, and
            `harmonics` of the joints' functions.
        values: (p,) present values [rad], block after block; all are of the first block's size.
        torque_nm: The torque under which a joint whose compliance is 1 rad bends by that [N m].
        yielding: (n,) which joints bend; None for all.
        functions: What the weight of links of unknown masses may do; None where it is known.
        harmonic_directions: (2 n k, r) what each of the values of `harmonics` makes of sine and
            cosine of each joint and order from 2 on.
        harmonic_sizes: (2 n k,) how large these are, relative to the size of their block; what
            `harmonic_directions` leaves of them is as open as it was.
    """

    nominal: Robot
    flange_from_reported: FloatArray
    weights: Mapping[str, float]
    values: FloatArray
    torque_nm: float = 1.0
    yielding: Mask | None = None
    functions: WeightFunctions | None = None
    harmonic_directions: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    harmonic_sizes: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, nominal: Robot, q: FloatArray, reported: FloatArray) -> "ArmModel":
        """The nominal arm with what is mounted on its flange, without any errors.

        Args:
            nominal: The model.
            q: (m, n) joint angles [rad].
            reported: (m, 4, 4) what the controller reported for them.
        """
        tools = invert(nominal.base_from_flange(q)) @ reported
        # The mean of noise is no tool.
        tool = np.eye(4) if _is_noise(log(tools)) else mean_transform(tools)
        functions = WeightFunctions.of(nominal) if nominal.masses is None else None
        return cls(nominal, tool, {}, np.zeros(0), functions=functions)

    def loaded(self, q: FloatArray, loads: Loads | None = None) -> "ArmModel":
        """Returns the arm with compliances in units of the greatest torque of some stops.

        Args:
            q: (m, n) joint angles [rad].
            loads: What the flange carries; nothing where None.
        """
        most = float(np.abs(self.robot.load_torques(q, loads)).max(initial=0.0))
        return replace(self, torque_nm=most or 1.0)

    def erring(self, errors: Mapping[str, ArmErrors]) -> "ArmModel":
        """Returns the arm with the errors of some blocks to be estimated."""
        sizes = sum(error.basis.shape[2] for error in errors.values())
        first = next(iter(errors.values())).sigma
        weights = {name: error.sigma / first for name, error in errors.items()}
        springs = errors.get(COMPLIANCE)
        yielding = None if springs is None else np.any(springs.basis, axis=(0, 1)) > 0
        return replace(self, weights=weights, values=np.zeros(sizes), yielding=yielding)

    def moved(self, step: FloatArray) -> "ArmModel":
        """Returns the arm after a (p,) step of its values."""
        return replace(self, values=self.values + step)

    @cached_property
    def robot(self) -> Robot:
        """The arm with its errors, up to the frame of the reported poses."""
        mounted = np.zeros((self.nominal.joint_count + 1, 6))
        mounted[-1] = log(self.flange_from_reported)
        return self.bare.corrected(mounted)

    @cached_property
    def bare(self) -> Robot:
        """The arm with its errors, up to its own flange."""
        return self.nominal.corrected(*self.changes(self.values), self.harmonics)

    @cached_property
    def compliance(self) -> FloatArray:
        """(n,) what each joint yields to a torque [rad/(N m)]."""
        springs = np.maximum(self._joint_values(COMPLIANCE) / self.torque_nm, 0.0)
        return springs if self.yielding is None else np.where(self.yielding, springs, 0.0)

    @cached_property
    def backlash(self) -> FloatArray:
        """(n,) play of each joint: how far apart it stands when approached from its sides [rad]."""
        return self._joint_values(BACKLASH)

    @cached_property
    def moments(self) -> FloatArray | None:
        """(n, 4 n) compliances times unknown masses and first moments; None without any."""
        if WEIGHT not in self.weights or self.functions is None:
            return None
        return self.functions.moments(self.weights[WEIGHT] * self.values[self.place_of(WEIGHT)])

    def size_of(self, name: str) -> int:
        """How many values a block has."""
        if name == WEIGHT:
            return 0 if self.functions is None else self.functions.size
        if name == HARMONICS:
            return int(self.harmonic_directions.shape[1])
        return block_size(name, self.nominal.joint_count)

    @cached_property
    def values_by_stop(self) -> FloatArray:
        """(p,) the values of what goes by the loads of a stop; zero for what its `robot` has."""
        values = np.zeros(len(self.values))
        for name in (COMPLIANCE, BACKLASH, WEIGHT):
            values[self.place_of(name)] = self.values[self.place_of(name)]
        return values

    def place_of(self, name: str) -> slice:
        """Where a block's values stand among all; empty where it is not there."""
        at = 0
        for block in self.weights:
            size = self.size_of(block)
            if block == name:
                return slice(at, at + size)
            at += size
        return slice(at, at)

    @property
    def harmonics(self) -> FloatArray | None:
        """(n, k, 2) harmonics of the joints' functions [rad]; None without any."""
        if HARMONICS not in self.weights:
            return None
        found = self.harmonic_directions @ self.values[self.place_of(HARMONICS)]
        return np.asarray(self.weights[HARMONICS] * found.reshape(self.nominal.joint_count, -1, 2))

    @property
    def is_kept(self) -> Mask:
        """(p,) which values are no harmonics."""
        kept = np.ones(len(self.values), dtype=bool)
        kept[self.place_of(HARMONICS)] = False
        return kept

    def left_open(self, q: FloatArray) -> FloatArray:
        """(m, 6, 6) covariance of the flange by functions of the joints that no stop determines.

        It is that for errors of unit size.
        """
        if HARMONICS not in self.weights:
            return np.zeros((len(q), 6, 6))
        orders = len(self.harmonic_sizes) // (2 * self.nominal.joint_count)
        moved = self.weights[HARMONICS] * self.robot.harmonic_jacobian(q, orders)
        whole, known = moved * self.harmonic_sizes, moved @ self.harmonic_directions
        return np.asarray(whole @ np.swapaxes(whole, 1, 2) - known @ np.swapaxes(known, 1, 2))

    def _joint_values(self, name: str) -> FloatArray:
        """The values (n,) of a block that has one a joint; zeros where it is not there."""
        if name not in self.weights:
            return np.zeros(self.nominal.joint_count)
        return np.asarray(self.weights[name] * self.values[self.place_of(name)])

    def bent(self, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """Where the joints stand under their loads, as angles (m, n) of the rigid arm [rad].

        Args:
            q: (m, n) joint angles [rad].
            loads: What the flange carries, and from where it came; only the arm's own weight bends
                it, in the middle of its play, where None.
        """
        if loads is not None and self.backlash.any():
            q = q + 0.5 * loads.side[:, None] * self.backlash
        return bent_joints(self.robot, q, self.compliance, loads, self.moments)

    def base_from_flange(self, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """Where the reported frame stands (m, 4, 4); see `bent`."""
        return self.robot.base_from_flange(self.bent(q, loads))

    def changes(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What (p,) values change: twists (n + 1, 6) of the placements, and functions (n, 4)."""
        count, at = self.nominal.joint_count, 0
        placements, functions = np.zeros((count + 1, 6)), np.zeros((count, 4))
        for name, weight in self.weights.items():
            size = self.size_of(name)
            block = weight * values[at : at + size]
            at += size
            if name == "links":
                placements[1:] += block.reshape(-1, 6) * TWIST_UNITS
            elif name in _FUNCTIONS:
                functions[:, _FUNCTIONS[name]] += block.reshape(-1, count).T
        return placements, functions

    def columns(self, name: str, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """How the reported frame moves with a block's errors.

        Args:
            name: The block.
            q: (m, n) joint angles [rad].
            loads: What the flange carries; nothing where None.

        Returns:
            (m, 6, p) right perturbations for a unit of each column.
        """
        bent = self.bent(q, loads)
        if name == BACKLASH:
            sides = np.zeros(len(q)) if loads is None else loads.side
            return np.asarray(0.5 * sides[:, None, None] * self.robot.axis_jacobian(bent))
        if name == WEIGHT and self.functions is not None:
            shares = self.functions.bends(self.robot, bent)
            return np.asarray(self.robot.axis_jacobian(bent) @ shares)
        if name == COMPLIANCE:
            torques = self.robot.load_torques(bent, loads) / self.torque_nm
            if self.yielding is not None:
                torques = torques * self.yielding
            return np.asarray(self.robot.axis_jacobian(bent) * torques[:, None])
        if name == "links":
            moved = self.robot.placement_jacobian(bent)[:, :, 6:]
            units = np.tile(TWIST_UNITS, self.nominal.joint_count)
            # The last link's own twist acts on the flange, before what is mounted on it.
            moved[:, :, -6:] = adjoint(invert(self.flange_from_reported))
            return np.asarray(moved * units)
        if name == HARMONICS:
            orders = len(self.harmonic_directions) // (2 * self.nominal.joint_count)
            moved = self.robot.harmonic_jacobian(bent, orders)
            return np.asarray(moved @ self.harmonic_directions)
        count = self.nominal.joint_count
        functions = self.robot.function_jacobian(bent).reshape(len(q), 6, count, 4)
        return np.concatenate([functions[..., function] for function in _FUNCTIONS[name]], axis=2)

    def basis(self, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """How the reported frame (m, 6, p) moves with all values, under the loads of each stop."""
        return np.concatenate(
            [weight * self.columns(name, q, loads) for name, weight in self.weights.items()], axis=2
        )

    def kept_basis(self, q: FloatArray) -> FloatArray:
        """The columns of `basis` that are of no harmonics."""
        rest = {name: weight for name, weight in self.weights.items() if name != HARMONICS}
        return np.concatenate(
            [value * self.columns(name, q) for name, value in rest.items()], axis=2
        )


def _is_noise(twists: FloatArray) -> bool:
    """Whether the mean of (m, 6) twists is zero but for what they scatter by, alike in all axes."""
    count = len(twists)
    if count < _FEWEST_TWISTS:
        return False
    mean = twists.mean(axis=0).reshape(2, 3)
    scatter = (twists - twists.mean(axis=0)).reshape(count, 2, 3).var(axis=(0, 2), ddof=1)
    limit = f_limit(_BY_CHANCE, 3, 3 * (count - 1))
    return bool((count * (mean**2).mean(axis=1) <= limit * scatter).all())


def blocks_of(robot: Robot, loads: Loads) -> tuple[str, ...]:
    """The blocks of which stops with such loads can determine something."""
    springs = (COMPLIANCE,) if robot.masses is not None or loads.any else ()
    weighs = () if robot.masses is not None else (WEIGHT,)
    plays = (BACKLASH,) if loads.from_both_sides else ()
    return (*RIGID, *springs, *weighs, *plays)


def block_size(name: str, joints: int) -> int:
    """How many values a block has, for an arm of so many joints: of all that depends on no more."""
    if name in (COMPLIANCE, BACKLASH):
        return joints
    return (6 if name == "links" else len(_FUNCTIONS[name])) * joints
