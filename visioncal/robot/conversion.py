"""Conversion between the conventions of joint tables, and of any chain to a joint table.

A row places an axis in the frame of the one before. `_between` finds its numbers; there remains a
screw about the next axis (rotation about it, translation along it), which commutes with that axis'
joint and goes into its row.
"""

from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.choices import Convention
from visioncal.core.transforms import compose, invert, skew
from visioncal.core.types import FloatArray, Mask
from visioncal.robot.chain import IDENTITY_FUNCTION, Chain, chain_document
from visioncal.robot.model import ARM_KEYS, LINK_KEYS, Robot
from visioncal.robot.tables import (
    DHTable,
    about_x,
    about_z,
    chain_of_table,
    table_document,
    table_from_document,
)

# Consecutive axes within this of parallel get Hayati's beta [rad]. Their common normal is at their
# offset over the angle, which magnifies errors of d against those of a.
PARALLEL_RAD = float(np.deg2rad(5.0))
# Axes within this angle are parallel [rad], and within this distance intersect [m]: a common normal
# at 1e8 times their offset has lost as many digits as the neglected angle.
EXACTLY = 1e-8
# Rounding of a product of a few transforms with entries near 1.
_ROUNDING = 1e-12


@dataclass(frozen=True)
class _DhRow:
    """theta, d, a, alpha, beta from one axis to the next."""

    theta: float = 0.0
    d: float = 0.0
    a: float = 0.0
    alpha: float = 0.0
    beta: float = 0.0

    @property
    def across(self) -> FloatArray:
        return about_x(*(np.asarray(value) for value in (self.a, self.alpha, self.beta)))

    @property
    def transform(self) -> FloatArray:
        return np.asarray(about_z(np.asarray(self.theta), np.asarray(self.d)) @ self.across)


def convert_table(table: DHTable, convention: Convention) -> DHTable:
    """Converts a table to another convention.

    Between standard and modified, numbers only change their row. In Hayati's form beta replaces d
    where axes are nearly, not exactly, parallel. Converted back, d is again the distance to the
    common normal, some hundred metres for a milliradian.

    Returns:
        The table. Poses agree to 1e-12, or 1e-8 where axes are less than 1e-4 and more than 0 rad
        from parallel; converting back gives the original table.
    """
    if convention == table.convention:
        return table
    angles = _off_parallel(table.along_x[:, :3, 2])
    # The first and last X_i have no second axis.
    angles[[0, -1]] = np.inf
    parallel = (angles < PARALLEL_RAD) & (convention == "hayati")
    rows, carried = [], np.zeros(2)
    for index, row in enumerate(_rows(table)):
        link = replace(row, theta=row.theta + carried[0], d=row.d + carried[1])
        hayati = bool(parallel[index + 1])
        keeps = link.d == 0.0 or bool(angles[index + 1] < EXACTLY) if hayati else link.beta == 0.0
        rows.append(link if keeps else _between(link.transform, link, hayati=hayati))
        carried = np.zeros(2)
        if not keeps:
            # Rotation about [rad] and translation along [m] the next axis that the row leaves.
            rest = invert(rows[-1].transform) @ link.transform
            carried[:] = np.arctan2(rest[1, 0], rest[0, 0]), rest[2, 3]
    return _with_rows(replace(table, convention=convention, parallel=parallel), rows)


def table_of(robot: Robot, convention: Convention, *, like: DHTable | None = None) -> DHTable:
    """Converts any robot to a joint table.

    The rows follow from the joints' axes alone; the constants `base` before the first axis and
    `flange` after the last take the rest. Both are as small as possible, and the identity where the
    first axis is the base's z and the last one the flange's.

    Args:
        robot: The robot, of a URDF, a table or a calibration.
        convention: The wanted convention.
        like: A table of nearly the same arm, whose free choices are kept: the sense of each x, d
            between parallel axes, and the nominal base and flange. None for the x that turns least
            from the one before.

    Returns:
        The table. Joint function offsets are in its theta and d.
    """
    chain = chain_about_z(robot.chain.with_offsets_placed())
    like = None if like is None else convert_table(like, convention)
    hints = [_DhRow()] * len(chain) if like is None else _rows(like)
    first = np.eye(4) if like is None else like.along_x[0]
    base = _base(chain.placements[0], np.eye(4) if like is None else like.base, first)
    rows, hayati_rows = [], []
    rest = invert(base @ first) @ chain.placements[0]
    for hint, placement in zip(hints[:-1], chain.placements[1:-1], strict=True):
        link = rest @ placement
        nearly_parallel = bool(_off_parallel(link[:3, 2]) < PARALLEL_RAD)
        hayati_rows.append(nearly_parallel and convention == "hayati")
        rows.append(_between(link, hint, hayati=hayati_rows[-1]))
        rest = invert(rows[-1].transform) @ link
    last, flange = _last_row(rest @ chain.placements[-1], hints[-1], like)
    count, none = len(chain), np.zeros(len(chain) + 1)
    table = DHTable(
        name=robot.name,
        tip=robot.tip,
        convention=convention,
        joint_names=chain.joint_names,
        prismatic=chain.prismatic,
        theta_rad=none[1:],
        d_m=none[1:],
        a_m=none if like is None else like.a_m,
        alpha_rad=none if like is None else like.alpha_rad,
        beta_rad=none,
        parallel=np.array([False, *hayati_rows, False]),
        base=base,
        flange=flange,
        lower=chain.lower,
        upper=chain.upper,
        functions=np.hstack([np.zeros((count, 1)), chain.functions[:, 1:]]),
    )
    return _with_rows(table, [*rows, last])


