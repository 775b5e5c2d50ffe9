"""Refusals: cells whose sightings determine nothing, or leave a direction of a frame open."""

import numpy as np

from visioncal.core.errors import DegenerateError
from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.number_format import counted, some_of
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.estimation.observability import (
    TYPICAL_NOISE,
    TYPICAL_PX,
    Direction,
    Turning,
    edge_directions,
)
from visioncal.fit.fit import Fit
from visioncal.fit.mixed import inverse
from visioncal.model import Cell

_TILTED = (
    "Add 3 or more views in which the flange is tilted by 20 to 40 degrees about different axes, "
    "not only about one axis"
)
# Frames of a cell of one camera, one robot and one board, in words.
_WORDS = {"cam": "the camera", "target": "the target", "flange": "the tool", "base": "the base"}


def refuse_unjoined(cell: Cell, joined: Cell) -> None:
    """Refuses a cell of whose sightings nothing is left that a fit could use.

    Args:
        cell: As read.
        joined: With the sightings whose poses are known, between frames that are joined.

    Raises:
        DegenerateError: There are none.
    """
    if any(not (one.is_held or one.is_stated) for one in joined.sightings):
        return
    stops = len({one.stop for one in cell.sightings if not (one.is_held or one.is_stated)})
    frames = [_named(name) for name in cell.unknown] or ["the camera"]
    why = f"{counted(stops, 'usable stop')} of the robot, but it takes at least {FEWEST_VIEWS}"
    if cell.sightings and cell.held.all():
        why = f"all {counted(len(cell.sightings), 'view')} are held out"
    elif stops >= FEWEST_VIEWS:
        paths = [cell.tree.path(*pair) for pair in cell.pairs]
        if cell.unknown and not any(step.robot for path in paths for step in path):
            why, advice = _untied(cell.unknown[0])
            raise DegenerateError(f"cell: {why}.", culprits=frames, next_step=advice)
        moved = "; ".join(filter(None, (_motion(cell, name, name) for name in cell.arms)))
        why = f"the views are too few, too much alike, or wrong{f' ({moved})' if moved else ''}"
    raise DegenerateError(
        f"cell: {why}; {some_of(frames)} {'is' if len(frames) == 1 else 'are'} not determined: it "
        "takes two different axes of rotation between views.",
        culprits=frames,
        next_step=f"{_TILTED}.",
    )


def refuse_open(fit: Fit) -> None:
    """Refuses sightings that leave a direction of a frame open, whatever noise they show.

    The motion is judged by its geometry at a typical noise, with lenses and boards as they are;
    together with these, no direction may be open.

    Raises:
        DegenerateError: The predicted sigma of a direction is over the limit.
    """
    typical = dict(zip(("rad", "m"), TYPICAL_NOISE.robots[0].tolist(), strict=True))
    at = [size.name.partition(" ") for size in fit.unknowns.sizes]
    flanges = np.array([unit in typical and name in fit.unknowns.erring for unit, _, name in at])
    corners = np.array([unit in ("px", "view") for unit, *_ in at], bool)
    level = np.log([typical.get(unit, TYPICAL_PX) for unit, *_ in at])
    least = np.minimum(fit.estimate.logs, level)
    logs = np.where(flanges, level, np.where(corners, least, fit.estimate.logs))
    _refuse(fit, _of_edges(fit, logs), by_motion=True)
    logs = np.where(flanges | corners, least, fit.estimate.logs)
    _refuse(fit, fit.mixed.at(logs, is_sloped=False).covariance, by_motion=False)


def _of_edges(fit: Fit, logs: FloatArray) -> FloatArray:
    """Covariance (p, p) of edges at some sizes, all else as it is."""
    units, common = fit.mixed.assembled(logs)
    p = fit.unknowns.count
    for body, (errors, cross) in zip(fit.mixed.bodies, units, strict=True):
        at, solved = np.append(body.columns, p), np.linalg.solve(errors, cross)
        common[at[:, None], at] -= np.tensordot(cross, solved, ((0, 1), (0, 1)))
    edges = [fit.unknowns.columns("edge", name) for name in fit.cell.unknown]
    at, covariance = np.concatenate([np.zeros(0, int), *edges]), np.zeros((p, p))
    covariance[at[:, None], at], _ = inverse(common[at[:, None], at])
    return covariance


def _refuse(fit: Fit, covariance: FloatArray, *, by_motion: bool) -> None:
    """Refuses directions beyond the limit by a covariance (p, p), by the first of them."""
    beyond = list[tuple[str, Direction]]()
    for name in fit.cell.unknown:
        at = fit.unknowns.columns("edge", name)
        parent = _named(fit.cell.tree.branches[name].parent)
        found = edge_directions(fit.edge(name), covariance[at[:, None], at], _named(name), parent)
        beyond += [(name, one) for one in found if one.sigma > one.limit]
    if not by_motion:
        beyond = [(name, one) for name, one in beyond if one.is_open]
    if not beyond:
        return
    frame, worst = beyond[0]
    why = "the views do not determine lens and board well enough"
    advice = (
        "Give matrix and distortion in [camera], state the board's size with its sigma, or add "
        "views tilted by 30 to 45 degrees."
    )
    if by_motion:
        parent = fit.cell.tree.branches[frame].parent
        arms = [name for name in fit.unknowns.erring if name in _frames_with(fit.cell, frame)]
        # Of what is known poorly, more motion makes it better.
        words = (_motion(fit.cell, name, parent, is_any=not worst.is_open) for name in arms[:1])
        why = "".join(words)
        advice = f"{_TILTED} of {_named(parent)}."
        if not why:
            why, advice = _untied(frame)
    raise DegenerateError(
        f"cell: {worst.words} {worst.fault(' at a typical noise')}: {why}.",
        culprits=[one.words for _, one in beyond],
        next_step=advice,
    )


def _untied(frame: str) -> tuple[str, str]:
    """Words about a frame that no sighting ties to the rest, and advice."""
    return (
        f"nothing ties {_named(frame)} to what is known of the cell",
        f"Let a camera see a board, one of both on {frame} or what it carries, the other one tied, "
        "at 5 stops or more; or state where it is: [prior].",
    )


def _frames_with(cell: Cell, frame: str) -> set[str]:
    """Frames on the paths of sightings that pass a frame."""
    paths = [{step.frame for step in cell.tree.path(*pair)} for pair in cell.pairs]
    return set[str]().union(*(path for path in paths if frame in path))


def _motion(cell: Cell, flange: str, frame: str, *, is_any: bool = False) -> str:
    """The fault of the motion of an arm, in a frame; nothing of a turn about two axes.

    If `is_any`, that is said, too.
    """
    used = {one.stop for one in cell.sightings if not one.is_held}
    poses = cell.arms[flange].poses[sorted(used)]
    poses = poses[np.isfinite(poses[:, 0, 0])]
    if len(poses) < 2:
        return f"{_named(flange)} was seen at {counted(len(poses), 'stop')}"
    turning = Turning.of(poses if frame == flange else invert(poses))
    words = turning.words(poses, counted(len(poses), "used stop"), _named(frame))
    return "" if turning.is_enough and not is_any else words


def _named(frame: str) -> str:
    """A frame in words."""
    return _WORDS.get(frame, frame)
