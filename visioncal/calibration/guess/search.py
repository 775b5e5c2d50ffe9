"""The search: from all ways to take the numbers to the few that close the chain.

What is cheap and independent goes first: relative angles (forms, shifted rows), then rotations
(inverse or not), then positions (units, signs), each leaving a handful to the next; the handful at
the end is fitted in full. With the rotations known the chain is linear in the positions of both
unknown edges, and all ways to take the numbers are solved for at once: they share the left side of
the equations.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from visioncal.calibration.guess.fit import kept_count
from visioncal.calibration.guess.forms import (
    SHIFTS,
    Forms,
    Pairing,
    camera_forms,
    robot_forms,
    screen,
)
from visioncal.calibration.guess.given import (
    SCORE_FLOOR,
    Recording,
    Scored,
    fitted,
    is_far_likelier,
    is_likely_unit,
    likeness,
)
from visioncal.calibration.guess.hypothesis import (
    SIGNS,
    Hypothesis,
    SideReading,
    Signs,
    strangeness,
)
from visioncal.core.conventions import UNITS_M
from visioncal.core.transforms import compose, nearest_rotation, rotation_angle
from visioncal.core.types import MOUNTS, FloatArray, IntArray
from visioncal.estimation.closed_form import SOLVERS

# Rows looked at: more would add time and no certainty.
_MOST_ROWS = 40
# A stage hands on what is within this many times of its best, and at most so many.
_REACH, _PAIRINGS, _TURNED, _LABELLED, _FITTED = 3.0, 32, 24, 80, 12
# The half of a degree that noisy poses of few views add to any bound.
_SLACK_RAD = 5e-3
# By how much a change makes a reading less likely than one that does without.
_PRICE = 0.3
_STARTS = 12

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


def thinned(rows: IntArray, most: int = _MOST_ROWS) -> IntArray:
    """At most so many rows, evenly spread."""
    if len(rows) <= most:
        return rows
    return np.asarray(rows[np.linspace(0, len(rows) - 1, most).round().astype(int)])


def search(recording: Recording) -> list[Scored]:
    """Finds the readings that close the chain best.

    Returns:
        The declared reading first; then the others, the best first, one for each class of readings
        that residuals can distinguish.
    """
    kept = thinned(recording.common_rows())
    looked_at = _with_neighbours(kept, len(recording.robot))
    part, rows = recording.part(looked_at), np.searchsorted(looked_at, kept)
    robot = robot_forms(part.robot)
    camera = camera_forms(part.camera, is_measured=part.is_measured)
    pairings = _plausible(robot, camera, screen(robot, camera, rows))
    turned = _turned(part, robot, camera, pairings, rows)
    own, classes = _closing(part, robot, camera, turned)
    declared = _with_likelier(part, fitted(part, part.declared, rows, _STARTS), own, rows)
    others = [_best_label(part, labels, rows) for labels in classes]
    others.sort(key=lambda other: other.score)
    return [replace(scored, rows=looked_at[scored.rows]) for scored in (declared, *others)]


def _with_neighbours(rows: IntArray, count: int) -> IntArray:
    """Rows and those that shifts pair them with: next to each other among these as among all."""
    near = np.unique(np.add.outer(rows, SHIFTS))
    return np.asarray(near[(near >= 0) & (near < count)])


def _closing(
    recording: Recording, robot: Forms, camera: Forms, turned: Sequence[TurnedPairing]
) -> tuple[list[Hypothesis], list[list[Hypothesis]]]:
    """The declared reading's class, and the others to be fitted, as their simplest readings."""
    scored = [
        (float(score), turn, variant)
        for turn in turned
        for score, variant in score_variants(recording, turn)
    ]
    best = min((score for score, *_ in scored), default=0.0)
    close = [pair for pair in scored if pair[0] <= _REACH * best + _SLACK_RAD]
    close.sort(key=lambda pair: _priced(pair[0], _cheap_cost(robot, camera, pair[1], pair[2])))
    own: list[Hypothesis] = []
    classes = []
    for score, turn, variant in close[:_LABELLED]:
        labels = list(_labels(recording, robot, camera, turn, variant))
        if recording.declared in labels:
            own = labels
            continue
        costs = [recording.cost(label) for label in labels]
        least = min(costs)
        simplest = [label for label, cost in zip(labels, costs, strict=True) if cost == least]
        classes.append((_priced(score, least), simplest))
    classes.sort(key=lambda pair: pair[0])
    return own, [labels for _, labels in classes[:_FITTED]]


def _priced(score: float, cost: float) -> float:
    """A score by which simple readings come before others that are as good."""
    return (score + SCORE_FLOOR) * (1.0 + _PRICE * cost)


def _cheap_cost(robot: Forms, camera: Forms, turned: TurnedPairing, variant: Variant) -> float:
    """About `Recording.cost` of the simplest reading of a class, without building it."""
    transposed = (turned.transposed[0] != variant.carried) + turned.transposed[1]
    return _pairing_cost(robot, camera, turned.pairing) + variant.changes + transposed


