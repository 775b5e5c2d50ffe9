"""Fits a cell: from its sightings to edges, lenses, boards, sizes and covariance."""

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from visioncal.core.transforms import LEVER_M
from visioncal.core.types import FloatArray, Mask
from visioncal.fit.candidates import candidates, moved_instead, of_stops, opened
from visioncal.fit.fit import Fit, LeftOut
from visioncal.fit.held import with_held_boards, with_held_lenses, with_small_sizes
from visioncal.fit.inliers import Effort, Search, nearest
from visioncal.fit.processes import ENOUGH_STOPS, Considered, consider, held_boards
from visioncal.fit.refuse import refuse_open, refuse_unjoined
from visioncal.fit.start import Start, at_rest, start_of
from visioncal.fit.unknowns import (
    Edge,
    Key,
    Prior,
    State,
    Unknown,
    Unknowns,
    estimated_lens,
    flange_noise,
    given_lens,
    printed_board,
    random_effect,
)
from visioncal.model import Cell, MeasuredPlace, MeasuredPose, Sighting
from visioncal.model.boards import SHAPES, shape_count
from visioncal.model.effects import Clock, Effect, LensSteps, Links, Rolling, Size, Zeros
from visioncal.vision.camera import intrinsics


@dataclass(frozen=True, eq=False)
class CellFit:
    """The fit of a cell, with the sightings and doubts behind it."""

    fit: Fit
    left_out: LeftOut
    start: Start
    effort: Effort
    doubts: Sequence[Considered] = ()  # Errors of arms without joint angles, and of held boards.

    @property
    def used(self) -> Mask:
        """(n,) sightings of `start.cell` that agree."""
        return self.fit.used


def solve(cell: Cell) -> CellFit:
    """Fits a cell; raises what `start_of` and `solve_from` raise."""
    return solve_from(start_of(cell))


@at_rest()
def solve_from(start: Start) -> CellFit:
    """Fits a cell from a start.

    Raises:
        DegenerateError: The sightings leave a direction of a frame open.
        ConvergenceError: The estimate does not come to rest.
    """
    refuse_unjoined(start.read, start.cell)
    effects = effects_of(start)
    search = Search.of(start.cell, unknowns_of(start, effects), start.sound)
    fit, left_out = search.run(state_of(start, effects), nearest(start))
    refuse_open(fit)
    search, fit, left_out = _explained(search, fit, left_out)
    # Most effects that are opened, one after the other.
    for _ in range(5):
        wider = _opened_next(search, fit)
        if wider is None:
            break
        search, fit, left_out = wider
    again = search.weighed(fit)
    if again is not None:
        search = again
        fit, left_out = search.run(fit.state, fit.used, fit)
    held = with_held_sizes(fit)
    if held is not None:
        # No stop tells a board of another size from an arm of other lengths.
        search = search.with_unknowns(held)
        fit, left_out = search.run(fit.state, fit.used, fit)
    found = {name: consider(fit, name) for name in fit.unknowns.erring}
    # Log-odds of boards of another size that free it.
    if any(one is not None and one.board_odds > 7.0 for one in found.values()):
        # Boards of another size, which no error of an arm's posture explains.
        search = search.with_unknowns(with_free_boards(fit))
        fit, left_out = search.run(fit.state, fit.used, fit)
        found = {name: consider(fit, name) for name in fit.unknowns.erring}
    for one in found.values():
        fit = fit if one is None else fit.considering(one.covariance, one.shift)
    doubts = [one for one in found.values() if one is not None]
    fit = with_held_lenses(with_held_boards(with_small_sizes(fit), doubts))
    return CellFit(fit, left_out, start, search.effort, doubts)


def _opened_next(search: Search, fit: Fit) -> tuple[Search, Fit, LeftOut] | None:
    """A fit with the effect that explains most; None where none is clear."""
    among = [*candidates(fit, search.pairs)]
    for some in (among, [one for one in among if not isinstance(one.effect, LensSteps)]):
        wider = opened(fit, search.pairs, some)
        if wider is None:
            return None
        other = search.with_unknowns(wider[0])
        found, left_out = other.run(wider[1], fit.used, fit)
        if not _is_moved(search, fit, found):
            break
    return other, found, left_out


