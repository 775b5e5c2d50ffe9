"""Denavit-Hartenberg tables, and their documents."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from visioncal.core.choices import CONVENTIONS, Convention
from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, write_pose
from visioncal.core.documents.toml import DocumentTable
from visioncal.core.errors import DataError
from visioncal.core.limits import FAR_M
from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray, Mask
from visioncal.robot.chain import Chain, joint_function, joint_tables, subtable

# Keys of a joint function; the offset is in theta_offset_rad or d_m.
_FUNCTION_KEYS = ("", "gear_ratio", "sine_rad", "cosine_rad")
_POSE_KEYS = ("xyz_m", "rpy_rad")


@dataclass(frozen=True, eq=False)
class DHTable:
    """A table of n joints in one of three conventions.

    All three are the same product
    `base X_0 Z_1(q_1) X_1 Z_2(q_2) ... Z_n(q_n) X_n flange` with
    `Z_i = Rz(theta_i + q_i) Tz(d_i)` and `X_i = Tx(a_i) Rx(alpha_i) Ry(beta_i)`; they differ in the
    factors of a row:

    - `standard` (Denavit and Hartenberg 1955): row i is Z_i X_i; X_0 belongs to the base.
    - `modified` (Craig 1986; Khalil and Kleinfinger 1986): row i is X_{i-1} Z_i; X_n belongs to
      the flange.
    - `hayati` (Hayati and Mirmirani 1985): as standard, but where axes i and i + 1 are nearly
      parallel, beta_i replaces d_i: the position of their common normal is ill-defined, and the
      plane through the origin normal to axis i is used instead. A d_i of exactly parallel axes is
      kept.
    """

    name: str  # The robot's name.
    tip: str  # The frame at its end.
    convention: Convention  # The convention of its rows.
    joint_names: tuple[str, ...]  # The joints from the base to the tip.
    prismatic: Mask  # (n,) whether q adds to d [m] instead of theta [rad].
    theta_rad: FloatArray  # (n,) rotations about z.
    d_m: FloatArray  # (n,) translations along z.
    a_m: FloatArray  # (n + 1,) translations along x; the first is of X_0.
    alpha_rad: FloatArray  # (n + 1,) rotations about x.
    beta_rad: FloatArray  # (n + 1,) rotations about y; zero but for Hayati's parallel rows.
    parallel: Mask  # (n + 1,) mask of the X_i between nearly parallel axes; only in `hayati`.
    base: FloatArray  # (4, 4) the constant before X_0 [m].
    flange: FloatArray  # (4, 4) the constant after X_n [m].
    lower: FloatArray  # (n,) lower limits of q [rad or m], -inf for none.
    upper: FloatArray  # (n,) upper limits of q [rad or m], inf for none.
    functions: FloatArray  # (n, 4) the joints' functions as in `Chain`, their offsets zero.

    def __len__(self) -> int:
        return len(self.joint_names)

    @property
    def along_z(self) -> FloatArray:
        """(n, 4, 4) the constants Z_i."""
        return about_z(self.theta_rad, self.d_m)

    @property
    def along_x(self) -> FloatArray:
        """(n + 1, 4, 4) the constants X_i."""
        return about_x(self.a_m, self.alpha_rad, self.beta_rad)


def about_z(theta_rad: FloatArray, d_m: FloatArray) -> FloatArray:
    """(..., 4, 4) `Rz(theta) Tz(d)`."""
    c, s = np.cos(theta_rad), np.sin(theta_rad)
    o, one = np.zeros_like(c), np.ones_like(c)
    rotation = np.stack([c, -s, o, s, c, o, o, o, one], axis=-1).reshape(*c.shape, 3, 3)
    return compose(rotation, np.stack([o, o, d_m], axis=-1))


def about_x(a_m: FloatArray, alpha_rad: FloatArray, beta_rad: FloatArray) -> FloatArray:
    """(..., 4, 4) `Tx(a) Rx(alpha) Ry(beta)`."""
    c, s = np.cos(alpha_rad), np.sin(alpha_rad)
    cb, sb = np.cos(beta_rad), np.sin(beta_rad)
    o = np.zeros_like(c)
    entries = [cb, o, sb, s * sb, c, -s * cb, -c * sb, s, c * cb]
    rotation = np.stack(entries, axis=-1).reshape(*c.shape, 3, 3)
    return compose(rotation, np.stack([a_m, o, o], axis=-1))


def chain_of_table(table: DHTable) -> Chain:
    """Chain of a table, with all joints about z.

    A joint's frame before its motion is at the begin of its row (standard, hayati), or at its end
    without q (modified); Rz and Tz commute, so both are the same arm.
    """
    along_z, along_x, count = table.along_z, table.along_x, len(table)
    last = along_x[-1] @ table.flange
    if table.convention == "modified":
        placements = [*(along_x[:-1] @ along_z), last]
        placements[0] = table.base @ placements[0]
    else:
        placements = [table.base @ along_x[0], *(along_z[:-1] @ along_x[1:-1]), along_z[-1] @ last]
    return Chain(
        table.joint_names,
        table.prismatic,
        np.tile([0.0, 0.0, 1.0], (count, 1)),
        np.array(placements),
        table.lower,
        table.upper,
        table.functions,
    )


def row_frames(table: DHTable) -> FloatArray:
    """Frames (n, 4, 4) in which a table's rows end, in the joints' frames after their motion.

    Manufacturers state the centres of mass of links in these frames.
    """
    if table.convention == "modified":
        return np.broadcast_to(np.eye(4), (len(table), 4, 4))
    return np.asarray(table.along_z @ table.along_x[1:])


def table_from_document(document: Mapping[str, Any]) -> DHTable:
    """Reads a table from a robot's description.

    Each `[[joint]]` holds a_m, alpha_rad, d_m, and may hold name, theta_offset_rad, beta_rad
    (hayati), type, lower_deg and upper_deg (lower_m and upper_m where prismatic; 360 deg where
    absent), gear_ratio, sine_rad and cosine_rad. `[base]` and `[flange]` hold xyz_m and rpy_rad.

    Raises:
        DataError: A field is missing, unknown or out of range.
    """
    name = DocumentTable(document, "robot").text("name")
    table = DocumentTable(document, f"robot {name}")
    needed = cast(tuple[str, ...], CONVENTIONS)
    convention = cast(Convention, table.choice("convention", needed))
    rows = joint_tables(table)
    tables = [row for _, row in rows]
    prismatic = np.array([_is_prismatic(row) for row in tables])
    limits = np.array([_limits(row) for row in tables])
    across = np.array([_across(row, convention) for row in tables])
    nothing = np.zeros((1, 4))
    modified = convention == "modified"
    a, alpha, beta, parallel = np.vstack([across, nothing] if modified else [nothing, across]).T
    return DHTable(
        name,
        table.text("tip", "flange"),
        convention,
        tuple(joint for joint, _ in rows),
        prismatic,
        np.array([row.number("theta_offset_rad", 0.0) for row in tables]),
        np.array([row.number("d_m") for row in tables]),
        a,
        alpha,
        beta,
        parallel > 0.0,
        _pose(subtable(table, "base")),
        _pose(subtable(table, "flange")),
        limits[:, 0],
        limits[:, 1],
        np.array([joint_function(row, _FUNCTION_KEYS) for row in tables]),
    )


def table_document(table: DHTable, source: str = "") -> dict[str, Any]:
    """Writes a table as a description that `table_from_document` reads.

    Returns:
        The description. Constants that have no row go into `[base]` and `[flange]`.
    """
    modified = table.convention == "modified"
    before = table.base if modified else table.base @ table.along_x[0]
    behind = table.along_x[-1] @ table.flange if modified else table.flange
    document: dict[str, Any] = {
        "schema": 1,
        "name": table.name,
        "tip": table.tip,
        "convention": table.convention,
        "source": source,
        "joint": [_row(table, place) for place in range(len(table))],
    }
    if not np.array_equal(before, np.eye(4)):
        document["base"] = _pose_document(before)
    if not np.array_equal(behind, np.eye(4)):
        document["flange"] = _pose_document(behind)
    return document


def _row(table: DHTable, place: int) -> dict[str, Any]:
    across = place if table.convention == "modified" else place + 1
    row: dict[str, Any] = {"name": table.joint_names[place]}
    prismatic = bool(table.prismatic[place])
    if prismatic:
        row["type"] = "prismatic"
    row["a_m"] = float(table.a_m[across])
    row["alpha_rad"] = float(table.alpha_rad[across])
    if table.parallel[across]:
        row["beta_rad"] = float(table.beta_rad[across])
    row["d_m"] = float(table.d_m[place])
    row["theta_offset_rad"] = float(table.theta_rad[place])
    for key, value in (("lower", table.lower[place]), ("upper", table.upper[place])):
        if prismatic:
            row |= {f"{key}_m": float(value)} if math.isfinite(value) else {}
        else:
            row[f"{key}_deg"] = math.degrees(value)
    values = zip(_FUNCTION_KEYS, table.functions[place].tolist(), (0.0, 1.0, 0.0, 0.0), strict=True)
    return row | {key: value for key, value, none in values if key and value != none}


def _is_prismatic(row: DocumentTable) -> bool:
    return row.choice("type", ("revolute", "prismatic"), "revolute") == "prismatic"


def _limits(row: DocumentTable) -> tuple[float, float]:
    """Limits of q [rad or m]; angles may be infinite."""
    if _is_prismatic(row):
        keys = ("lower_m", "upper_m")
        lower, upper = (
            row.number(key) if key in row.content else none
            for key, none in zip(keys, (-math.inf, math.inf), strict=True)
        )
    else:
        keys = ("lower_deg", "upper_deg")
        lower, upper = (
            math.inf * sign
            if row.content.get(key) == math.inf * sign
            else row.number(key, sign * 360.0)
            for key, sign in zip(keys, (-1.0, 1.0), strict=True)
        )
    if lower >= upper:
        raise row.refuse(keys[0], lower, f"less than {keys[1]} = {upper!r}")
    return (lower, upper) if _is_prismatic(row) else (math.radians(lower), math.radians(upper))


def _across(row: DocumentTable, convention: Convention) -> tuple[float, float, float, float]:
    """a, alpha, beta, and whether the row is of parallel axes."""
    parallel = "beta_rad" in row.content
    if parallel and convention != "hayati":
        raise DataError(
            f"{row.label}: beta_rad has no place in the convention {convention!r}.",
            culprits=[f"{row.label}: beta_rad"],
            next_step='Leave it out, or write convention = "hayati".',
        )
    beta = row.number("beta_rad", 0.0)
    length_m = row.number("a_m")
    if abs(length_m) > FAR_M:
        raise row.refuse(
            "a_m",
            length_m,
            f"a number of metres, under {FAR_M:g}",
            "It looks like millimetres: multiply a_m and d_m of all joints by 0.001.",
        )
    return length_m, row.number("alpha_rad"), beta, float(parallel)


def _pose(row: DocumentTable) -> FloatArray:
    """A constant transform (4, 4) [m]; the identity where the table is empty."""
    if not row.content:
        return np.eye(4)
    xyz, rpy = (np.array(row.numbers(key, 3)) for key in _POSE_KEYS)
    return compose(ROTATION_FORMS[POSE_FORMS["rpy"].rotation].read(rpy[None])[0], xyz)


def _pose_document(pose: FloatArray) -> dict[str, Any]:
    # Adding 0.0 removes negative zeros.
    numbers = (write_pose(pose, POSE_FORMS["rpy"]) + 0.0).tolist()
    return {"xyz_m": numbers[:3], "rpy_rad": numbers[3:]}
