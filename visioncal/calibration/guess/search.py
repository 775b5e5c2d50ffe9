"""Search of all readings for the few that close the chain.

What is cheap and independent goes first: relative angles (forms, shifted rows), then rotations
(inverse or not), then positions (units, signs), each leaving a handful to the next; the last
handful
is fitted in full. With the rotations known the chain is linear in the positions of both unknown
edges, and all variants are solved for at once: they share the left side of the equations.
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
from visioncal.calibration.guess.hypothesis import (
    SIGNS,
    Hypothesis,
    SideReading,
    Signs,
    strangeness,
)
from visioncal.calibration.guess.recording import (
    CLEAR,
    Recording,
    Scored,
    fitted,
    is_likely_unit,
    plausibility,
)
from visioncal.core.conventions import UNITS_M
from visioncal.core.transforms import compose, nearest_rotation, rotation_angle
from visioncal.core.types import MOUNTS, FloatArray, IntArray
from visioncal.estimation.closed_form import SOLVERS

# Most rows that are fitted: more add time and no certainty.
_FITTED_ROWS = 40
# A stage hands on what is within this ratio of its best score, and at most the numbers that follow.
_RATIO, _PAIRINGS, _TURNED, _LABELLED, _FITTED = 3.0, 32, 24, 80, 12
# Half a degree, which noisy poses of few views add to any bound.
_SLACK_RAD = 5e-3
# Relative penalty of a score per change of the declared reading.
_PENALTY, _FLOOR = 0.3, 1e-4
_STARTS = 12

# Units of poses; micrometres are for instruments. Nobody has a robot in inches and a camera in
# centimetres, but a target of another size than stated looks like it.
_UNITS = ("m", "mm", "cm", "inch")
UNIT_PAIRS = tuple(pair for pair in product(_UNITS, _UNITS) if {*pair} != {"cm", "inch"})

# Limits of a target's size relative to the stated one, as logarithms: up to a half more or less is
# fitted elsewhere. Fewer views than the last number fit any size.
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
    """A reading of the positions beside given rotations.

    The inverse of both sides is the same chain with its unknown edges exchanged, so that the
    camera's positions can stay as they are.
    """

    carried: bool  # Whether the robot's are those of the inverse pose: rotated and negated.
    signs: Signs  # As in `SideReading`.
    ratio: float  # The robot's unit over the camera's.
    changes: int  # Number of differences from the declared reading.
    scale: float = 1.0  # Further factor of the camera's positions.


def solve_turn(
    pairing: Pairing, transposed: tuple[bool, bool], rows: IntArray, sides: tuple[FloatArray, ...]
) -> TurnedPairing:
    """Solves for X's rotation by the views that agree best."""
    robot, camera = (
        np.swapaxes(side, 1, 2) if flip else side
        for side, flip in zip(sides, transposed, strict=True)
    )
    zero, kept = np.zeros(3), np.arange(len(rows))
    x, angles = np.eye(3), np.zeros(len(rows))
    for _ in range(3):
        solve = SOLVERS["park"](compose(robot[kept], zero), compose(camera[kept], zero))
        x = solve.x[:3, :3]
        placed = robot @ x @ camera
        angles = rotation_angle(nearest_rotation(placed[kept].mean(axis=0)).T @ placed)
        kept = np.sort(np.argsort(angles)[: kept_count(len(rows))])
    score = float(np.sqrt(np.mean(angles[kept] ** 2)))
    return TurnedPairing(pairing, transposed, rows, robot, camera, x, kept, score)