def _explained(search: Search, fit: Fit, left_out: LeftOut) -> tuple[Search, Fit, LeftOut]:
    """A fit, or that with an effect of arm or lens by which most of many agree that did not.

    Play has one of two values at each stop, and neither half of these shows it; nor do the views
    before and after a lens was zoomed, or an arm went over to another posture with its links'
    errors; and nearly any half of few agrees with another board's size.
    """
    lost = int((search.sound & ~fit.used).sum())
    if lost <= search.sound.sum() / 10:
        return search, fit, left_out
    whole = search.with_all(fit)
    links = [effect.name for effect in search.unknowns.effects if isinstance(effect, Links)]
    wider = [opened(whole, search.pairs, of_stops(whole, search.pairs))]
    tried = [(*one, whole) for one in wider if one is not None]
    if held_boards(fit):
        # By the noise of all, which another size inflates, or of those that agree without it.
        tried += [(with_free_boards(fit), fit.state, known) for known in (whole, fit)]
    for unknowns, state, known in (*[(search.unknowns, fit.state, None)] * bool(links), *tried):
        other = search.with_unknowns(unknowns)
        try:
            found, left = other.run(state, search.sound, known)
        except np.linalg.LinAlgError:
            # A trial that does not come to rest explains nothing.
            continue
        # With more noise anything agrees, and with links that are far off.
        before, after = _levels(fit), _levels(found)
        is_noise = any(after[name] > 2.0 * level for name, level in before.items())
        # Errors of links that arms have at most, a joint [rad], [m / 0.5]: two millimetres of all
        # joints.
        is_noise |= known is None and any(found.sizes[name] > 1e-3 for name in links)
        if not is_noise and (search.sound & ~found.used).sum() < lost / 2:
            if known is not None and _is_moved(search, known, found):
                continue
            return other, found, left
    return search, fit, left_out


def _levels(fit: Fit) -> dict[str, float]:
    """Levels of noise by name, of turns and shifts as one: few stops determine either alone."""
    levels = {size.name: fit.sizes[size.name] for size in fit.unknowns.noise}
    for frame in fit.unknowns.erring:
        turn = LEVER_M * levels.pop(f"rad {frame}")
        levels[f"m {frame}"] = float(np.hypot(levels[f"m {frame}"], turn))
    return levels


def _is_moved(search: Search, before: Fit, found: Fit) -> bool:
    """Whether a move at once explains the sightings better than a lens that changed then.

    `before` is the fit without either.
    """
    known = {effect.name for effect in before.unknowns.effects}
    new = [effect for effect in found.unknowns.effects if effect.name not in known]
    zooms = [effect for effect in new if isinstance(effect, LensSteps)]
    for move in chain.from_iterable(moved_instead(before, zoom) for zoom in zooms):
        if move.name in known:
            continue
        member = random_effect(move)
        unknowns = before.unknowns.with_members(member)
        unknowns = replace(unknowns, effects=(*unknowns.effects, move))
        values = {**before.state.values, member.key: np.zeros(member.count)}
        with suppress(np.linalg.LinAlgError):
            start = State(values, before.state.errors)
            moved, _ = search.with_unknowns(unknowns).run(start, before.used, before)
            # Values of other sightings are of another scale.
            more = int(moved.used.sum()) - int(found.used.sum())
            if more > 0 or (more == 0 and moved.estimate.value < found.estimate.value):
                return True
    return False


def with_held_sizes(fit: Fit) -> Unknowns | None:
    """The unknowns of a fit with boards held whose sizes chance explains; None for no others.

    Errors of links are confounded with a board's size.
    """
    if fit.unknowns.closed.issuperset(f"links {name}" for name in fit.cell.arms):
        return None
    held = []
    for name, board in fit.cell.boards.items():
        if ("shape", name) in fit.unknowns and f"scale {name}" in fit.unknowns.closed:
            has_shape = fit.unknowns["shape", name].count > 1
            held.append(printed_board(name, board, has_shape=has_shape, is_sized=False))
    return fit.unknowns.with_members(*held) if held else None


def with_free_boards(fit: Fit) -> Unknowns:
    """The unknowns of a fit, with the sizes of boards that are held freed."""
    freed = []
    for key in held_boards(fit):
        board, has_shape = fit.cell.boards.get(key[1]), fit.unknowns[key].count > 1
        freed.append(printed_board(key[1], board, has_shape=has_shape, is_sized=True))
    return fit.unknowns.with_members(*freed)


def effects_of(start: Start) -> tuple[Effect, ...]:
    """Effects that are always among the unknowns: of motion, and of arms with joint angles.

    Corners of a rolling shutter are off by pixels, which much else would explain without it. Zeros
    have a size of their own: in that of all errors of links, they are outliers.
    """
    cell, found = start.cell, list[Effect]()
    found += (Clock(sweep.flange, sweep.camera, sweep.sigma_s) for sweep in cell.sweeps)
    for camera in dict.fromkeys(sweep.camera for sweep in cell.sweeps):
        if camera in start.lenses:
            found.append(Rolling(camera, start.lenses[camera].resolution[1]))
    if len({sighting.stop for sighting in cell.sightings}) >= ENOUGH_STOPS:
        for name, arm in cell.arms.items():
            if arm.has_joints and arm.model is not None:
                found += (Links(name, arm.model), Zeros(name, arm.model))
    return tuple(found)


def state_of(start: Start, effects: Sequence[Effect]) -> State:
    """The state at a start: nothing errs, lenses and boards are as stated or found."""
    values: dict[Key, FloatArray] = {("edge", name): matrix for name, matrix in start.edges.items()}
    values |= {("lens", name): intrinsics(lens) for name, lens in start.lenses.items()}
    boards = {*start.cell.boards, *(s.seen for s in start.cell.sightings if _is_of_board(s))}
    values |= {
        ("shape", name): np.zeros(shape_count(start.cell.boards.get(name))) for name in boards
    }
    values |= {("effect", effect.name): np.zeros(effect.count) for effect in effects}
    stops = len(start.cell.moments)
    return State(values, {name: np.zeros((stops, 6)) for name in start.cell.arms})


