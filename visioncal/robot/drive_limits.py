"""Limits of an arm's drives."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from visioncal.core.files import DocumentTable
from visioncal.core.types import FloatArray

# Keys of the limits in a joint's table.
RATE_KEYS = ("velocity_rad_s", "acceleration_rad_s2", "torque_nm")


@dataclass(frozen=True, eq=False)
class DriveLimits:
    """Limits of an arm's drives; inf where unknown, in m/s, m/s^2 and N for prismatic joints."""

    velocity: FloatArray  # (n,) greatest speeds [rad/s].
    acceleration: FloatArray  # (n,) greatest accelerations [rad/s^2].
    torque: FloatArray  # (n,) greatest torques [N m].

    @classmethod
    def of_rows(cls, rows: Sequence[DocumentTable]) -> "DriveLimits":
        """Reads the limits from a table of joints.

        Raises:
            DataError: One is not positive.
        """
        limits = [
            [row.number(key, positive=True) if key in row.content else np.inf for key in RATE_KEYS]
            for row in rows
        ]
        return cls(*np.array(limits).T)

    def rows(self) -> list[dict[str, Any]]:
        """Entries of the joints' tables."""
        columns = np.stack([self.velocity, self.acceleration, self.torque], axis=1)
        return [
            {
                key: float(value)
                for key, value in zip(RATE_KEYS, row, strict=True)
                if np.isfinite(value)
            }
            for row in columns
        ]
