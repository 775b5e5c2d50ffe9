"""Loads on an arm: links' weight, payload, external force.

A load's torque on a joint is positive in the joint's sense: the motor holds against it, and the
gear yields to it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Self, TypeAlias

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.codec import Check
from visioncal.core.documents.toml import DocumentTable
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, IntArray, Mask, chosen_rows

STANDARD_GRAVITY_M_S2 = 9.80665  # By definition (CGPM 1901).
# Most that any arm carries [kg], and how far from its flange at most the centre of that is [m].
MOST_KG, MOST_CENTRE_M = 2500.0, 3.0
# Keys of a link's mass in a joint's table.
MASS_KEYS = ("mass_kg", "com_m")
_Mass: TypeAlias = Annotated[
    float, Check("a mass of 0 kg or more", lambda mass: 0.0 <= mass < np.inf)
]
# Keys of the limits in a joint's table.
RATE_KEYS = ("velocity_rad_s", "acceleration_rad_s2", "torque_nm")


@dataclass(frozen=True, eq=False)
class Masses:
    """Masses of an arm's links."""

    kg: FloatArray  # (n,) mass that moves with each joint [kg].
    centres_m: FloatArray  # (n, 3) its centre, in the joint's frame after its motion [m].

    def rows(self) -> list[dict[str, Any]]:
        """Entries of the joints' tables, for a description whose rows end in the joints' frames."""
        columns = zip(self.kg.tolist(), self.centres_m.tolist(), strict=True)
        return [dict(zip(MASS_KEYS, column, strict=True)) for column in columns]