def _pairing_cost(robot: Forms, camera: Forms, pairing: Pairing) -> float:
    """About `Recording.cost` of a pairing alone."""
    of_robot = 1.0 + strangeness(robot.turns[pairing.robot]) if pairing.robot else 0.0
    of_camera = 1.0 + strangeness(camera.turns[pairing.camera]) if pairing.camera else 0.0
    return of_robot + of_camera + (pairing.shift != 0)


def _labels(
    recording: Recording, robot: Forms, camera: Forms, turned: TurnedPairing, variant: Variant
) -> Iterator[Hypothesis]:
    """All readings that give the same chain."""
    # An inverse of the robot's poses, one of the camera's and another mount are the same change;
    # units go in pairs.
    pairing = turned.pairing
    transposed = turned.transposed[0] != variant.carried, turned.transposed[1]
    pairs = [
        (a, b)
        for a, b in UNIT_PAIRS
        if np.isclose(UNITS_M[a] / UNITS_M[b], variant.ratio, rtol=1e-6)
    ]
    if variant.scale != 1.0:
        pairs = [(recording.declared.robot.unit, recording.declared.camera.unit)]
    likely = [pair for pair in pairs if is_likely_unit(recording, pair[1])]
    inverses = (False,) if recording.is_measured else (False, True)
    for mount, inverse, (unit, camera_unit) in product(MOUNTS, inverses, likely or pairs):
        yield Hypothesis(
            SideReading(
                robot.turns[pairing.robot],
                unit,
                variant.carried != ((mount == "eye-to-hand") != inverse),
                transposed[0],
                variant.signs,
            ),
            SideReading(
                camera.turns[pairing.camera],
                camera_unit,
                inverse,
                transposed[1],
                scale=variant.scale,
            ),
            mount,
            pairing.shift,
        )


def _best_label(recording: Recording, labels: Sequence[Hypothesis], rows: IntArray) -> Scored:
    """Chooses among readings of one class by what cells look like."""
    # The target is before the camera, and what sits on the flange is near it.
    scored = [fitted(recording, label, rows, _STARTS) for label in labels]
    chosen = max(
        scored,
        key=lambda value: (likeness(recording, value), value.hypothesis.mount == recording.mount),
    )
    as_likely = (
        item.hypothesis
        for item in scored
        if item.hypothesis.mount != chosen.hypothesis.mount
        and likeness(recording, item) == likeness(recording, chosen)
    )
    cost = recording.cost(chosen.hypothesis)
    return replace(chosen, labels=tuple(labels), cost=cost, other_mount=next(as_likely, None))


def _with_likelier(
    recording: Recording, declared: Scored, own: Sequence[Hypothesis], rows: IntArray
) -> Scored:
    """Tells of the simplest readings of the declared one's class that make a likelier cell."""
    unit = declared.hypothesis.robot.unit
    scored = [
        fitted(recording, hypothesis, rows, _STARTS)
        for hypothesis in own
        if hypothesis.robot.unit == unit
    ]
    likelier = [item.hypothesis for item in scored if is_far_likelier(recording, item, declared)]
    least = min((recording.cost(hypothesis) for hypothesis in likelier), default=0.0)
    return replace(
        declared,
        labels=tuple(hypothesis for hypothesis in likelier if recording.cost(hypothesis) == least),
    )


def _plausible(robot: Forms, camera: Forms, pairings: Sequence[Pairing]) -> list[Pairing]:
    """The pairings with the best mismatch, simple ones first, and the declared one."""
    best = min(pairing.mismatch_rad for pairing in pairings)
    bound = _REACH * best + _SLACK_RAD
    near = [pairing for pairing in pairings[1:] if pairing.mismatch_rad <= bound]
    near.sort(
        key=lambda pairing: _priced(pairing.mismatch_rad, _pairing_cost(robot, camera, pairing))
    )
    return [pairings[0], *near[: _PAIRINGS - 1]]


def _turned(
    recording: Recording,
    robot: Forms,
    camera: Forms,
    pairings: Sequence[Pairing],
    rows: IntArray,
) -> list[TurnedPairing]:
    """Solves for the rotations of each pairing, with each side as given and transposed."""
    solved = []
    cameras = (False,) if recording.is_measured else (False, True)
    for pairing in pairings:
        turns = robot.rotations[pairing.robot], camera.rotations[pairing.camera]
        inside = rows[(rows + pairing.shift >= 0) & (rows + pairing.shift < turns[0].shape[0])]
        there = np.isfinite(turns[0][inside + pairing.shift]).all(axis=(1, 2))
        inside = inside[there & np.isfinite(turns[1][inside]).all(axis=(1, 2))]
        if len(inside) < 3:
            continue
        sides = turns[0][inside + pairing.shift], turns[1][inside]
        solved += [
            solve_turn(pairing, pair, inside, sides) for pair in product((False, True), cameras)
        ]
    best = min((turned.score for turned in solved), default=0.0)
    near = [turned for turned in solved if turned.score <= _REACH * best + _SLACK_RAD]
    near.sort(
        key=lambda turned: _priced(turned.score, _pairing_cost(robot, camera, turned.pairing))
    )
    return near[:_TURNED]
