"""Positions, once rotations are solved for: units, signs, and those of the inverse.

With the rotations known the chain is linear in the positions of both unknown edges, and all ways
to take the numbers are solved for at once: they share the left side of the equations.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from visioncal.calibration.guess.fit import kept_count
from visioncal.calibration.guess.forms import Pairing
from visioncal.calibration.guess.given import Recording
from visioncal.calibration.guess.hypothesis import SIGNS, Signs
from visioncal.core.conventions import UNITS_M
from visioncal.core.transforms import compose, nearest_rotation, rotation_angle
from visioncal.core.types import FloatArray, IntArray
from visioncal.estimation.closed_form import SOLVERS

# Poses are written in these; micrometres are for instruments.
UNITS = ("m", "mm", "cm", "inch")


@dataclass(frozen=True, eq=False)
class Turned:
    """A pairing with the unknown rotation solved for.

    `robot` and `camera` are (n, 3, 3) rotations of the chain's parts, `transposed` is whether
    those are the transposes of what the forms give.
    """

    pairing: Pairing
    transposed: tuple[bool, bool]
    rows: IntArray
    robot: FloatArray
    camera: FloatArray
    x: FloatArray
    kept: IntArray
    score: float


@dataclass(frozen=True)
class Variant:
    """What the robot's positions may be beside its rotations.

    The inverse of both sides is the same chain with its unknown edges exchanged, so that the
    camera's positions can stay as they are.

    Attributes:
        carried: Whether they are those of the inverse pose: by the rotations, negated.
        signs: As in `Taken`.
        ratio: Their unit over the unit of the camera's.
        changes: In how many of these the variant departs from what was declared.
    """

    carried: bool
    signs: Signs
    ratio: float
    changes: int


def solve_turn(
    pairing: Pairing,
    transposed: tuple[bool, bool],
    rows: IntArray,
    sides: tuple[FloatArray, FloatArray],
) -> Turned:
    """Solves for X's rotation by the views that agree best."""
    robot, camera = (
        np.swapaxes(it, 1, 2) if flip else it for it, flip in zip(sides, transposed, strict=True)
    )
    nowhere, count = np.zeros(3), kept_count(len(rows))
    kept = np.arange(len(rows))
    x, angles = np.eye(3), np.zeros(len(rows))
    for _ in range(3):
        solve = SOLVERS["park"](compose(robot[kept], nowhere), compose(camera[kept], nowhere))
        x = solve.x[:3, :3]
        placed = robot @ x @ camera
        angles = rotation_angle(nearest_rotation(placed[kept].mean(axis=0)).T @ placed)
        kept = np.sort(np.argsort(angles)[:count])
    score = float(np.sqrt(np.mean(angles[kept] ** 2)))
    return Turned(pairing, transposed, rows, robot, camera, x, kept, score)


def score_variants(recording: Recording, turned: Turned) -> Iterator[tuple[float, Variant]]:
    """Scores all ways to take the positions, at once: they share the equations' left sides.

    `R_i t_X - t_Z = -(p_i + R_i R_X c_i)` for all views; t_Z goes with the means.
    """
    variants = tuple(_variants(recording))
    steps, lever = _steps(recording, turned, variants)
    kept = turned.kept
    matrix = turned.robot - turned.robot[kept].mean(axis=0)
    steps -= steps[kept].mean(axis=0)
    left = matrix[kept].reshape(-1, 3)
    found = -np.linalg.pinv(left, rcond=1e-3) @ steps[kept].reshape(len(left), -1)
    away = np.linalg.norm(steps + matrix @ found, axis=1) / lever
    nearest = np.partition(away, len(kept) - 1, axis=0)[: len(kept)]
    scores = np.hypot(np.sqrt(np.mean(nearest**2, axis=0)), turned.score)
    yield from zip(scores, variants, strict=True)


def _variants(recording: Recording) -> Iterator[Variant]:
    ratios = sorted({_ratio(a, b) for a, b in product(UNITS, UNITS)})
    declared = recording.declared
    inverse = declared.robot.inverse != (recording.mount == "eye-to-hand")
    given = (inverse != declared.camera.inverse, _ratio(declared.robot.unit, declared.camera.unit))
    for carried, signs, ratio in product((False, True), SIGNS, ratios):
        changes = (carried != given[0]) + (signs != "") + (ratio != given[1])
        yield Variant(carried, signs, ratio, changes)


def _ratio(robot_unit: str, camera_unit: str) -> float:
    return round(UNITS_M[robot_unit] / UNITS_M[camera_unit], 9)


def _steps(
    recording: Recording, turned: Turned, variants: Sequence[Variant]
) -> tuple[FloatArray, float]:
    """(n, 3, v) what must be made constant, and the lever, in the unit of the camera's numbers."""
    p = recording.robot.positions[turned.rows + turned.pairing.shift]
    c = recording.camera.positions[turned.rows]
    towards = (turned.robot @ turned.x @ c[..., None])[..., 0]
    moved = {}
    for signs in SIGNS:
        given = p * _sign(signs)
        moved[signs, False] = given
        moved[signs, True] = -(turned.robot @ given[..., None])[..., 0]
    steps = [it.ratio * moved[it.signs, it.carried] + towards for it in variants]
    lever = max(float(np.median(np.linalg.norm(c, axis=1))), 1e-12)
    return np.stack(steps, axis=2), lever


def _sign(signs: Signs) -> FloatArray:
    """What positions are multiplied with: a mirrored frame is one with all positions negated."""
    if signs == "mirror":
        return -np.ones(3)
    return np.where(np.arange(3) == "xyz".find(signs or "-"), -1.0, 1.0)
