"""Rotations whose numbers were taken for others, as degrees for radians, and lost whole turns.

The robot's positions, which are right, place both edges but for a rotation of the tool. The
recorded rotation of one view gives it for each number of turns that its angles may have lost; the
others show which one is right, and then how many turns each of them lost. Turns of all views about
the last axis of Euler angles are turns of the tool, and stay open.
"""

from collections.abc import Iterator
from itertools import product

import numpy as np

from visioncal.calibration.guess.fit import CLOSING_SCORE
from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS
from visioncal.core.transforms import invert, nearest_rotation, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mount

_TURN = 2.0 * np.pi
# Rotations by angles 57 times as large are alike to half a radian, by chance in one view of 150. So
# many views decide, but for a few that may be wrong, as may be the first.
_ALIKE, _CHECKED, _WRONG = float(np.cos(0.5)), 8, 2
# Views whose rivals are all tried together: five determine the places.
_PLACING = 6


def _forms(*, keep_turns: bool) -> Iterator[tuple[str, str]]:
    """Names of forms that robots write, after those which they are taken for.

    Those of another unit, which lose whole turns, unless these are kept.
    """
    orders = {form.rotation.split("-")[1] for form in POSE_FORMS.values() if "eul" in form.rotation}
    # Angles about fixed axes are those about moving ones in reverse order.
    moving = {order if order.isupper() else order[::-1].upper() for order in orders}
    if not keep_turns:
        yield "rotation-vector", "rotation-vector-deg"
    for angles in ("euler-xyz-rad", "euler-ZYX-rad", "euler-XYZ-rad"):
        yield from ((angles, "rotation-vector"), ("rotation-vector", angles))
    if keep_turns:
        return
    # Roll, pitch and yaw first: they are the most common.
    yield from ((f"euler-{order}-rad", f"euler-{order}-deg") for order in sorted(moving)[::-1])


def unwrapped(
    recorded: FloatArray,
    positions: FloatArray,
    camera: FloatArray,
    mount: Mount,
    *,
    keep_turns: bool = False,
) -> tuple[tuple[str, str], FloatArray] | None:
    """Rotations before their numbers were taken for others, after the names of both forms.

    Args:
        recorded: (n, 3, 3) rotations of the flange as recorded.
        positions: (n, 3) its positions.
        camera: (n, 4, 4) `cam_from_target`.
        mount: How the camera is mounted.
        keep_turns: Whether they are too nearly right to have lost whole turns.
    """
    if len(camera) <= _CHECKED:
        return None
    turned = _turned_as_seen(positions, invert(camera) if mount == "eye-in-hand" else camera)
    best: tuple[tuple[str, str], FloatArray] | None = None
    least = np.inf
    for forms in _forms(keep_turns=keep_turns) if len(turned) else ():
        found = (_with_turns(recorded, turned, first, forms) for first in range(_WRONG + 1))
        rotations = next((each for each in found if each is not None), None)
        if rotations is None:
            continue
        # Small angles of one form are nearly those of another.
        tools = np.swapaxes(turned, 1, 2) @ rotations
        away = float(np.median(rotation_angle(tools[0].T @ tools)))
        if away < least:
            best, least = (forms, rotations), away
        # Those of the right form differ by noise.
        if least < 0.03:
            break
    return best


def in_one_place(positions: FloatArray, camera: FloatArray, mount: Mount) -> IntArray | None:
    """Chooses the rivals of a target's poses that agree with the robot's positions.

    Args:
        positions: (n, 3) positions of the flange, in any unit and order of axes.
        camera: (n, c, 4, 4) `cam_from_target` by c rivals.
        mount: How the camera is mounted.

    Returns:
        (n,) indices of the rivals; None where the positions determine none.
    """
    count, rivals = camera.shape[:2]
    if count <= _CHECKED:
        return None
    seen = invert(camera) if mount == "eye-in-hand" else camera
    rows = np.stack([_place_rows(positions, seen[:, at]) for at in range(rivals)], axis=1)
    # A turn of the target that is the same in all views stays open.
    choices = np.array([(0, *rest) for rest in product(range(rivals), repeat=_PLACING - 1)])
    rng, least, best = np.random.default_rng(0), np.inf, None
    # Random choices of the views.
    for _ in range(12):
        some = rng.choice(count, _PLACING, replace=False)
        sides = rows[some, choices].reshape(-1, 3 * _PLACING, 15), seen[some, choices, :3, 3]
        square = np.swapaxes(sides[0], 1, 2) @ sides[0]
        square += 1e-12 * np.trace(square, axis1=1, axis2=2)[:, None, None] * np.eye(15)
        across = np.swapaxes(sides[0], 1, 2) @ sides[1].reshape(len(choices), -1, 1)
        solutions = np.linalg.solve(square, across)[:, None, None]
        away = np.linalg.norm((rows @ solutions)[..., 0] - seen[:, :, :3, 3], axis=-1)
        nearest = np.median(away.min(axis=2), axis=1)
        if (at := int(nearest.argmin())) >= 0 and nearest[at] < least:
            least, best = float(nearest[at]), away[at].argmin(axis=1)
    if best is None or not len(_turned_as_seen(positions, seen[np.arange(count), best])):
        return None
    return np.asarray(best)


def _place_rows(positions: FloatArray, seen: FloatArray) -> FloatArray:
    """(n, 3, 15) rows by which places of what is seen are linear; see `_turned_as_seen`."""
    rows = np.zeros((len(seen), 3, 15))
    for axis in range(3):
        rows[:, axis, 3 * axis : 3 * axis + 3] = positions - positions.mean(axis=0)
    rows[:, :, 9:12], rows[:, :, 12:] = -np.eye(3), -seen[:, :3, :3]
    return rows


