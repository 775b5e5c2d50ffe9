"""Arm model with thermal growth of links and drift of joint zeros."""

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
    """An arm whose n joints each heat the link after them.

    A link's lengths, a and d of its joint table, grow in proportion to the rise of its temperature,
    and the joint's zero drifts with it.
    """

    robot: Robot  # The arm at the reference temperatures.
    heating: Heating  # Heating model of the links.
    reference_c: FloatArray  # (n,) reference temperatures of the links [deg C].
    growth_per_k: FloatArray  # (n,) relative growth of links [1/K].
    drift_rad_per_k: FloatArray  # (n,) drift of the joints' zeros [rad/K].
    covariance: FloatArray  # (2 n + h, 2 n + h) of growth, drift and the heating's h parameters.
    # (n + 1, 3) growing vectors from each joint's frame to the next, in the former [m].
    lengths: FloatArray

    @property
    def joint_count(self) -> int:
        """The number n of joints."""
        return self.robot.joint_count

    def columns(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Right perturbations (m, 6, n) of the flange for growth of links and rotation of joints.

        Returns:
            For a relative growth of 1 of each link, and for 1 rad of each joint, at (m, n) joint
            angles [rad].
        """
        count = self.joint_count
        placements = self.robot.placement_jacobian(q).reshape(len(q), 6, count + 1, 6)[:, :, 1:, 3:]
        grown = np.einsum("mikj,kj->mik", placements, self._growing)
        turned = self.robot.function_jacobian(q).reshape(len(q), 6, count, 4)[..., 0]
        return np.asarray(grown), np.asarray(turned)

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Jacobian (m, 6, n) of the flange over the link temperatures [rad/K and m/K]."""
        grown, turned = self.columns(q)
        return np.asarray(grown * self.growth_per_k + turned * self.drift_rad_per_k)

    def motion(self, q: FloatArray, links_c: FloatArray) -> FloatArray:
        """Displacement (m, 4, 4) of the flange from the reference, in its own frame."""
        rises = self.rises(links_c)
        return exp(np.einsum("mij,mj->mi", self.jacobian(q), np.broadcast_to(rises, q.shape)))

    def base_from_flange(self, q: FloatArray, links_c: FloatArray) -> FloatArray:
        """Flange poses (m, 4, 4) [m] at joint angles (m, n) [rad] and temperatures (m, n) or (n,).

        Raises:
            DataError: The shapes do not match.
        """
        return np.asarray(self.robot.base_from_flange(q) @ self.motion(q, links_c))

    def robot_at(self, links_c: FloatArray) -> Robot:
        """The arm with its links at (n,) temperatures [deg C]."""
        rises = self.rises(links_c)
        placements, functions = np.zeros((self.joint_count + 1, 6)), np.zeros((len(rises), 4))
        placements[1:, 3:] = self._growing * (self.growth_per_k * rises)[:, None]
        functions[:, 0] = self.drift_rad_per_k * rises
        return self.robot.corrected(placements, functions)

    def basis(self, q: FloatArray, links_c: FloatArray, heated: FloatArray) -> FloatArray:
        """Jacobian (m, 6, p) of the flange over all parameters, in the order of their covariance.

        Args:
            q: (m, n) joint angles [rad].
            links_c: (m, n) temperatures of the links [deg C].
            heated: (m, n, k) their derivatives over the k kinds of heating parameters
                (`Heating.jacobian`).
        """
        grown, turned = self.columns(q)
        rises, jacobian = self.rises(links_c)[:, None, :], self.jacobian(q)
        parts = [jacobian * heated[:, None, :, at] for at in range(heated.shape[2])]
        return np.concatenate([grown * rises, turned * rises, *parts], axis=2)

    def sigma_m(
        self, q: FloatArray, links_c: FloatArray, heated: FloatArray | None = None
    ) -> FloatArray:
        """Predicted sigma (m,) of the flange's drift: root of the trace of its covariance [m].

        Args:
            q: (m, n) joint angles [rad].
            links_c: (m, n) temperatures of the links, or (n,) for all [deg C].
            heated: (m, n, k) as in `basis`; None leaves out the uncertainty of the heating.
        """
        links_c = np.broadcast_to(links_c, q.shape)
        none = np.zeros((*q.shape, 0))
        jacobian = self.basis(q, links_c, none if heated is None else heated)[:, 3:]
        size = jacobian.shape[2]
        covariance = jacobian @ self.covariance[:size, :size] @ np.swapaxes(jacobian, 1, 2)
        return np.asarray(np.sqrt(np.trace(covariance, axis1=1, axis2=2)))

    def rises(self, links_c: FloatArray) -> FloatArray:
        """Rise of link temperatures over the reference [K].

        Raises:
            DataError: The number of temperatures differs from that of the joints.
        """
        links_c = np.asarray(links_c, dtype=float)
        if not links_c.ndim or links_c.shape[-1] != self.joint_count:
            raise DataError(
                f"robot {self.robot.name}: temperatures of shape {links_c.shape} do not go with "
                f"its {self.joint_count} joints; one for each joint is needed."
            )
        return np.asarray(links_c - self.reference_c)

    @cached_property
    def _growing(self) -> FloatArray:
        """(n, 3) growing vectors of the links in the frames after them [m]."""
        rotations = self.robot.chain.placements[1:, :3, :3]
        return np.asarray(np.einsum("kji,kj->ki", rotations, self.lengths[1:]))