def with_base(robot: Robot, parent_from_base: FloatArray) -> Robot:
    """Builds the same arm in a new base frame, in which its base is at (4, 4) [m]."""
    gravity = {"gravity_m_s2": (parent_from_base[:3, :3] @ robot.gravity).tolist()}
    table = _described(robot)
    if table is None:
        placements = robot.chain.placements.copy()
        placements[0] = parent_from_base @ placements[0]
        chain = replace(robot.chain, placements=placements)
        document = robot.weighted(chain_document(robot.name, robot.tip, chain))
        return Robot.from_document(document | gravity)
    source = str(robot.document.get("source", ""))
    document = table_document(replace(table, base=parent_from_base @ table.base), source)
    # A mass is stated in the frame in which a joint's row ends, and stays in it.
    for row, known in zip(document["joint"], robot.document["joint"], strict=True):
        row |= {key: known[key] for key in LINK_KEYS if key in known}
    kept = {name: robot.document[name] for name in ARM_KEYS if name in robot.document}
    return Robot.from_document(document | kept | gravity)


def _described(robot: Robot) -> DHTable | None:
    """The table that describes a robot; None where it has another description."""
    return table_from_document(robot.document) if "convention" in robot.document else None


def parallel_axes(robot: Robot) -> Mask:
    """(n - 1,) mask of nearly parallel consecutive axes."""
    links = chain_about_z(robot.chain).placements[1:-1]
    return np.asarray(_off_parallel(links[:, :3, 2]) < PARALLEL_RAD)


def has_ur_axes(robot: Robot) -> bool:
    """Whether a robot has a UR's axes: six revolute ones, the second to fourth parallel.

    Other arms of six joints cannot run a UR's program.
    """
    if robot.joint_count != 6 or robot.chain.prismatic.any():
        return False
    return np.array_equal(parallel_axes(robot), [False, True, True, False, False])


def _rows(table: DHTable) -> list[_DhRow]:
    """Numbers of each Z_i X_i, in any convention."""
    columns = (table.theta_rad, table.d_m, table.a_m[1:], table.alpha_rad[1:], table.beta_rad[1:])
    return [_DhRow(*map(float, numbers)) for numbers in zip(*columns, strict=True)]


def _with_rows(table: DHTable, rows: list[_DhRow]) -> DHTable:
    """The table with other numbers of Z_i X_i; X_0 stays."""
    return replace(
        table,
        theta_rad=np.array([row.theta for row in rows]),
        d_m=np.array([row.d for row in rows]),
        a_m=np.array([table.a_m[0], *(row.a for row in rows)]),
        alpha_rad=np.array([table.alpha_rad[0], *(row.alpha for row in rows)]),
        beta_rad=np.array([table.beta_rad[0], *(row.beta for row in rows)]),
    )


def chain_about_z(chain: Chain) -> Chain:
    """The chain with each joint's frame rotated so that its axis is z."""
    turns = np.array([np.eye(4), *map(swing, chain.axes), np.eye(4)])
    return replace(
        chain,
        axes=np.tile([0.0, 0.0, 1.0], (len(chain), 1)),
        placements=invert(turns[:-1]) @ chain.placements @ turns[1:],
    )


def swing(direction: FloatArray) -> FloatArray:
    """The smallest rotation (4, 4) that turns z to a unit vector."""
    x, y, z = direction
    if z < EXACTLY - 1.0:
        return np.diag([1.0, -1.0, -1.0, 1.0])
    cross = skew(np.array([-y, x, 0.0]))
    return compose(np.eye(3) + cross + cross @ cross / (1.0 + z), np.zeros(3))


def _off_parallel(directions: FloatArray) -> FloatArray:
    """(...,) acute angles [rad] between (..., 3) unit vectors and the z axis."""
    return np.arctan2(np.hypot(directions[..., 0], directions[..., 1]), np.abs(directions[..., 2]))