def score_variants(recording: Recording, turned: TurnedPairing) -> Iterator[tuple[float, Variant]]:
    """Scores all readings of the positions at once.

    `R_i t_X - t_Z = -(p_i + R_i R_X c_i)` for all views; subtracting means eliminates t_Z. All
    variants share the left side.
    """
    variants = tuple(_variants(recording))
    right, lever = _right_sides(recording, turned, variants)
    kept = turned.kept
    matrix = turned.robot - turned.robot[kept].mean(axis=0)
    right -= right[kept].mean(axis=0)
    left = matrix[kept].reshape(-1, 3)
    solution = -np.linalg.pinv(left, rcond=1e-3) @ right[kept].reshape(len(left), -1)
    distances = np.linalg.norm(right + matrix @ solution, axis=1) / lever
    nearest = np.partition(distances, len(kept) - 1, axis=0)[: len(kept)]
    scores = np.hypot(np.sqrt(np.mean(nearest**2, axis=0)), turned.score)
    yield from zip(scores, variants, strict=True)
    yield from _scaled_variants(recording, turned, variants, matrix)


def _scaled_variants(
    recording: Recording, turned: TurnedPairing, variants: Sequence[Variant], matrix: FloatArray
) -> Iterator[tuple[float, Variant]]:
    """Scores the positions, or the inverse's, with the size of the target unknown."""
    # `R_i t_X + r p_i - t_Z = -R_i R_X c_i`, whose r is the ratio over the scale. Sizes near the
    # stated one are fitted elsewhere; here, units would be mistaken for them.
    declared = _ratio(recording.declared.robot.unit, recording.declared.camera.unit)
    kept = turned.kept
    for item in variants:
        if item.ratio != declared or item.signs:
            continue
        right, lever = _right_sides(recording, turned, (item, replace(item, ratio=0.0)))
        right = (right - right[kept].mean(axis=0)) / lever
        # With a ratio of 0 only the camera's positions remain.
        of_camera = right[..., 1]
        left = np.concatenate([matrix, right[..., :1] - right[..., 1:]], axis=2)
        inverse = np.linalg.pinv(left[kept].reshape(-1, 4), rcond=1e-3)
        solution = -inverse @ of_camera[kept].reshape(-1)
        scale = 1.0 / solution[3] if solution[3] > 0.0 else np.inf
        if len(kept) < _FEWEST_SIZED or not _SMALLEST < abs(np.log(scale)) < _LARGEST:
            continue
        distances = np.sort(np.linalg.norm(of_camera + left @ solution, axis=1))[: len(kept)]
        score = float(np.hypot(np.sqrt(np.mean(distances**2)), turned.score))
        yield score, replace(item, changes=item.changes + 1, scale=float(scale))


def _variants(recording: Recording) -> Iterator[Variant]:
    ratios = sorted({_ratio(*pair) for pair in UNIT_PAIRS})
    declared = recording.declared
    inverse = declared.robot.inverse != (recording.mount == "eye-to-hand")
    is_carried = inverse != declared.camera.inverse
    declared_ratio = _ratio(declared.robot.unit, declared.camera.unit)
    for carried, signs, ratio in product((False, True), SIGNS, ratios):
        changes = (carried != is_carried) + (signs != "") + (ratio != declared_ratio)
        yield Variant(carried, signs, ratio, changes)


def _ratio(robot_unit: str, camera_unit: str) -> float:
    return round(UNITS_M[robot_unit] / UNITS_M[camera_unit], 9)


def _right_sides(
    recording: Recording, turned: TurnedPairing, variants: Sequence[Variant]
) -> tuple[FloatArray, float]:
    """(n, 3, v) right sides p_i + R_i R_X c_i, and the lever, in the camera's unit."""
    p = recording.robot.positions[turned.rows + turned.pairing.shift]
    c = recording.camera.positions[turned.rows]
    of_camera = (turned.robot @ turned.x @ c[..., None])[..., 0]
    of_robot = {}
    for signs in SIGNS:
        signed = p * _sign(signs)
        of_robot[signs, False] = signed
        of_robot[signs, True] = -(turned.robot @ signed[..., None])[..., 0]
    right = [
        variant.ratio * of_robot[variant.signs, variant.carried] + of_camera for variant in variants
    ]
    lever = max(float(np.median(np.linalg.norm(c, axis=1))), 1e-12)
    return np.stack(right, axis=2), lever


