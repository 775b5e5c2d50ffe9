"""Kinematic model of an arm whose errors are estimated, and its Jacobian."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.core.limits import FEWEST_STOPS
from visioncal.core.quantiles import FALSE_REJECTION, f_limit
from visioncal.core.transforms import adjoint, invert, log, mean_transform
from visioncal.core.types import FloatArray, Mask
from visioncal.robot import Loads, Robot
from visioncal.robot.elasticity import WeightFunctions, deflected_joints
from visioncal.robot.errors import TWIST_UNITS

# Groups that depend on a stop's loads and on the side of approach; the others are the same at all
# stops.
COMPLIANCE, BACKLASH, WEIGHT = "compliance", "backlash", "weight"
# Functions of the joints beyond their eccentricity.
HARMONICS = "harmonics"
# Growth and drift with temperature, which have a model and a fit of their own.
HEAT = "heat"
# Levels that can be asked for: each has the groups of those before it, and more.
LEVELS = ("hand-eye", "offsets", "kinematics", "elastic", "thermal", "auto")


@dataclass(frozen=True)
class Group:
    """Errors of an arm's links or joints that have one size: a level is those that are not zero."""

    opened_by: str  # Level that asks for them.
    level: str  # Name of the level of an arm that has them, in its result.
    # Usual size [rad], within a factor of e; of a compliance for 10 N m.
    usual_rad: float
    per_joint: int = 1  # Number of values a joint; 0 where it depends on the arm.
    functions: tuple[int, ...] = ()  # Columns of a joint's function; see `function_jacobian`.


GROUPS: Mapping[str, Group] = {
    "links": Group("kinematics", "geometry", 7e-4, 6),
    "offsets": Group("offsets", "offsets", 7e-4, functions=(0,)),
    "ratios": Group("kinematics", "eccentricity", 1e-4, functions=(1,)),
    "eccentricity": Group("kinematics", "eccentricity", 1.5e-4, 2, functions=(2, 3)),
    COMPLIANCE: Group("elastic", "elastic", 1e-4),
    WEIGHT: Group("elastic", "elastic", 1e-4, 0),
    BACKLASH: Group("offsets", "backlash", 1e-4),
    HARMONICS: Group("kinematics", "functions", 2e-4, 0),
    HEAT: Group("thermal", "thermal", 1.0, 0),
}
RIGID = ("links", *(name for name, group in GROUPS.items() if group.functions))


def groups_of(level: str) -> tuple[str, ...]:
    """The groups that a level asks for."""
    rank = LEVELS.index(level)
    return tuple(name for name, group in GROUPS.items() if LEVELS.index(group.opened_by) <= rank)


@dataclass(frozen=True, eq=False)
class JointFunctions:
    """Estimated functions of an arm's n joints, by k harmonics from order 2 on."""

    # (2 n k,) prior sizes of sine and cosine of each joint and order, relative to their block.
    sizes: FloatArray
    # (2 n k, r) Jacobian of these by the block's values: combinations that the observations
    # determine. Parameters beyond its span keep their prior.
    directions: FloatArray
    length_rad: float  # Their correlation length over the joint angle [rad].
    gain: float  # Twice the gain in log-likelihood over the same arm without them.