def unknowns_of(start: Start, effects: Sequence[Effect]) -> Unknowns:
    """The unknowns of a cell."""
    cell = start.cell
    # The turn of a frame of which places alone are known is a convention: it is held.
    held = (Prior(np.arange(3), sigma=1e-9),)
    points = _points(cell)
    members: list[Unknown] = [
        Edge(("edge", name), held if name in points else ()) for name in cell.unknown
    ]
    corners = sum(2 * len(s.corners.ids) - 6 for s in cell.sightings if s.corners is not None)
    sought = sum(len(intrinsics(lens)) + SHAPES for lens in start.lenses.values())
    # Numbers of corners for each unknown of lenses and boards, below which these are held.
    has_shape = corners >= 10 * sought
    for name, lens in start.lenses.items():
        table = cell.cameras[name]
        if table.stated is None:
            members.append(estimated_lens(name, lens))
        elif table.intrinsics != "hold":
            given = given_lens(table, name, _corners_px(cell, name), is_spare=has_shape)
            members += [] if given is None else [given]
    # Errors of an arm without joints follow its posture: they are confounded with a board's size.
    is_sized = all(arm.has_joints for arm in cell.arms.values())
    pictured = {s.seen for s in cell.sightings if s.corners is not None}
    for name in dict.fromkeys(
        s.seen for s in cell.sightings if s.seen in pictured or _is_of_board(s)
    ):
        board = cell.boards.get(name)
        if cell.arms and (board is None or not board.is_rig):
            shaped = has_shape and name in pictured
            members.append(printed_board(name, board, has_shape=shaped, is_sized=is_sized))
    members += [random_effect(effect) for effect in effects]
    passed = {step.robot for pair in cell.pairs for step in cell.tree.path(*pair)}
    erring = tuple(name for name in cell.arms if name in passed)
    noise, ratios = list(flange_noise(erring)), [(f"rad {name}", f"m {name}") for name in erring]
    compared = _compared(cell)
    for name in start.lenses:
        corner_sets = [
            s.corners for s in cell.sightings if s.seer == name and s.corners is not None
        ]
        if any(corners.stated_px is None for corners in corner_sets):
            noise.append(Size(f"px {name}", 0.3, 1e-4, 30.0))
            if name in compared:
                noise.append(Size(f"view {name}", 0.3, 1e-4, 30.0))
                ratios.append((f"px {name}", f"view {name}"))
    for name, is_board in _measuring(cell).items():
        parts = ("rad", "m", "roll", "depth") if is_board else ("rad", "m")
        noise += [Size(f"{part} {name}", 3e-3, 1e-8, 0.3) for part in parts]
        pairs = (("rad", "m"), ("rad", "roll"), ("m", "depth")) if is_board else (("rad", "m"),)
        ratios += [(f"{a} {name}", f"{b} {name}") for a, b in pairs]
    return Unknowns(
        tuple(members), tuple(effects), start.lenses, erring, tuple(noise), ratios=tuple(ratios)
    )


def _is_of_board(sighting: Sighting) -> bool:
    """Whether it is a pose that a program found by an image of a board."""
    return isinstance(sighting.evidence, MeasuredPose) and sighting.evidence.is_of_board


def _points(cell: Cell) -> set[str]:
    """Frames of which places alone are seen, or the touch of another one at their own."""
    points, frames = set[str](), set[str]()
    # Stated frames are no points.
    for sighting in (one for one in cell.sightings if not one.is_stated):
        place = sighting.evidence
        if isinstance(place, MeasuredPlace):
            points.add(sighting.seen)
            (frames if place.place_m.any() else points).add(sighting.seer)
        else:
            frames.update(sighting.pair)
    return points - frames


def _measuring(cell: Cell) -> dict[str, bool]:
    """Frames from which poses and places of unknown noise were measured: whether by images."""
    found = dict[str, bool]()
    for sighting in cell.sightings:
        evidence = sighting.evidence
        if isinstance(evidence, MeasuredPose) and None in evidence.sigmas:
            found[sighting.seer] = evidence.is_of_board
        elif isinstance(evidence, MeasuredPlace) and evidence.sigma_m is None:
            found[sighting.seer] = False
    return found


def _compared(cell: Cell) -> set[str]:
    """Cameras whose poses of boards can be compared with others at enough stops.

    Errors that mounts, exposure and lens add to a pose, beside the corners' noise, are no
    errors of the arm there: they have a size of their own.
    """
    seers: dict[int, list[str]] = {}
    for sighting in cell.sightings:
        if sighting.corners is not None:
            seers.setdefault(sighting.stop, []).append(sighting.seer)
    stop_counts = Counter(name for names in seers.values() if len(names) > 1 for name in set(names))
    return {name for name, count in stop_counts.items() if count >= ENOUGH_STOPS}


def _corners_px(cell: Cell, camera: str) -> FloatArray:
    """(n, 2) all corners that a camera saw."""
    return np.concatenate(
        [s.corners.px for s in cell.sightings if s.seer == camera and s.corners is not None]
    )
