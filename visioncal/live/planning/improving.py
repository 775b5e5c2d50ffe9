"""The next best stops of a recorded session, and what each of them is good for, in words."""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.number_format import figure
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.estimation.armmodel import block_size
from visioncal.live.planning.accuracy import OPEN_SIGMA, Accuracy
from visioncal.live.planning.cell import PlanCell
from visioncal.live.planning.design import Design
from visioncal.live.planning.information import World
from visioncal.live.planning.purposes import Purpose
from visioncal.live.planning.recorded import Begun
from visioncal.robot import Robot

# A direction this close to the optical axis is called by it; another axis is named besides where
# the direction has this share of it.
_NEARLY_AXIS, _ASIDE = 0.95, 0.4
# Smaller turns from a stop that is there are no new direction [rad].
_TURN_RAD = 0.17
# What takes less than a hundredth off an error gets no figure.
_LITTLE_SHARE = 0.99
# What a rotation counts beside an offset: its effect at this distance [m].
_LEVER_M = 0.5


def helps(
    cell: PlanCell,
    purpose: Purpose,
    q: FloatArray,
    world: World,
    design: Design,
    names: Sequence[str],
    *,
    begun: Begun | None = None,
) -> Iterator[str]:
    """Says what each chosen stop is good for, those before it being taken.

    Args:
        cell: The cell as it is guessed to be.
        purpose: What the stops are for.
        q: (k, n) joint angles of the candidates [rad].
        world: The candidates' information if the guesses are right.
        design: Which of them are chosen.
        names: What to call the chosen ones, in their order.
        begun: What was recorded already; None for nothing.
    """
    there, known = np.zeros((0, 4, 4)), []
    if begun is not None:
        there = next(iter(begun.recorded.problem.poses.values()))
        known = [f"view {view}" for view in begun.views]
    poses = cell.robot.base_from_flange(q[design.rows])
    before = world.covariance([])
    for place in range(len(design.rows)):
        after = world.covariance(design.rows[: place + 1])
        motion = _motion(cell, there, poses[place], known)
        effect = _effect(cell, purpose, before, after, design.history[place : place + 2])
        yield f"{motion}: {effect}"
        there = np.concatenate([there, poses[place][None]])
        known = [*known, names[place]]
        before = after


def _motion(cell: PlanCell, there: FloatArray, pose: FloatArray, names: Sequence[str]) -> str:
    """How a stop differs from the one whose direction is nearest."""
    if not len(there):
        return "begin here"
    turns = Rotation.from_matrix((invert(there) @ pose)[:, :3, :3]).as_rotvec()
    angles = np.linalg.norm(turns, axis=1)
    nearest = int(np.argmin(angles))
    if angles[nearest] < _TURN_RAD:
        shift = 1e2 * float(np.linalg.norm(pose[:3, 3] - there[nearest, :3, 3]))
        return f"shift by {shift:.0f} cm from {names[nearest]}"
    axis = turns[nearest] / angles[nearest]
    degrees = f"by {np.rad2deg(angles[nearest]):.0f} deg from {names[nearest]}"
    flange_from_cam = cell.x
    if cell.mount == "eye-to-hand":
        flange_from_cam = invert(there[nearest]) @ cell.x
    if abs(axis @ flange_from_cam[:3, 2]) > _NEARLY_AXIS:
        return f"turn about the optical axis {degrees}"
    verb = "turn" if abs(axis[2]) > np.linalg.norm(axis[:2]) else "tilt"
    return f"{verb} about the tool's {_axes(axis)} {degrees}"


def _effect(
    cell: PlanCell,
    purpose: Purpose,
    before: FloatArray,
    after: FloatArray,
    history: Sequence[Accuracy],
) -> str:
    """What a stop helps: `history` is the accuracy without it and with it."""
    if purpose.judged == "sight":
        return _edge_effect(before, after)
    then, now = (1e-3 * accuracy.mm for accuracy in history)
    joint = _joint_determined(cell.robot, purpose, np.diag(before - after))
    change = _change("the error over the workspace", then, now, is_rotation=False)
    return f"{change}; most information on {joint}"


def _joint_determined(robot: Robot, purpose: Purpose, drops: FloatArray) -> str:
    """Which joint's errors (p,) lessened variances are of."""
    count = robot.joint_count
    by_joint, left = np.zeros(count), drops
    for name in reversed(tuple(purpose.blocks)):
        left, block = np.split(left, [len(left) - block_size(name, count)])
        # Links have six values each, one after the other; of functions, each joint has one.
        whole = block.reshape(count, -1) if name == "links" else block.reshape(-1, count).T
        by_joint += whole.sum(axis=1)
    return robot.joint_names[int(np.argmax(by_joint))]


def _edge_effect(before: FloatArray, after: FloatArray) -> str:
    """The component of x that a stop helps most, along or about the camera's axes."""
    drops = np.diag(before - after)[:6] * np.repeat([_LEVER_M**2, 1.0], 3)
    at = int(np.argmax(drops))
    axis = ("the image's x", "the image's y", "the optical axis")[at % 3]
    words = f"the error {'about' if at < 3 else 'along'} {axis}"
    then, now = (float(np.sqrt(array[at, at])) for array in (before, after))
    return _change(words, then, now, is_rotation=at < 3)


def _change(what: str, then: float, now: float, *, is_rotation: bool) -> str:
    """Says how a sigma [m or rad] falls."""
    unit, scale = ("deg", float(np.rad2deg(1.0))) if is_rotation else ("mm", 1e3)
    if now > OPEN_SIGMA:
        return f"a beginning; {what} is not determined yet"
    if then > OPEN_SIGMA:
        return f"determines what was open; {what} is now {figure(now * scale)} {unit}"
    figures = f"({figure(then * scale)} -> {figure(now * scale)} {unit})"
    share = now / then
    if share > _LITTLE_SHARE:
        return f"takes little off {what} {figures}"
    if share > 0.72:
        return f"takes {100 * (1 - share):.0f} % off {what} {figures}"
    for least, verb in (
        (0.58, "takes a third off {}"),
        (0.42, "halves {}"),
        (0.28, "cuts {} to a third"),
        (0.2, "cuts {} to a quarter"),
    ):
        if share > least:
            return f"{verb.format(what)} {figures}"
    return f"cuts {what} {1 / share:.0f}-fold {figures}"


def _axes(axis: FloatArray) -> str:
    """Names a unit vector by one axis, or by the two that it lies between."""
    first, second = np.argsort(-np.abs(axis))[:2].tolist()
    return "xyz"[first] + (f" and {'xyz'[second]}" if abs(axis[second]) > _ASIDE else "")