def _sign(signs: Signs) -> FloatArray:
    """Factors of the positions: a mirrored frame is equivalent to negating all of them."""
    if signs == "mirror":
        return -np.ones(3)
    return np.where(np.arange(3) == "xyz".find(signs or "-"), -1.0, 1.0)


def thinned(rows: IntArray, most: int = _FITTED_ROWS) -> IntArray:
    """At most `most` rows, evenly spread."""
    spread = np.linspace(0, len(rows) - 1, most).round().astype(int)
    return rows if len(rows) <= most else np.asarray(rows[spread])


def search(recording: Recording) -> list[Scored]:
    """Finds the readings that close the chain best.

    Returns:
        The declared reading first; then the others, best first, one for each class of readings
        that residuals can distinguish.
    """
    kept = thinned(recording.common_rows())
    looked_at = _with_neighbours(kept, len(recording.robot))
    part, rows = recording.part(looked_at), np.searchsorted(looked_at, kept)
    robot = robot_forms(part.robot)
    camera = camera_forms(part.camera, is_measured=part.is_measured)
    pairings = _plausible(robot, camera, screen(robot, camera, rows))
    turned = _solved_pairings(part, robot, camera, pairings, rows)
    own, classes = _classes(part, robot, camera, turned)
    declared = _with_likelier(part, fitted(part, part.declared, rows, _STARTS), own, rows)
    others = [_best_label(part, labels, rows) for labels in classes]
    others.sort(key=lambda other: -other.log_posterior)
    return [replace(scored, rows=looked_at[scored.rows]) for scored in (declared, *others)]


def _with_neighbours(rows: IntArray, count: int) -> IntArray:
    """Rows and those that shifts pair them with; their indices keep the shifts."""
    near = np.unique(np.add.outer(rows, SHIFTS))
    return np.asarray(near[(near >= 0) & (near < count)])


def _classes(
    recording: Recording, robot: Forms, camera: Forms, turned: Sequence[TurnedPairing]
) -> tuple[list[Hypothesis], list[list[Hypothesis]]]:
    """The declared reading's class, and the simplest readings of the other classes to fit."""
    scored = [
        (float(score), turn, variant)
        for turn in turned
        for score, variant in score_variants(recording, turn)
        # Misread angles and a left-handed frame, or transposes, are never mistaken together.
        if not (
            robot.turns[turn.pairing.robot].written
            and (variant.signs or turn.transposed[0] != variant.carried)
        )
    ]
    best = min((score for score, *_ in scored), default=0.0)
    close = [pair for pair in scored if pair[0] <= _RATIO * best + _SLACK_RAD]
    close.sort(key=lambda pair: _penalised(pair[0], _cheap_cost(robot, camera, pair[1], pair[2])))
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
        classes.append((_penalised(score, least), simplest))
    classes.sort(key=lambda pair: pair[0])
    return own, [labels for _, labels in classes[:_FITTED]]


def _penalised(score: float, cost: float) -> float:
    """Score that ranks simple readings before equally good others."""
    return (score + _FLOOR) * (1.0 + _PENALTY * cost)


def _cheap_cost(robot: Forms, camera: Forms, turned: TurnedPairing, variant: Variant) -> float:
    """Approximates `Recording.cost` of a class's simplest reading, without building it."""
    transposed = (turned.transposed[0] != variant.carried) + turned.transposed[1]
    return _pairing_cost(robot, camera, turned.pairing) + variant.changes + transposed


def _pairing_cost(robot: Forms, camera: Forms, pairing: Pairing) -> float:
    """Approximates `Recording.cost` of a pairing alone."""
    of_robot = 1.0 + strangeness(robot.turns[pairing.robot]) if pairing.robot else 0.0
    of_camera = 1.0 + strangeness(camera.turns[pairing.camera]) if pairing.camera else 0.0
    return of_robot + of_camera + (pairing.shift != 0)