@dataclass(frozen=True, eq=False)
class Loads:
    """Payload, external force and direction of approach of an arm at m stops."""

    payload_kg: FloatArray  # (m,) mass of the payload [kg].
    payload_m: FloatArray  # (m, 3) its centre, in the flange's frame [m].
    force_n: FloatArray  # (m, 3) external force on the flange's origin, in the base's frame [N].
    # (m,) the side from which the joints approached the stop, or (m, n) from which each did: +1
    # from above, -1 from below; 0 where unknown: the middle of their backlash.
    side: FloatArray

    @classmethod
    def none(cls, count: int) -> Self:
        """No loads but the arm's own weight."""
        return cls.alike(count, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    @classmethod
    @typed
    def alike(
        cls,
        count: int,
        payload_kg: float | FloatArray,
        payload_m: FloatArray | Sequence[float],
        force_n: FloatArray | Sequence[float],
    ) -> Self:
        """Loads of `count` stops, each value for all or one per stop.

        Raises:
            DataError: A mass is negative, a load is beyond every arm, a number is not finite, or a
                shape does not fit.
        """
        try:
            loads = cls(
                np.broadcast_to(np.asarray(payload_kg, dtype=float), (count,)),
                np.broadcast_to(np.asarray(payload_m, dtype=float), (count, 3)),
                np.broadcast_to(np.asarray(force_n, dtype=float), (count, 3)),
                np.zeros(count),
            )
        except ValueError as error:
            raise DataError(
                f"loads must be a payload in kg, its centre (3,) in m and a force (3,) in N, "
                f"or {count} of each: {error}."
            ) from error
        centre = np.concatenate([loads.payload_kg[:, None], loads.payload_m, loads.force_n], axis=1)
        if not np.isfinite(centre).all() or (loads.payload_kg < 0.0).any():
            raise DataError(
                f"loads: a payload is {np.min(loads.payload_kg):g} kg, but must be 0 kg or more, "
                "and all numbers finite.",
                culprits=["payload_kg"],
            )
        far_m = float(np.abs(loads.payload_m).max(initial=0.0))
        for name, most, limit, unit, small in (
            ("payload_kg", float(loads.payload_kg.max(initial=0.0)), MOST_KG, "kg", "g"),
            ("payload_m", far_m, MOST_CENTRE_M, "m", "mm"),
        ):
            if most > limit:
                raise DataError(
                    f"loads: {name} must be {limit:g} {unit} at most, as on the flange of every "
                    f"arm, and is {most:g} {unit} ({most:g} {small}?).",
                    culprits=[name],
                    next_step=f"Write {unit}.",
                )
        return loads

    @property
    def any(self) -> bool:
        """Whether any stop has a payload or force."""
        return bool(self.payload_kg.any() or self.force_n.any())

    def chosen(self, rows: IntArray | Mask) -> "Loads":
        """The loads of given stops."""
        return chosen_rows(self, rows)

    @property
    def rows(self) -> FloatArray:
        """(m, 8) all values of each stop, for comparison; (m, 7 + n) with sides of each joint."""
        parts = [self.payload_kg[:, None], self.payload_m, self.force_n, self.sides]
        return np.concatenate(parts, axis=1)

    @property
    def sides(self) -> FloatArray:
        """(m, 1) of all joints, or (m, n) of each: the sides of approach."""
        return self.side if self.side.ndim == 2 else self.side[:, None]

    @property
    def from_both_sides(self) -> bool:
        """Whether stops were approached from both sides, which separates backlash from offset."""
        above, below = (self.sides > 0.0).any(axis=0), (self.sides < 0.0).any(axis=0)
        return bool((above & below).any())


def masses_of_rows(rows: Sequence[DocumentTable], joint_from_row: FloatArray) -> Masses | None:
    """Reads `mass_kg` and `com_m` of a table of joints; None where no joint states one.

    Args:
        rows: The joints' tables.
        joint_from_row: (n, 4, 4) the frames in which the centres are stated, in the joints' frames
            after their motion.

    Raises:
        DataError: Only some joints state their mass, or one is invalid.
    """
    stated = [row for row in rows if any(key in row.content for key in MASS_KEYS)]
    if not stated:
        return None
    kg, centres = [], []
    for row, frame in zip(rows, joint_from_row, strict=True):
        kg.append(row.read("mass_kg", _Mass))
        centres.append(frame[:3, :3] @ np.array(row.numbers("com_m", 3)) + frame[:3, 3])
    return Masses(np.array(kg), np.array(centres))


def gravity_of(document: Mapping[str, Any], label: str) -> FloatArray:
    """(3,) gravitational acceleration in the base's frame; along -z by default [m/s^2].

    Raises:
        DataError: It is no vector of three numbers, or not that of the Earth.
    """
    if "gravity_m_s2" not in document:
        return np.array([0.0, 0.0, -STANDARD_GRAVITY_M_S2])
    row = DocumentTable(document, label)
    gravity = np.array(row.numbers("gravity_m_s2", 3))
    if not 9.5 < float(np.linalg.norm(gravity)) < 10.1:
        raise row.refuse(
            "gravity_m_s2",
            gravity.tolist(),
            "a vector of 9.81 m/s^2 in the robot's base, as [0, 0, -9.81] where it stands upright",
        )
    return gravity


def gravity_words(gravity: FloatArray) -> str:
    """A (3,) gravity [m/s^2] as session.toml states it: `[0, 0, -9.81]`."""
    # Adding 0.0 removes negative zeros.
    return f"[{', '.join(f'{value:.3g}' for value in np.round(gravity, 2) + 0.0)}]"


@dataclass(frozen=True, eq=False)
class DriveLimits:
    """Limits of an arm's drives; inf where unknown, in m/s, m/s^2 and N for prismatic joints."""

    velocity: FloatArray  # (n,) greatest speeds [rad/s].
    acceleration: FloatArray  # (n,) greatest accelerations [rad/s^2].
    torque: FloatArray  # (n,) greatest torques [N m].

    @classmethod
    def of_rows(cls, rows: Sequence[DocumentTable]) -> "DriveLimits":
        """Reads the limits from a table of joints; raises DataError."""
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


def load_ranges(loads: Loads) -> dict[str, Any]:
    """Smallest and largest payload [kg] and, where there is one, force [N]."""
    force = np.linalg.norm(loads.force_n, axis=1)
    kg = (float(loads.payload_kg.min()), float(loads.payload_kg.max()))
    stated = {"force_n": (float(force.min()), float(force.max()))} if force.any() else {}
    return {"payload_kg": kg, **stated}