def _turned_as_seen(positions: FloatArray, seen: FloatArray) -> FloatArray:
    """(n, 3, 3) rotations of the flange, but for one of its tool, by its positions alone.

    The flange's places in what stands still with the robot are linear in its place in the tool, and
    in its turned positions. Of (n, 4, 4) poses of the camera in the target, or the other way round;
    empty where positions do not determine them.
    """
    rows = _place_rows(positions, seen)
    weights = np.ones(len(seen))
    for _ in range(10):
        sides = rows * weights[:, None, None], seen[:, :3, 3] * weights[:, None]
        solution, _, rank, _ = np.linalg.lstsq(sides[0].reshape(-1, 15), sides[1].ravel())
        if rank < 15:
            return np.zeros((0, 3, 3))
        # Least absolute distances: some views may be wrong.
        away = np.linalg.norm(rows @ solution - seen[:, :3, 3], axis=1)
        weights = 1.0 / np.sqrt(np.maximum(away, 1e-4))
    # Positions of other rows, or in other units, place nothing.
    if np.median(away) > CLOSING_SCORE * np.median(np.linalg.norm(seen[:, :3, 3], axis=1)):
        return np.zeros((0, 3, 3))
    matrices: FloatArray = np.asarray(solution[:9]).reshape(1, 3, 3)
    turn = nearest_rotation(matrices)[0].T
    return np.asarray(turn @ seen[:, :3, :3])


def _with_turns(
    recorded: FloatArray, turned: FloatArray, first: int, forms: tuple[str, str]
) -> FloatArray | None:
    """(n, 3, 3) rotations with their whole turns; None where the views show none that fit."""
    taken, written = (ROTATION_FORMS[form] for form in forms)
    others = [at for at in range(len(recorded)) if at != first][:_CHECKED]

    def agreeing(numbers: FloatArray, axes: list[int]) -> tuple[FloatArray, FloatArray]:
        """Numbers (k, 3) of the first view whose tools turn some axes as others did; the tools."""
        tools, wrong = turned[first].T @ written.read(numbers), 0
        for view in others:
            again = taken.read(written.write(turned[view] @ tools))
            alike = np.sum(again[:, :, axes] * recorded[view][:, axes], axis=(1, 2))
            # The cosine of a turn, or the trace of the rotation between both.
            near = alike > (1.0 + 2.0 * _ALIKE if len(axes) == 3 else _ALIKE)
            tools, numbers = (tools[near], numbers[near]) if near.any() else (tools, numbers)
            wrong += not near.any()
        kept = slice(0 if wrong > _WRONG else None)
        return numbers[kept], tools[kept]

    numbers = _rivals(taken.write(recorded[[first]])[0], *forms)
    if forms[1].startswith("euler-") and forms[0].startswith("euler-"):
        # The last turn leaves its own axis where it is; turns of it are those of the tool.
        axis = "XYZ".index(forms[1].split("-")[1][2])
        numbers, _ = agreeing(numbers, [axis])
        turns = np.outer(_TURN * np.arange(-29, 30), np.eye(3)[2])
        numbers = (numbers[:_CHECKED, None] + turns).reshape(-1, 3)
        numbers = numbers[np.abs(numbers[:, 2]) <= 180.0]
    numbers, tools = agreeing(numbers, [0, 1, 2]) if len(numbers) else (numbers, numbers)
    if not len(numbers):
        return None
    expected = written.write(turned @ tools[0])
    rivals = np.array([_solutions(angles, forms[0]) for angles in taken.write(recorded)])
    if forms[0] == "rotation-vector":
        angle = np.maximum(np.linalg.norm(rivals, axis=2, keepdims=True), 1e-9)
        along = np.sum(rivals * expected[:, None], axis=2, keepdims=True) / angle
        rivals = rivals / angle * (angle + _TURN * np.round((along - angle) / _TURN))
    else:
        rivals = rivals + _TURN * np.round((expected[:, None] - rivals) / _TURN)
    nearest = np.linalg.norm(rivals - expected[:, None], axis=2).argmin(axis=1)
    return written.read(rivals[np.arange(len(rivals)), nearest])


def _solutions(angles: FloatArray, taken: str) -> FloatArray:
    """(s, 3) numbers [rad] of the same rotation, but for whole turns."""
    order = taken.split("-")[1]
    if order == "vector":
        return angles[None]
    middle = -angles[1] if order[0] == order[2] else np.pi - angles[1]
    return np.array([angles, [angles[0] + np.pi, middle, angles[2] + np.pi]])


def _rivals(angles: FloatArray, taken: str, written: str) -> FloatArray:
    """(k, 3) numbers as they may have been written that are taken for the same as some [rad]."""
    half = 180.0 if written.endswith("deg") else np.pi
    turns = _TURN * np.arange(-int(half / _TURN) - 1, int(half / _TURN) + 2)
    if taken == "rotation-vector":
        size = max(float(np.linalg.norm(angles)), 1e-9)
        every = np.outer(size + turns, angles / size)
    else:
        # Turns about the last axis are turns of the tool.
        last = turns if written.startswith("rotation-vector") else np.zeros(1)
        grids = [
            np.stack(np.meshgrid(*each[:2, None] + turns, each[2] + last, indexing="ij"), axis=-1)
            for each in _solutions(angles, taken)
        ]
        every = np.concatenate(grids).reshape(-1, 3)
    if written.startswith("rotation-vector"):
        return np.asarray(every[np.linalg.norm(every, axis=1) < 1.01 * half])
    order = written.split("-")[1]
    low, high = (0.0, half) if order[0] == order[2] else (-half / 2.0, half / 2.0)
    is_one = (np.abs(every[:, ::2]) <= half).all(axis=1)
    return np.asarray(every[is_one & (low <= every[:, 1]) & (every[:, 1] <= high)])