def _labels(
    recording: Recording, robot: Forms, camera: Forms, turned: TurnedPairing, variant: Variant
) -> Iterator[Hypothesis]:
    """All readings that give the same chain."""
    # Inverting the robot's poses, inverting the camera's and changing the mount are equivalent;
    # units go in pairs.
    pairing = turned.pairing
    of_robot, of_camera = robot.turns[pairing.robot], camera.turns[pairing.camera]
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
                of_robot,
                unit,
                variant.carried != ((mount == "eye-to-hand") != inverse),
                transposed[0],
                variant.signs,
            ),
            SideReading(of_camera, camera_unit, inverse, transposed[1], scale=variant.scale),
            mount,
            pairing.shift,
        )


def _best_label(recording: Recording, labels: Sequence[Hypothesis], rows: IntArray) -> Scored:
    """Chooses the reading with the most plausible cell among those of one class."""
    tried = [fitted(recording, label, rows, _STARTS) for label in labels]
    likely = {item.hypothesis: plausibility(recording, item) for item in tried}
    chosen = max(tried, key=lambda item: likely[item.hypothesis])
    least = likely[chosen.hypothesis] - CLEAR
    as_likely = (
        label
        for label in labels
        if label.mount != chosen.hypothesis.mount and likely[label] > least
    )
    return replace(chosen, labels=tuple(labels), other_mount=next(as_likely, None))


def _with_likelier(
    recording: Recording, declared: Scored, own: Sequence[Hypothesis], rows: IntArray
) -> Scored:
    """Adds the simplest labels of the declared reading's class with a more plausible cell."""
    unit, limit = declared.hypothesis.robot.unit, plausibility(recording, declared) + CLEAR
    tried = [fitted(recording, item, rows, _STARTS) for item in own if item.robot.unit == unit]
    likelier = [item for item in tried if plausibility(recording, item) > limit]
    most = max((item.log_prior for item in likelier), default=0.0)
    labels = (item.hypothesis for item in likelier if item.log_prior == most)
    return replace(declared, labels=tuple(labels))


def _plausible(robot: Forms, camera: Forms, pairings: Sequence[Pairing]) -> list[Pairing]:
    """The declared pairing, then those with the least mismatch, simple ones first."""
    bound = _RATIO * min(pairing.mismatch_rad for pairing in pairings) + _SLACK_RAD
    near = [pairing for pairing in pairings[1:] if pairing.mismatch_rad <= bound]
    near.sort(key=lambda item: _penalised(item.mismatch_rad, _pairing_cost(robot, camera, item)))
    return [pairings[0], *near[: _PAIRINGS - 1]]


def _solved_pairings(
    recording: Recording, robot: Forms, camera: Forms, pairings: Sequence[Pairing], rows: IntArray
) -> list[TurnedPairing]:
    """Solves for the rotations of each pairing, with each side as given and transposed."""
    solved = []
    cameras = (False,) if recording.is_measured else (False, True)
    for pairing in pairings:
        forms = robot.rotations[pairing.robot], camera.rotations[pairing.camera]
        inside = rows[(rows + pairing.shift >= 0) & (rows + pairing.shift < forms[0].shape[0])]
        readable = np.isfinite(forms[0][inside + pairing.shift]).all(axis=(1, 2))
        inside = inside[readable & np.isfinite(forms[1][inside]).all(axis=(1, 2))]
        if len(inside) < 3:
            continue
        sides = forms[0][inside + pairing.shift], forms[1][inside]
        transposed = product((False, True), cameras)
        solved += [solve_turn(pairing, pair, inside, sides) for pair in transposed]
    best = min((turned.score for turned in solved), default=0.0)
    near = [turned for turned in solved if turned.score <= _RATIO * best + _SLACK_RAD]
    near.sort(key=lambda item: _penalised(item.score, _pairing_cost(robot, camera, item.pairing)))
    return near[:_TURNED]
