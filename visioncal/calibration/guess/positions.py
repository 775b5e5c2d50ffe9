"""Positions, once rotations are solved for: units, signs, and those of the inverse.

With the rotations known the chain is linear in the positions of both unknown edges, and all ways
to take the numbers are solved for at once: they share the left side of the equations.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
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

# Poses are written in these; micrometres are for instruments. Nobody has a robot in inches and a
# camera in centimetres, but a target of another size than stated looks like it.
_UNITS = ("m", "mm", "cm", "inch")
UNIT_PAIRS = tuple(pair for pair in product(_UNITS, _UNITS) if {*pair} != {"cm", "inch"})

# Sizes of targets that are looked for, as logarithms of their share of the stated size: a half more
# or less is fitted elsewhere. Fewer views could be of any.
_SMALLEST, _LARGEST, _FEWEST_SIZED = np.log(1.5), np.log(20.0), 5


@dataclass(frozen=True, eq=False)
class TurnedPairing:
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
        scale: What the camera's are to be multiplied with besides.
        changes: In how many of these the variant departs from what was declared.
    """

    carried: bool
    signs: Signs
    ratio: float
    changes: int
    scale: float = 1.0


def solve_turn(
    pairing: Pairing,
    transposed: tuple[bool, bool],
    rows: IntArray,
    sides: tuple[FloatArray, FloatArray],
) -> TurnedPairing:
    """Solves for X's rotation by the views that agree best."""
    robot, camera = (
        np.swapaxes(side, 1, 2) if flip else side
        for side, flip in zip(sides, transposed, strict=True)
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
    return TurnedPairing(pairing, transposed, rows, robot, camera, x, kept, score)


def score_variants(recording: Recording, turned: TurnedPairing) -> Iterator[tuple[float, Variant]]:
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
    yield from _of_another_size(recording, turned, variants, matrix)


def _of_another_size(
    recording: Recording, turned: TurnedPairing, variants: Sequence[Variant], matrix: FloatArray
) -> Iterator[tuple[float, Variant]]:
    """Scores the positions as they are, or of the inverse, with the size of the target unknown."""
    # `R_i t_X + r p_i - t_Z = -R_i R_X c_i`, whose r is the ratio over the scale. Sizes near the
    # stated one are found by whoever fits them; here, units would be taken for them.
    declared = _ratio(recording.declared.robot.unit, recording.declared.camera.unit)
    kept = turned.kept
    for item in (
        variant for variant in variants if variant.ratio == declared and not variant.signs
    ):
        steps, lever = _steps(recording, turned, (item, replace(item, ratio=0.0)))
        steps = (steps - steps[kept].mean(axis=0)) / lever
        # Without the robot's positions the camera's are left.
        towards = steps[..., 1]
        left = np.concatenate([matrix, steps[..., :1] - steps[..., 1:]], axis=2)
        found = -np.linalg.pinv(left[kept].reshape(-1, 4), rcond=1e-3) @ towards[kept].reshape(-1)
        scale = 1.0 / found[3] if found[3] > 0.0 else np.inf
        if len(kept) < _FEWEST_SIZED or not _SMALLEST < abs(np.log(scale)) < _LARGEST:
            continue
        away = np.sort(np.linalg.norm(towards + left @ found, axis=1))[: len(kept)]
        score = float(np.hypot(np.sqrt(np.mean(away**2)), turned.score))
        yield score, replace(item, changes=item.changes + 1, scale=float(scale))


def _variants(recording: Recording) -> Iterator[Variant]:
    ratios = sorted({_ratio(*pair) for pair in UNIT_PAIRS})
    declared = recording.declared
    inverse = declared.robot.inverse != (recording.mount == "eye-to-hand")
    given = (inverse != declared.camera.inverse, _ratio(declared.robot.unit, declared.camera.unit))
    for carried, signs, ratio in product((False, True), SIGNS, ratios):
        changes = (carried != given[0]) + (signs != "") + (ratio != given[1])
        yield Variant(carried, signs, ratio, changes)


def _ratio(robot_unit: str, camera_unit: str) -> float:
    return round(UNITS_M[robot_unit] / UNITS_M[camera_unit], 9)


def _steps(
    recording: Recording, turned: TurnedPairing, variants: Sequence[Variant]
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
    steps = [
        variant.ratio * moved[variant.signs, variant.carried] + towards for variant in variants
    ]
    lever = max(float(np.median(np.linalg.norm(c, axis=1))), 1e-12)
    return np.stack(steps, axis=2), lever


def _sign(signs: Signs) -> FloatArray:
    """What positions are multiplied with: a mirrored frame is one with all positions negated."""
    if signs == "mirror":
        return -np.ones(3)
    return np.where(np.arange(3) == "xyz".find(signs or "-"), -1.0, 1.0)
