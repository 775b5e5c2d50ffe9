"""An arm whose errors are being estimated: its model, and how its flange moves with them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from visioncal.estimator.arm import TWIST_UNITS, ArmErrors
from visioncal.robot import Robot
from visioncal.transforms import adjoint, invert, log, mean_transform
from visioncal.types import FloatArray

# Columns of a joint's function (see `Robot.function_jacobian`) that a block changes.
_FUNCTIONS = {"offsets": (0,), "ratios": (1,), "eccentricity": (2, 3)}
BLOCKS = ("links", *_FUNCTIONS)


@dataclass(frozen=True, eq=False)
class ArmModel:
    """A robot's nominal model and the present values of its errors.

    Attributes:
        nominal: The model as stated.
        flange_from_reported: (4, 4) the frame of the reported poses in the model's flange.
        weights: The blocks by name with the size of their errors, as a share of the first's:
            `offsets` of the joints, `links` (each by six, behind its joint), `ratios` of the gears,
            `eccentricity` (sine and cosine of each joint).
        values: (p,) present values [rad], block after block; all are of the first block's size.
    """

    nominal: Robot
    flange_from_reported: FloatArray
    weights: Mapping[str, float]
    values: FloatArray

    @classmethod
    def of(cls, nominal: Robot, q: FloatArray, reported: FloatArray) -> "ArmModel":
        """The nominal arm with what is mounted on its flange, without any errors.

        Args:
            nominal: The model.
            q: (m, n) joint angles [rad].
            reported: (m, 4, 4) what the controller reported for them.
        """
        tool = mean_transform(invert(nominal.base_from_flange(q)) @ reported)
        return cls(nominal, tool, {}, np.zeros(0))

    def erring(self, errors: Mapping[str, ArmErrors]) -> "ArmModel":
        """Returns the arm with the errors of some blocks to be estimated."""
        sizes = sum(it.basis.shape[2] for it in errors.values())
        first = next(iter(errors.values())).sigma
        weights = {name: it.sigma / first for name, it in errors.items()}
        return replace(self, weights=weights, values=np.zeros(sizes))

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
        return self.nominal.corrected(*self.changes(self.values))

    def changes(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What (p,) values change: twists (n + 1, 6) of the placements, and functions (n, 4)."""
        count, at = self.nominal.joint_count, 0
        placements, functions = np.zeros((count + 1, 6)), np.zeros((count, 4))
        for name, weight in self.weights.items():
            size = block_size(name, count)
            block = weight * values[at : at + size]
            at += size
            if name == "links":
                placements[1:] += block.reshape(-1, 6) * TWIST_UNITS
            else:
                functions[:, _FUNCTIONS[name]] += block.reshape(-1, count).T
        return placements, functions

    def columns(self, name: str, q: FloatArray) -> FloatArray:
        """How the reported frame moves with a block's errors.

        Args:
            name: The block.
            q: (m, n) joint angles [rad].

        Returns:
            (m, 6, p) right perturbations for a unit of each column.
        """
        if name == "links":
            moved = self.robot.placement_jacobian(q)[:, :, 6:]
            units = np.tile(TWIST_UNITS, self.nominal.joint_count)
            # The last link's own twist acts on the flange, before what is mounted on it.
            moved[:, :, -6:] = adjoint(invert(self.flange_from_reported))
            return np.asarray(moved * units)
        count = self.nominal.joint_count
        functions = self.robot.function_jacobian(q).reshape(len(q), 6, count, 4)
        return np.concatenate([functions[..., it] for it in _FUNCTIONS[name]], axis=2)

    def basis(self, q: FloatArray) -> FloatArray:
        """How the reported frame (m, 6, p) moves with all values."""
        return np.concatenate(
            [weight * self.columns(name, q) for name, weight in self.weights.items()], axis=2
        )


def block_size(name: str, joints: int) -> int:
    """How many values a block has, for an arm of so many joints."""
    return (6 if name == "links" else len(_FUNCTIONS[name])) * joints