def _between(link: FloatArray, hint: _DhRow, *, hayati: bool) -> _DhRow:
    """The row from an axis to the next.

    Args:
        link: (4, 4) the next axis' frame in the frame of this one, z along the axes.
        hint: Similar numbers: of the two senses of x, the one nearer to its theta is taken, and its
            d where axes are exactly parallel.
        hayati: Whether the row is Hayati's, with beta and d = 0.
    """
    direction, position = link[:3, 2], link[:3, 3]
    parallel = bool(_off_parallel(direction) < EXACTLY)
    if not (hayati or parallel):
        return _common_normal(direction, position, hint)
    d = hint.d if parallel else 0.0
    x, y, _ = position - direction * (position[2] - d) / direction[2]
    a = float(np.hypot(x, y))
    if a < EXACTLY:
        theta, sign = hint.theta, 1.0
        a = float(np.cos(theta) * x + np.sin(theta) * y)
    else:
        theta, sign = _nearer(float(np.arctan2(y, x)), hint.theta, forward=True)
    c, s = np.cos(theta), np.sin(theta)
    across = np.array([c * direction[0] + s * direction[1], c * direction[1] - s * direction[0]])
    if parallel:
        across[:] = 0.0
    alpha = _near(float(np.arctan2(-across[1], direction[2])), hint.alpha)
    return _DhRow(theta, d, sign * a, alpha, float(np.arcsin(across[0])))


def _common_normal(direction: FloatArray, position: FloatArray, hint: _DhRow) -> _DhRow:
    """The row with x along the common normal of two axes (Denavit and Hartenberg 1955)."""
    sine = np.hypot(direction[0], direction[1])
    normal = np.array([-direction[1], direction[0]]) / sine
    a, alpha = float(position[:2] @ normal), float(np.arctan2(sine, direction[2]))
    along = position[:2] @ direction[:2] / sine**2
    forward = a > 0.0 or abs(a) < EXACTLY
    theta, sign = _nearer(float(np.arctan2(normal[1], normal[0])), hint.theta, forward=forward)
    d = float(position[2] - along * direction[2])
    return _DhRow(theta, d, sign * a, _near(sign * alpha, hint.alpha))


def _near(angle: float, to: float) -> float:
    """The angle plus the whole turns that bring it nearest to another."""
    difference = float(np.remainder(angle - to + np.pi, 2.0 * np.pi) - np.pi)
    # A difference of half a turn is ambiguous; tables print +pi.
    return to + (
        abs(difference)
        if np.isclose(abs(difference), np.pi, rtol=0, atol=_ROUNDING)
        else difference
    )


def _nearer(theta: float, hint: float, *, forward: bool) -> tuple[float, float]:
    """Theta or its opposite, whichever is nearer to a hint, and the sign of a and alpha with it.

    Where both are a quarter turn away, `forward` decides.
    """
    same, opposite = _near(theta, hint), _near(theta + np.pi, hint)
    gain = abs(opposite - hint) - abs(same - hint)
    if abs(gain) < EXACTLY:
        gain = 1.0 if forward else -1.0
    return (same, 1.0) if gain > 0.0 else (opposite, -1.0)


def _base(placement: FloatArray, nominal: FloatArray, first: FloatArray) -> FloatArray:
    """The base nearest to the nominal after which, and X_0, the first axis is z."""
    deviation = invert(nominal @ first) @ placement
    direction, position = deviation[:3, 2], deviation[:3, 3]
    tilt = swing(direction)
    tilt[:3, 3] = position - direction * (position @ direction)
    if np.abs(tilt - np.eye(4)).max() < _ROUNDING:
        return nominal
    return np.asarray(nominal @ first @ tilt @ invert(first))


def _last_row(link: FloatArray, hint: _DhRow, like: DHTable | None) -> tuple[_DhRow, FloatArray]:
    """The last row, and the flange behind it."""
    if like is None and _off_parallel(link[:3, 2]) >= PARALLEL_RAD:
        row = _between(link, hint, hayati=False)
        return row, invert(row.transform) @ link
    flange = np.eye(4) if like is None else like.flange
    deviation = link @ invert(hint.across @ flange)
    # Rotation about z beside a tilt: the quaternion's z over its w.
    theta = _near(
        float(np.arctan2(deviation[1, 0] - deviation[0, 1], deviation[0, 0] + deviation[1, 1])),
        hint.theta,
    )
    row = replace(hint, theta=theta, d=float(deviation[2, 3]))
    rest = invert(row.transform) @ link
    return row, flange if np.abs(rest - flange).max() < _ROUNDING else rest


def other_convention(robot: Robot) -> tuple[Robot, Convention] | None:
    """The arm that a robot's table describes if read in the other convention.

    Base and flange are the identity.

    Returns:
        The arm and its convention; None where the robot is not described by a table.
    """
    declared = _described(robot)
    if declared is None:
        return None
    # Standard (or Hayati's) rows hold X_1 to X_n, modified ones X_0 to X_(n-1).
    is_modified = declared.convention == "modified"
    rows = slice(None, -1) if is_modified else slice(1, None)
    columns = np.array([declared.a_m, declared.alpha_rad, declared.beta_rad])[:, rows]
    a_m, alpha_rad, beta_rad = np.pad(columns, ((0, 0), (1, 0) if is_modified else (0, 1)))
    other = replace(
        declared,
        convention="standard" if is_modified else "modified",
        base=np.eye(4),
        flange=np.eye(4),
        functions=np.tile(IDENTITY_FUNCTION, (len(declared), 1)),
        a_m=a_m,
        alpha_rad=alpha_rad,
        beta_rad=beta_rad,
    )
    document = chain_document(robot.name, robot.tip, chain_of_table(other))
    return Robot.from_document(document), other.convention