@dataclass(frozen=True, eq=False)
class ArmModel:
    """A robot's nominal model and the current values of its errors."""

    nominal: Robot  # The nominal model.
    # (4, 4) the frame of the reported poses in the model's flange.
    flange_from_reported: FloatArray
    # The blocks by name with the size of their errors, relative to the first's: `offsets` of the
    # joints, `links` (each by six, behind its joint), `ratios` of the gears, `eccentricity` (sine
    # and cosine of each joint), `compliance` and `backlash` of each joint, `weight` (compliances
    # times unknown link masses), and `harmonics` of the joints' functions.
    weights: Mapping[str, float]
    # (p,) current values [rad], block after block, in units of the first block's size.
    values: FloatArray
    # The torque under which a joint whose compliance is 1 rad bends by that [N m].
    torque_nm: float = 1.0
    yielding: Mask | None = None  # (n,) mask of the joints that bend; None for all.
    # Bending functions of unknown link masses; None where masses are known.
    functions: WeightFunctions | None = None
    waves: JointFunctions | None = None  # Functions of the joints; None without any.
    error_rad: float = 1.0  # Standard deviation of the values [rad].

    @classmethod
    def of(cls, nominal: Robot, q: FloatArray, reported: FloatArray) -> "ArmModel":
        """The nominal arm with the tool mounted on its flange, without any errors.

        Args:
            nominal: The model.
            q: (m, n) joint angles [rad].
            reported: (m, 4, 4) poses that the controller reported for them.
        """
        tools = invert(nominal.base_from_flange(q)) @ reported
        # The mean of noise is no tool.
        tool = np.eye(4) if _is_noise(log(tools)) else mean_transform(tools)
        functions = WeightFunctions.of(nominal) if nominal.masses is None else None
        return cls(nominal, tool, {}, np.zeros(0), functions=functions)

    def loaded(self, q: FloatArray, loads: Loads | None = None) -> "ArmModel":
        """Returns the arm with compliances in units of the greatest torque at (m, n) `q` [rad]."""
        greatest = float(np.abs(self.robot.load_torques(q, loads)).max(initial=0.0))
        return replace(self, torque_nm=greatest or 1.0)

    def with_errors(
        self,
        sizes: Mapping[str, float],
        yielding: Mask | None = None,
        functions: JointFunctions | None = None,
    ) -> "ArmModel":
        """Returns the arm with error blocks to be estimated, all zero, by their sizes [rad].

        `yielding` are the joints that bend, where `compliance` is among the blocks, and `functions`
        those of the joints, where `harmonics` is.
        """
        first = next(iter(sizes.values()))
        weights = {name: size / first for name, size in sizes.items()}
        arm = replace(self, weights=weights, error_rad=first, yielding=yielding, waves=functions)
        return replace(arm, values=np.zeros(sum(map(arm.size_of, weights))))

    def moved(self, step: FloatArray) -> "ArmModel":
        """Returns the arm after a (p,) step of its values."""
        return replace(self, values=self.values + step)

    @cached_property
    def robot(self) -> Robot:
        """The arm with its errors, up to the frame of the reported poses."""
        if np.array_equal(self.flange_from_reported, np.eye(4)):
            return self.bare
        mounted = np.zeros((self.nominal.joint_count + 1, 6))
        mounted[-1] = log(self.flange_from_reported)
        return self.bare.corrected(mounted)

    @cached_property
    def bare(self) -> Robot:
        """The arm with its errors, up to its own flange."""
        if not len(self.values):
            return self.nominal
        return self.nominal.corrected(*self.changes(self.values), self.harmonics)

    @cached_property
    def compliance(self) -> FloatArray:
        """(n,) compliance of each joint [rad/(N m)]."""
        compliance = np.maximum(self._joint_values(COMPLIANCE) / self.torque_nm, 0.0)
        return compliance if self.yielding is None else np.where(self.yielding, compliance, 0.0)

    @cached_property
    def backlash(self) -> FloatArray:
        """(n,) play of each joint: difference of its angle between both sides of approach [rad]."""
        return self._joint_values(BACKLASH)

    @cached_property
    def moments(self) -> FloatArray | None:
        """(n, 4 n) compliances times unknown masses and first moments; None without any."""
        if WEIGHT not in self.weights or self.functions is None:
            return None
        return self.functions.moments(self.weights[WEIGHT] * self.values[self.columns_of(WEIGHT)])

    def size_of(self, name: str) -> int:
        """Number of values in a block."""
        if name == WEIGHT:
            return 0 if self.functions is None else self.functions.size
        if name == HARMONICS:
            return 0 if self.waves is None else int(self.waves.directions.shape[1])
        return GROUPS[name].per_joint * self.nominal.joint_count

    @cached_property
    def values_by_stop(self) -> FloatArray:
        """(p,) values of the load-dependent blocks; zero for those that `robot` contains."""
        values = np.zeros(len(self.values))
        for name in (COMPLIANCE, BACKLASH, WEIGHT):
            values[self.columns_of(name)] = self.values[self.columns_of(name)]
        return values

    def columns_of(self, name: str) -> slice:
        """Slice of a block among all values; empty where the arm lacks the block."""
        return self._slices.get(name, slice(0, 0))

    @cached_property
    def _slices(self) -> dict[str, slice]:
        ends = np.cumsum([self.size_of(name) for name in self.weights], dtype=int).tolist()
        return dict(zip(self.weights, map(slice, [0, *ends], ends), strict=True))

    @property
    def harmonics(self) -> FloatArray | None:
        """(n, k, 2) harmonics of the joints' functions [rad]; None without any."""
        if self.waves is None:
            return None
        waves = self.waves.directions @ self.values[self.columns_of(HARMONICS)]
        return np.asarray(self.weights[HARMONICS] * waves.reshape(self.nominal.joint_count, -1, 2))

    @property
    def is_kept(self) -> Mask:
        """(p,) mask of the values other than harmonics."""
        kept = np.ones(len(self.values), dtype=bool)
        kept[self.columns_of(HARMONICS)] = False
        return kept

    def undetermined_covariance(self, q: FloatArray) -> FloatArray:
        """Flange covariance (m, 6, 6) by the undetermined part of the joints' functions.

        It is that for errors of unit size.
        """
        if self.waves is None:
            return np.zeros((len(q), 6, 6))
        jacobian = self.weights[HARMONICS] * self._wave_jacobian(q, self.waves)
        prior, known = jacobian * self.waves.sizes, jacobian @ self.waves.directions
        return np.asarray(prior @ np.swapaxes(prior, 1, 2) - known @ np.swapaxes(known, 1, 2))

    def _wave_jacobian(self, q: FloatArray, waves: JointFunctions) -> FloatArray:
        orders = len(waves.sizes) // (2 * self.nominal.joint_count)
        return self.robot.harmonic_jacobian(q, orders)

    def _joint_values(self, name: str) -> FloatArray:
        """Values (n,) of a block with one per joint; zeros where the arm lacks it."""
        if name not in self.weights:
            return np.zeros(self.nominal.joint_count)
        return np.asarray(self.weights[name] * self.values[self.columns_of(name)])

    def bent(self, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """Joint angles (m, n) of the rigid arm that has the same posture under load [rad].

        Args:
            q: (m, n) joint angles [rad].
            loads: Loads of the flange, and its sides of approach; with None only the arm's own
                weight bends it, in the middle of its play.
        """
        if loads is not None and self.backlash.any():
            q = q + 0.5 * loads.sides * self.backlash
        return deflected_joints(self.robot, q, self.compliance, loads, self.moments)

    def base_from_flange(self, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """Poses (m, 4, 4) of the reported frame; see `bent`."""
        return self.robot.base_from_flange(self.bent(q, loads))

    def changes(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Changes by (p,) values: twists (n + 1, 6) of the placements, and functions (n, 4)."""
        count = self.nominal.joint_count
        placements, functions = np.zeros((count + 1, 6)), np.zeros((count, 4))
        for name, weight in self.weights.items():
            block = weight * values[self.columns_of(name)]
            if name == "links":
                placements[1:] += block.reshape(-1, 6) * TWIST_UNITS
            elif at := GROUPS[name].functions:
                functions[:, at] += block.reshape(-1, count).T
        return placements, functions

    def columns(self, name: str, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """Jacobian (m, 6, p) of the reported frame by a block's errors, at (m, n) joints [rad].

        Right perturbations for a unit of each column; no loads if None.
        """
        bent = self.bent(q, loads)
        if name == BACKLASH:
            sides = np.zeros((len(q), 1)) if loads is None else loads.sides
            return np.asarray(0.5 * sides[:, None] * self.robot.axis_jacobian(bent))
        if name == WEIGHT and self.functions is not None:
            shares = self.functions.values(self.robot, bent)
            return np.asarray(self.robot.axis_jacobian(bent) @ shares)
        if name == COMPLIANCE:
            torques = self.robot.load_torques(bent, loads) / self.torque_nm
            if self.yielding is not None:
                torques = torques * self.yielding
            return np.asarray(self.robot.axis_jacobian(bent) * torques[:, None])
        if name == "links":
            jacobian = self.robot.placement_jacobian(bent)[:, :, 6:]
            units = np.tile(TWIST_UNITS, self.nominal.joint_count)
            # The last link's own twist acts on the flange, before what is mounted on it.
            jacobian[:, :, -6:] = adjoint(invert(self.flange_from_reported))
            return np.asarray(jacobian * units)
        if name == HARMONICS and self.waves is not None:
            return np.asarray(self._wave_jacobian(bent, self.waves) @ self.waves.directions)
        count = self.nominal.joint_count
        functions = self.robot.function_jacobian(bent).reshape(len(q), 6, count, 4)
        return np.concatenate([functions[..., at] for at in GROUPS[name].functions], axis=2)

    def basis(self, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """Jacobian (m, 6, p) of the reported frame by all values, under the loads of each stop."""
        weights = self.weights.items()
        columns = [weight * self.columns(name, q, loads) for name, weight in weights]
        return np.concatenate(columns, axis=2)

    def basis_without_harmonics(self, q: FloatArray) -> FloatArray:
        """The columns of `basis` other than harmonics."""
        return self.basis(q)[:, :, self.is_kept]


def _is_noise(twists: FloatArray) -> bool:
    """Tests whether the mean of (m, 6) twists is zero, by isotropic scatter (F test)."""
    count = len(twists)
    if count < FEWEST_STOPS:
        return False
    mean = twists.mean(axis=0).reshape(2, 3)
    scatter = (twists - twists.mean(axis=0)).reshape(count, 2, 3).var(axis=(0, 2), ddof=1)
    limit = f_limit(FALSE_REJECTION, 3, 3 * (count - 1))
    return bool((count * (mean**2).mean(axis=1) <= limit * scatter).all())


def sized_groups(level: str, robot: Robot, loads: Loads) -> tuple[str, ...]:
    """The groups of a level whose sizes stops with the given loads can determine together."""
    hidden = {HARMONICS, HEAT, COMPLIANCE if robot.masses is None and not loads.any else ""}
    hidden |= {"" if robot.masses is None else WEIGHT, "" if loads.from_both_sides else BACKLASH}
    return tuple(name for name in groups_of(level) if name not in hidden)
