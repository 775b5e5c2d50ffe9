"""Fits a cell: from its sightings to edges, lenses, boards, sizes and covariance."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, Mask
from visioncal.fit.candidates import opened
from visioncal.fit.fit import Fit, LeftOut
from visioncal.fit.processes import boards_of, consider
from visioncal.fit.search import Effort, Search, nearest
from visioncal.fit.start import Start, start_of
from visioncal.fit.unknowns import (
    Edge,
    Key,
    State,
    Unknown,
    Unknowns,
    estimated_lens,
    flange_noise,
    given_lens,
    printed_board,
    random_effect,
)
from visioncal.model import Cell, MeasuredPlace, MeasuredPose
from visioncal.model.boards import SHAPES
from visioncal.model.effects import Effect, Links, Size
from visioncal.vision.camera import intrinsics

# Numbers of corners for each unknown of lenses and boards, below which these are held.
_SPARE = 10
# Stops that determine errors of an arm's links.
_FEWEST_STOPS = 8
# Log-odds of boards of another size that free it.
_CLEAR = 7.0
# Most effects that are opened, one after the other.
_OPENED = 5


@dataclass(frozen=True, eq=False)
class Solved:
    """The fit of a cell."""

    fit: Fit
    left_out: LeftOut
    start: Start
    effort: Effort

    @property
    def used(self) -> Mask:
        """(n,) sightings of `start.cell` that agree."""
        return self.fit.used


def solve(cell: Cell) -> Solved:
    """Fits a cell."""
    start = start_of(cell)
    effects = effects_of(start.cell)
    search = Search.of(start.cell, unknowns_of(start, effects), start.sound)
    fit, left_out = search.run(state_of(start, effects), nearest(start))
    for _ in range(_OPENED):
        wider = opened(fit, search.pairs)
        if wider is None:
            break
        search = search.with_unknowns(wider[0])
        fit, left_out = search.run(wider[1], fit.used, fit)
    again = search.weighed(fit)
    if again is not None:
        search = again
        fit, left_out = search.run(fit.state, fit.used, fit)
    bare = [name for name in fit.unknowns.erring if not start.cell.arms[name].has_joints]
    found = {name: consider(fit, name) for name in bare}
    if any(one is not None and one.board_odds > _CLEAR for one in found.values()):
        # Boards of another size, which no error of an arm's posture explains.
        search = search.with_unknowns(with_free_boards(fit))
        fit, left_out = search.run(fit.state, fit.used, fit)
        found = {name: consider(fit, name) for name in bare}
    for one in found.values():
        fit = fit if one is None else fit.considering(one.covariance)
    return Solved(fit, left_out, start, search.effort)


def with_free_boards(fit: Fit) -> Unknowns:
    """The unknowns of a fit, with the sizes of boards that are held freed."""
    freed = []
    for key in boards_of(fit):
        member, board = fit.unknowns[key], fit.cell.boards[key[1]]
        has_shape = member.count > 1
        freed.append(printed_board(key[1], board, has_shape=has_shape, is_sized=True))
    return fit.unknowns.replacing(*freed)


def effects_of(cell: Cell) -> tuple[Effect, ...]:
    """Effects that are always among the unknowns: links of arms with joint angles."""
    if len({sighting.stop for sighting in cell.sightings}) < _FEWEST_STOPS:
        return ()
    return tuple(
        Links(name, arm.model)
        for name, arm in cell.arms.items()
        if arm.has_joints and arm.model is not None
    )


def state_of(start: Start, effects: Sequence[Effect]) -> State:
    """The state at a start: nothing errs, lenses and boards are as stated or found."""
    values: dict[Key, FloatArray] = {("edge", name): matrix for name, matrix in start.edges.items()}
    values |= {("lens", name): intrinsics(lens) for name, lens in start.lenses.items()}
    values |= {("shape", name): np.zeros(SHAPES) for name in start.cell.boards}
    values |= {("effect", effect.name): np.zeros(effect.count) for effect in effects}
    stops = len(start.cell.moments)
    return State(values, {name: np.zeros((stops, 6)) for name in start.cell.arms})


def unknowns_of(start: Start, effects: Sequence[Effect]) -> Unknowns:
    """What is estimated of a cell."""
    cell = start.cell
    members: list[Unknown] = [Edge(("edge", name)) for name in cell.unknown]
    corners = sum(2 * len(s.corners.ids) - 6 for s in cell.sightings if s.corners is not None)
    sought = sum(len(intrinsics(lens)) + SHAPES for lens in start.lenses.values())
    has_shape = corners >= _SPARE * sought
    for name, lens in start.lenses.items():
        if cell.cameras[name].stated is None:
            members.append(estimated_lens(name, lens))
        elif has_shape:
            members.append(given_lens(name, lens, _corners_px(cell, name)))
    # Errors of an arm without joints follow its posture, and look like a board's size.
    is_sized = all(arm.has_joints for arm in cell.arms.values())
    seen = {s.seen for s in cell.sightings if s.corners is not None}
    for name, board in cell.boards.items():
        if name in seen and not board.is_rig and cell.arms:
            members.append(printed_board(name, board, has_shape=has_shape, is_sized=is_sized))
    members += [random_effect(effect) for effect in effects]
    erring = _erring(cell)
    noise, ratios = list(flange_noise(erring)), [(f"rad {name}", f"m {name}") for name in erring]
    for name in start.lenses:
        own = [s.corners for s in cell.sightings if s.seer == name and s.corners is not None]
        if any(corners.stated_px is None for corners in own):
            noise.append(Size(f"px {name}", 0.3, 1e-4, 30.0))
    for name in _measuring(cell):
        noise += [Size(f"rad {name}", 3e-3, 1e-8, 0.3), Size(f"m {name}", 2e-3, 1e-8, 0.3)]
        ratios.append((f"rad {name}", f"m {name}"))
    return Unknowns(
        tuple(members), tuple(effects), start.lenses, erring, tuple(noise), ratios=tuple(ratios)
    )


def _measuring(cell: Cell) -> list[str]:
    """Frames from which poses and places of unknown noise were measured."""
    found = {
        s.seer
        for s in cell.sightings
        if (isinstance(s.evidence, MeasuredPose) and s.evidence.sigmas is None)
        or (isinstance(s.evidence, MeasuredPlace) and s.evidence.sigma_m is None)
    }
    return sorted(found)


def _erring(cell: Cell) -> tuple[str, ...]:
    """Flanges that err, unless nothing tells their errors from those of measured poses."""
    stops = {sighting.stop for sighting in cell.sightings}
    if _measuring(cell) and len(cell.sightings) == len(stops):
        return ()
    passed = {step.robot for pair in cell.pairs for step in cell.tree.path(*pair)}
    return tuple(name for name in cell.arms if name in passed)


def _corners_px(cell: Cell, camera: str) -> FloatArray:
    """(n, 2) all corners that a camera saw."""
    return np.concatenate(
        [s.corners.px for s in cell.sightings if s.seer == camera and s.corners is not None]
    )
