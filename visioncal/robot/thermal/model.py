"""An arm that grows and drifts with the temperatures of its links."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.transforms import exp
from visioncal.core.types import FloatArray
from visioncal.robot import Robot
from visioncal.robot.thermal.heating import Heating


@dataclass(frozen=True, eq=False)
class ThermalModel:
    """An arm with n joints, each of which warms the link behind it.

    A link's length, the a and d of its joint table, grows in proportion to the rise of its
    temperature, and the joint's zero drifts with it.

    Attributes:
        robot: The arm at the reference.
        heating: How links follow what heats them.
        reference_c: (n,) temperatures of the links at which the arm is that [deg C].
        growth_per_k: (n,) relative growth of links [1/K].
        drift_rad_per_k: (n,) drift of the joints' zeros [rad/K].
        covariance: (2 n + h, 2 n + h) of growth, drift and the heating's h parameters.
        lengths: (n + 1, 3) from each joint's frame to the next, in the earlier one [m]: what grows.
    """

    robot: Robot
    heating: Heating
    reference_c: FloatArray
    growth_per_k: FloatArray
    drift_rad_per_k: FloatArray
    covariance: FloatArray
    lengths: FloatArray

    @property
    def joint_count(self) -> int:
        """The number n of joints."""
        return self.robot.joint_count

    def columns(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How the flange moves with its links.

        Args:
            q: (m, n) joint angles [rad].

        Returns:
            Right perturbations (m, 6, n) of the flange for a growth of each link by its own
            length, and for a turn of each joint by 1 rad.
        """
        count = self.joint_count
        moved = self.robot.placement_jacobian(q).reshape(len(q), 6, count + 1, 6)[:, :, 1:, 3:]
        grown = np.einsum("mikj,kj->mik", moved, self._along)
        turned = self.robot.function_jacobian(q).reshape(len(q), 6, count, 4)[..., 0]
        return np.asarray(grown), np.asarray(turned)

    def jacobian(self, q: FloatArray) -> FloatArray:
        """(m, 6, n) how the flange moves with the temperature of each link [rad and m for 1 K]."""
        grown, turned = self.columns(q)
        return np.asarray(grown * self.growth_per_k + turned * self.drift_rad_per_k)

    def motion(self, q: FloatArray, links_c: FloatArray) -> FloatArray:
        """(m, 4, 4) how the flange has moved from the reference, in its own frame."""
        rises = self.rises(links_c)
        return exp(np.einsum("mij,mj->mi", self.jacobian(q), np.broadcast_to(rises, q.shape)))

    def base_from_flange(self, q: FloatArray, links_c: FloatArray) -> FloatArray:
        """Where the flange stands.

        Args:
            q: (m, n) joint angles [rad].
            links_c: (m, n) temperatures of the links, or (n,) for all [deg C].

        Returns:
            (m, 4, 4) [m].

        Raises:
            DataError: The shapes do not go together.
        """
        return np.asarray(self.robot.base_from_flange(q) @ self.motion(q, links_c))

    def robot_at(self, links_c: FloatArray) -> Robot:
        """The arm with its links at (n,) temperatures [deg C]."""
        rises = self.rises(links_c)
        placements, functions = np.zeros((self.joint_count + 1, 6)), np.zeros((len(rises), 4))
        placements[1:, 3:] = self._along * (self.growth_per_k * rises)[:, None]
        functions[:, 0] = self.drift_rad_per_k * rises
        return self.robot.corrected(placements, functions)

    def basis(self, q: FloatArray, links_c: FloatArray, heated: FloatArray) -> FloatArray:
        """How the flange moves with all parameters, in the order of their covariance.

        Args:
            q: (m, n) joint angles [rad].
            links_c: (m, n) temperatures of the links [deg C].
            heated: (m, n, k) how these move with the k kinds of the heating's parameters
                (`Heating.jacobian`).

        Returns:
            (m, 6, p) right perturbations.
        """
        grown, turned = self.columns(q)
        rises, by_link = self.rises(links_c)[:, None, :], self.jacobian(q)
        parts = [by_link * heated[:, None, :, at] for at in range(heated.shape[2])]
        return np.concatenate([grown * rises, turned * rises, *parts], axis=2)

    def sigma_m(
        self, q: FloatArray, links_c: FloatArray, heated: FloatArray | None = None
    ) -> FloatArray:
        """How surely the drift from the reference is predicted.

        Args:
            q: (m, n) joint angles [rad].
            links_c: (m, n) temperatures of the links, or (n,) for all [deg C].
            heated: (m, n, k) how these move with the heating's parameters; None leaves out what is
                open about these.

        Returns:
            (m,) roots of the trace of the places' covariances [m].
        """
        links_c = np.broadcast_to(links_c, q.shape)
        none = np.zeros((*q.shape, 0))
        moved = self.basis(q, links_c, none if heated is None else heated)[:, 3:]
        size = moved.shape[2]
        covariance = moved @ self.covariance[:size, :size] @ np.swapaxes(moved, 1, 2)
        return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2)))

    def rises(self, links_c: FloatArray) -> FloatArray:
        """How much warmer than at the reference links are [K].

        Raises:
            DataError: There is not one temperature a joint.
        """
        links_c = np.asarray(links_c, dtype=float)
        if not links_c.ndim or links_c.shape[-1] != self.joint_count:
            raise DataError(
                f"robot {self.robot.name}: temperatures of shape {links_c.shape} do not go with "
                f"its {self.joint_count} joints; one for each joint is needed."
            )
        return np.asarray(links_c - self.reference_c)

    @cached_property
    def _along(self) -> FloatArray:
        """(n, 3) the links' lengths in the frame behind them [m]."""
        rotations = self.robot.chain.placements[1:, :3, :3]
        return np.asarray(np.einsum("kji,kj->ki", rotations, self.lengths[1:]))
