"""Simulated touches with a tool's tip: of a fixed point and of a fixture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.documents.tables import csv_text
from visioncal.core.errors import DataError
from visioncal.core.files import write_atomically
from visioncal.core.transforms import apply, compose, exp, invert
from visioncal.core.types import FloatArray
from visioncal.session import frame_name
from visioncal.session.columns import pose_row
from visioncal.simulation.arms import forward, inverse, reach_m
from visioncal.simulation.cell import SimulatedCell, SimulatedRobot
from visioncal.simulation.layout import RandomStream
from visioncal.simulation.postures import LEAST_DEXTERITY, home_posture, lowest_m

# Points of the drawing, in the fixture's frame [m].
_DRAWN_M = np.array(
    [
        [0.0, 0.0, 0.0],
        [0.24, 0.0, 0.0],
        [0.24, 0.16, 0.0],
        [0.0, 0.15, 0.01],
        [0.05, 0.04, 0.03],
        [0.19, 0.05, 0.03],
        [0.17, 0.12, 0.045],
        [0.06, 0.11, 0.02],
    ]
)


@dataclass(frozen=True, eq=False)
class Touched:
    """Touches of one table."""

    columns: Mapping[str, tuple[str, ...]]  # Further columns of the rows, beside pose and joints.
    base_from_flange: FloatArray  # (n, 4, 4) reported poses.
    joints: FloatArray  # (n, k) reported joint angles [rad].


@dataclass(frozen=True, eq=False)
class Touching:
    """Touches by the arm of a cell."""

    flange_from_tool: FloatArray  # (4, 4) pose of the tool; its tip is the origin.
    base_from_fixture: FloatArray  # (4, 4) pose of the fixture.
    tip: Touched  # Touches of one point, to calibrate the tool.
    features: Touched  # Touches of the fixture's origin, x axis and xy plane.
    points: Touched  # Touches of the drawing's points.

    def transforms(self, robot: str = "") -> dict[str, FloatArray]:
        """Poses of tool and fixture by the names of a result, for a robot by name."""
        return {
            f"{frame_name('flange', robot)}_from_tool": self.flange_from_tool,
            f"{frame_name('base', robot)}_from_fixture": self.base_from_fixture,
        }

    @property
    def drawing(self) -> list[dict[str, object]]:
        """Rows of the drawing: `point`, `x_mm`, `y_mm`, `z_mm`."""
        rows = (1e3 * _DRAWN_M).round(6).tolist()
        return [
            {"point": f"P{at}", "x_mm": x, "y_mm": y, "z_mm": z}
            for at, (x, y, z) in enumerate(rows, start=1)
        ]


def touch(cell: SimulatedCell) -> dict[str, Touching]:
    """Touches by each robot of a cell, with a tool of its own, of a fixture before it.

    The tool is calibrated with tip, axis and plane; its tip then touches the fixture. The arm is
    without a payload, and has the same errors as with the camera.

    Raises:
        DataError: An arm cannot reach enough postures.
    """
    touching = {}
    for index, (name, robot) in enumerate(cell.robots.items()):
        # The first robot has the same random stream as a single one.
        rng = cell.options.stream(RandomStream.TOUCHES, *((index,) if index else ()))
        touching[name] = _touching(robot, rng)
    return touching


def _touching(robot: SimulatedRobot, rng: np.random.Generator) -> Touching:
    rotation = Rotation.from_rotvec(rng.normal(0.0, 0.3, 3)).as_matrix()
    flange_from_tool = compose(rotation, rng.uniform([-0.04, -0.04, 0.12], [0.04, 0.04, 0.18]))
    fixture_rotation = Rotation.from_rotvec(
        [*rng.normal(0.0, 0.03, 2), rng.uniform(-0.5, 0.5)]
    ).as_matrix()
    reach = reach_m(robot.arm)
    base_from_fixture = compose(
        fixture_rotation, np.array([0.45 * reach, -0.1 * reach, 0.12 * reach])
    )

    far, aside = rng.uniform(0.08, 0.12, 4), rng.uniform(-0.02, 0.02, 2)
    along = [[0.0, 0.0, value] for value in far[:2]]
    across = [[x, 0.0, z] for x, z in zip(far[2:], aside, strict=True)]
    in_tool = np.concatenate([np.zeros((10, 3)), along, across])
    corner = np.tile(base_from_fixture[:3, 3] + [0.0, 0.0, 0.05], (len(in_tool), 1))
    kinds = ("point",) * 10 + ("z",) * 2 + ("xz",) * 2
    tip = _touched(robot, flange_from_tool, corner, in_tool, {"kind": kinds}, rng)

    featured = np.zeros((9, 3))
    featured[3:6, 0], featured[6:, :2] = rng.uniform(0.1, 0.25, 3), rng.uniform(0.1, 0.2, (3, 2))
    features = ("origin",) * 3 + ("x",) * 3 + ("xy",) * 3

    def on_fixture(places: FloatArray, columns: Mapping[str, tuple[str, ...]]) -> Touched:
        contacts = apply(base_from_fixture, places)
        return _touched(robot, flange_from_tool, contacts, np.zeros_like(contacts), columns, rng)

    names = tuple(f"P{at}" for at in range(1, len(_DRAWN_M) + 1))
    return Touching(
        flange_from_tool,
        base_from_fixture,
        tip,
        on_fixture(featured, {"kind": features}),
        on_fixture(_DRAWN_M, {"point": names}),
    )


def _touched(
    robot: SimulatedRobot,
    flange_from_tool: FloatArray,
    places: FloatArray,
    in_tool: FloatArray,
    columns: Mapping[str, tuple[str, ...]],
    rng: np.random.Generator,
) -> Touched:
    """Touches points in the base (n, 3) with points of the tool (n, 3) [m], at random tilts."""
    # Contact error per axis [m].
    contacts = places + 5e-5 * rng.standard_normal(places.shape)
    on_flange = apply(flange_from_tool, in_tool)
    down = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    straight = compose(down.as_matrix(), contacts[0] - down.apply(on_flange[0]))
    home = home_posture(robot.arm, straight[None], rng)
    joints = np.zeros((len(contacts), robot.arm.a.size))
    pending = np.ones(len(contacts), dtype=bool)
    for _ in range(40):
        count = int(pending.sum())
        # Within a cone about the vertical [rad].
        tilt = 0.75 * np.sqrt(rng.uniform(0.0, 1.0, count))
        lean, spin = rng.uniform(0.0, 2.0 * np.pi, count), rng.uniform(-1.0, 1.0, count)
        axes = np.stack([np.cos(lean), np.sin(lean), np.zeros(count)], axis=1)
        rotations = Rotation.from_rotvec(tilt[:, None] * axes) * down
        rotations = rotations * Rotation.from_rotvec(np.outer(spin, [0.0, 0.0, 1.0]))
        goals = np.tile(np.eye(4), (count, 1, 1))
        goals[:, :3, :3] = rotations.as_matrix()
        goals[:, :3, 3] = contacts[pending] - rotations.apply(on_flange[pending])
        # The true flange pose deviates by its repeatability.
        goals = goals @ exp(-robot.options.sigma * rng.standard_normal((count, 6)))
        # Of the real arm: each step reduces the error by the ratio of deflection.
        solutions, aims = np.tile(home, (count, 1)), goals
        for _ in range(6):
            reach = inverse(robot.true_arm, aims, solutions)
            solutions = reach.joints
            poses = robot.flange_at(solutions)
            aims = goals @ invert(poses) @ aims
        good = reach.solved & (reach.dexterity > LEAST_DEXTERITY)
        good &= np.abs(poses - goals).max(axis=(1, 2)) < 1e-8
        good &= lowest_m(robot.arm, solutions) > 0.0
        joints[np.flatnonzero(pending)[good]] = solutions[good]
        pending[pending] = np.logical_not(good)
        if not pending.any():
            return Touched(columns, forward(robot.arm, joints), joints)
    raise DataError(
        f"simulation: the {robot.arm.name} reaches {len(contacts) - int(pending.sum())} of "
        f"{len(contacts)} touches.",
        next_step="Take another robot or seed.",
    )


def write_touches(touched: Mapping[str, Touching], folder: Path) -> None:
    """Writes `touches.csv`, `features.csv`, `points.csv` and the drawing, `cad.csv`.

    Args:
        touched: Touches by robot name; rows of named robots have a column `robot`.
        folder: Output folder.

    Raises:
        DataError: The folder cannot be written.
    """
    for name, part in {"touches": "tip", "features": "features", "points": "points"}.items():
        rows: list[dict[str, object]] = []
        for robot, touching in touched.items():
            table: Touched = getattr(touching, part)
            for at, q in enumerate(table.joints.tolist()):
                rows.append(
                    {"view": len(rows)}
                    | ({"robot": robot} if robot else {})
                    | {column: values[at] for column, values in table.columns.items()}
                    | pose_row(table.base_from_flange[at])
                    | {f"q{joint}_rad": value for joint, value in enumerate(q, start=1)}
                )
        write_atomically(folder / f"{name}.csv", _csv(rows))
    write_atomically(folder / "cad.csv", _csv(next(iter(touched.values())).drawing))


def _csv(rows: Sequence[Mapping[str, object]]) -> str:
    return csv_text([rows[0], *([row.get(name, "") for name in rows[0]] for row in rows)])
