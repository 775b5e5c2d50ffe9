"""Geometry of a serial arm as placements and axes, the common form of all descriptions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypeAlias

import numpy as np

from visioncal.core.codec import Array, Check
from visioncal.core.documents.toml import DocumentTable
from visioncal.core.limits import NORM_TOLERANCE
from visioncal.core.transforms import LAST_ROW, exp, rigid_fault, skew
from visioncal.core.types import FloatArray, Mask

# Columns of a joint's function: offset, ratio, sine, cosine.
FUNCTION_NAMES = ("offset", "ratio", "sine", "cosine")
IDENTITY_FUNCTION = (0.0, 1.0, 0.0, 0.0)
_Placement: TypeAlias = Annotated[
    FloatArray,
    Check("a list of 4 rows of 4 numbers, a rigid transform [m]"),
    Array(
        (4, 4),
        lambda matrix: (
            (fault := rigid_fault(matrix, NORM_TOLERANCE))
            and f"must be a rigid transform [m], but {fault}"
        ),
    ),
]


@dataclass(frozen=True, eq=False)
class Chain:
    """The geometry of a serial arm with n joints.

    The pose of the tip is `placement_1 M_1 placement_2 M_2 ... placement_{n+1}`, where M_i turns
    about (or moves along) axis i by the joint's effective position, a function of the encoder's q:
    `offset + ratio q + sine sin(q) + cosine cos(q)`, with gear ratio and encoder eccentricity
    (Mooring, Roth and Driels 1991, Fundamentals of Manipulator Calibration), and harmonics of
    higher order.
    """

    joint_names: tuple[str, ...]  # The joints from the base to the tip.
    # (n,) whether a joint moves along its axis [m] instead of turning about it [rad].
    prismatic: Mask
    axes: FloatArray  # (n, 3) unit vectors in the joints' frames.
    # (n + 1, 4, 4) each joint's frame, before its own motion, in the previous joint's (the first in
    # the base), and the tip in the last joint's [m].
    placements: FloatArray
    lower: FloatArray  # (n,) lower limits of q [rad or m]; -inf for a joint without limits.
    upper: FloatArray  # (n,) upper limits of q [rad or m]; inf for a joint without limits.
    functions: FloatArray  # (n, 4) offset [rad or m], ratio, sine and cosine [rad] of each joint.
    # (n, k, 2) sine and cosine [rad] of each joint at orders from 2 on; None for none.
    harmonics: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.joint_names)

    @property
    def twists(self) -> FloatArray:
        """(n, 6) twists (rotation, translation) of the joints' frames for a unit of position."""
        turning = np.where(self.prismatic[:, None], 0.0, self.axes)
        moving = np.where(self.prismatic[:, None], self.axes, 0.0)
        return np.concatenate([turning, moving], axis=1)

    def steps(self, positions: FloatArray) -> FloatArray:
        """Each joint's frame, after its motion, in the previous joint's: (m, n, 4, 4) [m].

        With the generator G of a joint's twist, its motion is `I + sin(s) G + (1 - cos(s)) G^2` at
        the effective position s (Rodrigues), and `I + s G` if it is prismatic, whose G^2 is zero.
        """
        generators = np.zeros((len(self), 4, 4))
        generators[:, :3, :3], generators[:, :3, 3] = skew(self.twists[:, :3]), self.twists[:, 3:]
        placed = self.placements[:-1]
        first, second = placed @ generators, placed @ generators @ generators
        sine = np.where(self.prismatic, positions, np.sin(positions))[:, :, None, None]
        versine = (1.0 - np.cos(positions))[:, :, None, None]
        return np.asarray(placed + sine * first + versine * second)

    def function_basis(self, q: FloatArray) -> FloatArray:
        """Derivatives of the effective positions over the joint function coefficients.

        Returns:
            (m, n, 4) at encoder positions (m, n): 1, q, sin(q), cos(q), the last two zero for a
            prismatic joint.
        """
        turning = np.where(self.prismatic, 0.0, 1.0)
        return np.stack([np.ones_like(q), q, turning * np.sin(q), turning * np.cos(q)], axis=-1)

    @property
    def is_periodic(self) -> bool:
        """Whether joint functions have a periodic part."""
        return bool(self._amplitudes.any())

    def effective(self, q: FloatArray) -> FloatArray:
        """Effective positions (m, n) of the joints at encoder positions (m, n) `q`."""
        offset, ratio = self.functions[:, 0], self.functions[:, 1]
        plain = offset + ratio * q
        return np.asarray(plain + self._periodic(q, 0) if self.is_periodic else plain)

    def encoded(self, positions: FloatArray) -> FloatArray:
        """Encoder positions (m, n) at effective positions (m, n): the inverse of `effective`.

        Newton's iteration; an eccentricity is some thousandths of the ratio: three steps suffice.
        """
        offset, ratio = self.functions[:, 0], self.functions[:, 1]
        q = (positions - offset) / ratio
        if not self.is_periodic:
            return np.asarray(q)
        for _ in range(20):
            error = offset + ratio * q + self._periodic(q, 0) - positions
            q = q - error / (ratio + self._periodic(q, 1))
            # The next error is its square: rounding.
            if np.abs(error).max(initial=0.0) < 1e-8:
                break
        return np.asarray(q)

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Derivatives (m, n) of the effective positions over (m, n) `q`."""
        return np.asarray(self.functions[:, 1] + self._periodic(q, 1))

    def curvatures(self, q: FloatArray) -> FloatArray:
        """Second derivatives (m, n) of the effective positions over (m, n) `q`."""
        return self._periodic(q, 2)

    def _periodic(self, q: FloatArray, derivative: int) -> FloatArray:
        """(m, n) periodic part of the joint functions, or one of its derivatives."""
        amplitudes = self._amplitudes
        orders = np.arange(1, amplitudes.shape[1] + 1)
        # A derivative advances the phase by a quarter turn.
        phases = orders * q[..., None] + derivative * np.pi / 2
        values = amplitudes[..., 0] * np.sin(phases) + amplitudes[..., 1] * np.cos(phases)
        return np.asarray((values * orders**derivative).sum(axis=-1))

    @property
    def _amplitudes(self) -> FloatArray:
        """(n, k, 2) sine and cosine amplitudes by order; zero for prismatic joints."""
        amplitudes = self.functions[:, None, 2:]
        if self.harmonics is not None:
            amplitudes = np.concatenate([amplitudes, self.harmonics], axis=1)
        return np.where(self.prismatic[:, None, None], 0.0, amplitudes)

    def with_offsets_placed(self) -> "Chain":
        """The same arm with the joint function offsets moved into the placements."""
        steps = exp(self.twists * self.functions[:, :1])
        functions = self.functions.copy()
        functions[:, 0] = 0.0
        placements = self.placements.copy()
        moved = self.functions[:, 0] != 0.0
        placements[:-1][moved] = placements[:-1][moved] @ steps[moved]
        return replace(self, placements=placements, functions=functions)


def chain_document(name: str, tip: str, chain: Chain) -> dict[str, Any]:
    """Writes a chain as a description that `Robot.from_document` reads back exactly."""
    joints = []
    for place, joint in enumerate(chain.joint_names):
        row: dict[str, Any] = {
            "name": joint,
            "type": "prismatic" if chain.prismatic[place] else "revolute",
            "axis": chain.axes[place].tolist(),
            "placement": chain.placements[place].tolist(),
        }
        limits = {"lower": chain.lower[place], "upper": chain.upper[place]}
        row |= {key: float(limit) for key, limit in limits.items() if np.isfinite(limit)}
        row |= dict(zip(FUNCTION_NAMES, chain.functions[place].tolist(), strict=True))
        if chain.harmonics is not None:
            row["harmonics"] = chain.harmonics[place].tolist()
        joints.append(row)
    return {
        "schema": 1,
        "name": name,
        "tip": tip,
        "kind": "chain",
        "joint": joints,
        "flange": {"placement": chain.placements[-1].tolist()},
    }


def chain_from_document(table: DocumentTable) -> Chain:
    """Reads a chain from a description of `chain_document`; raises DataError."""
    rows = joint_tables(table)
    names = tuple(name for name, _ in rows)
    lower, upper = (
        np.array([row.number(key) if key in row.content else none for _, row in rows])
        for key, none in (("lower", -np.inf), ("upper", np.inf))
    )
    for (_, row), low, high in zip(rows, lower, upper, strict=True):
        if low >= high:
            raise row.refuse("lower", float(low), f"less than upper = {float(high)!r}")
    tables = [*(row for _, row in rows), subtable(table, "flange")]
    return Chain(
        names,
        np.array([row.choice("type", ("revolute", "prismatic")) == "prismatic" for _, row in rows]),
        np.array([_axis(row) for _, row in rows]),
        np.array([_placement(row) for row in tables]),
        lower,
        upper,
        np.array([joint_function(row, FUNCTION_NAMES) for _, row in rows]),
        _harmonics([row for _, row in rows]),
    )


def _harmonics(rows: Sequence[DocumentTable]) -> FloatArray | None:
    """(n, k, 2) harmonics of the joints; None where no row has any."""
    given = [row.content.get("harmonics", []) for row in rows]
    if not any(given):
        return None
    size = len(given[0]) if isinstance(given[0], Sequence) else 0
    words = Check(f"{size} pairs of numbers, sine and cosine of the orders from 2 on [rad]")
    kind = Annotated[FloatArray, words, Array((size, 2))]
    harmonics = np.array([row.read("harmonics", kind) for row in rows])
    if not np.isfinite(harmonics).all():
        raise rows[0].refuse("harmonics", given[0], "finite numbers [rad]")
    return harmonics


def joint_tables(table: DocumentTable) -> list[tuple[str, DocumentTable]]:
    """Joint tables of a description, with their names; raises DataError."""
    rows = table.content.get("joint")
    if not isinstance(rows, Sequence) or not rows or not all(isinstance(r, Mapping) for r in rows):
        raise table.refuse("joint", rows, "one [[joint]] table for each joint")
    names = [
        DocumentTable(row, f"{table.label}, joint {place}").text("name", f"joint_{place}")
        for place, row in enumerate(rows, start=1)
    ]
    if len(set(names)) < len(names):
        raise table.refuse("joint", names, "a name of its own for each joint")
    return [
        (name, DocumentTable(row, f"{table.label}, joint {name}"))
        for name, row in zip(names, rows, strict=True)
    ]


def subtable(table: DocumentTable, key: str) -> DocumentTable:
    """A nested table; empty where it is absent; raises DataError."""
    content = table.content.get(key, {})
    if not isinstance(content, Mapping):
        raise table.refuse(key, content, f"a [{key}] table")
    return DocumentTable(content, f"{table.label}, {key}")


def joint_function(row: DocumentTable, keys: Sequence[str]) -> list[float]:
    """Reads a joint function: offset, ratio, sine, cosine by key; the default for an empty key.

    Raises:
        DataError: A value is no number, or the ratio is not positive.
    """
    return [
        row.number(key, none, positive=name == "ratio") if key else none
        for key, none, name in zip(keys, IDENTITY_FUNCTION, FUNCTION_NAMES, strict=True)
    ]


def _axis(row: DocumentTable) -> FloatArray:
    axis = np.array(row.numbers("axis", 3))
    length = float(np.linalg.norm(axis))
    if abs(length - 1.0) > NORM_TOLERANCE:
        raise row.refuse("axis", axis.tolist(), "a vector of length 1")
    return axis / length


def _placement(row: DocumentTable) -> FloatArray:
    matrix: FloatArray = row.read("placement", _Placement)
    matrix[3] = LAST_ROW
    return matrix
