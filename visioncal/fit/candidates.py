"""Effects beside noise: opened one at a time, where the score of a fit without it is clear."""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from visioncal.core.limits import CheckLimits
from visioncal.core.types import IntArray, evenly
from visioncal.fit import processes
from visioncal.fit.assemble import mixed_model
from visioncal.fit.fit import Fit
from visioncal.fit.lens_field import Field
from visioncal.fit.linearise import linearised, predicted
from visioncal.fit.pairs import Pair, images_of
from visioncal.fit.score import added_by, best_displacement, best_field, of_effect, of_rows
from visioncal.fit.sizes import most_likely
from visioncal.fit.unknowns import State, Unknowns, Vector, given_lens, lens_field, random_effect
from visioncal.model import MeasuredPose
from visioncal.model.effects import (
    NAMED,
    SIGNIFICANT,
    BaseCreeps,
    BaseSteps,
    BoardSags,
    BoardSwells,
    Breathing,
    Creeps,
    Effect,
    FocusJitter,
    FrameCreeps,
    Heat,
    JointsCreep,
    JointsStep,
    LensChanges,
    LensGrows,
    LensSteps,
    MountSteps,
    Play,
    RowMotion,
    SightSteps,
    Springs,
    Stood,
    Weight,
    Window,
)
from visioncal.vision.targets import corner_positions

# Log-likelihood ratio by which a rival is as good as ruled out.
_RULED_OUT = float(np.log(CheckLimits.ruled_out))
# Most stops after which a frame may have been moved, and a lens.
_STEPS, _ZOOMS = 12, 60
# Most stops at which images may move while they are read, of four unknowns each, and what counts
# between their first row and their last [px]: below, other errors of images look so; and its size
# at most, over that which each image shows by itself.
_MOVING, _LEAST_PX, _SHOWN = 120, 0.1, 3.0


@dataclass(frozen=True, eq=False)
class Candidate:
    """Something that may be opened."""

    gain: float  # Of the log-likelihood, at its most likely size.
    member: Vector  # Its unknowns, whose size starts there.
    effect: Effect | None = None
    field: Field | None = None  # Beside a lens that is as stated.
    # The same at its estimate, with nothing off for the number of its values.
    explained: float = np.nan

    @property
    def limit(self) -> float:
        """The least likelihood ratio by which the candidate is opened."""
        return SIGNIFICANT if self.effect is None else self.effect.size.limit

    @property
    def name(self) -> str:
        """The name of the candidate's effect; empty without one."""
        return "" if self.effect is None else self.effect.name

    @property
    def lens(self) -> str:
        """The camera about whose lens alone it is; empty of others."""
        if self.effect is None:
            return self.member.key[1]
        return self.effect.frame if self.effect.place == "lens" else ""


def opened(
    fit: Fit, pairs: Sequence[Pair], among: Iterable[Candidate]
) -> tuple[Unknowns, State] | None:
    """Unknowns with the candidate that explains most, and their state; None where none is clear.

    With one of a lens come those of other lenses, one each: they explain other images.
    """
    clear = [one for one in among if 2.0 * one.gain >= one.limit]
    if not clear:
        return None
    clear.sort(key=lambda one: -one.gain)
    found = {clear[0].lens: clear[0]}
    for one in clear[1:]:
        if clear[0].lens and one.lens:
            found.setdefault(one.lens, one)
    unknowns, values = fit.unknowns, dict(fit.state.values)
    for one in found.values():
        unknowns = unknowns.with_members(one.member)
        values[one.member.key] = np.zeros(one.member.count)
        if one.effect is not None:
            kind, known, rivals = one.effect.kind, unknowns.rivals, set[str]()
            # An effect may be the rest of one whose rival it was.
            rivals.update(*({first, *kinds} for first, kinds in known.items() if kind in kinds))
            rivals |= {
                other.effect.kind
                for other in clear
                if other.effect is not None
                and other.lens in ("", one.lens)
                and (
                    other.gain > one.gain - _RULED_OUT
                    or other.explained > one.explained - _RULED_OUT
                )
            }
            rivals -= {kind, one.effect.wider}
            unknowns = replace(
                unknowns,
                effects=(*unknowns.effects, one.effect),
                rivals={**known, kind: frozenset(rivals | known.get(kind, set()))},
            )
        if one.field is not None:
            field, table = one.field, fit.cell.cameras[one.lens]
            px = np.concatenate([pair.px for pair in images_of(pairs, one.lens)])
            if table.stated is None:
                field = field.orthogonal_to(unknowns.lenses[one.lens], px)
            elif table.intrinsics == "auto":
                # A field may stand for parameters that were held since corners were few.
                given = given_lens(table, one.lens, px, is_spare=True)
                unknowns = unknowns.with_members(*([] if given is None else [given]))
            unknowns = replace(unknowns, fields={**unknowns.fields, one.lens: field})
    return unknowns, State(values, fit.state.errors)


def candidates(fit: Fit, pairs: Sequence[Pair]) -> Iterator[Candidate]:
    """All candidates that are not open yet, with their scores."""
    seen = [camera for camera in fit.unknowns.lenses if images_of(pairs, camera)]
    growing = (*effects_of_lenses(fit), *map(BoardSwells, seen))
    yield from beside_zooms(fit, scored(fit, growing, sole_flange(fit), pairs))
    yield from of_arms(fit, pairs)
    yield from of_images(fit, pairs)
    yield from scored(fit, creeps_of_frames(fit))
    yield from of_distances(fit, pairs)
    for flange in fit.unknowns.erring:
        yield from scored(fit, effects_of_frames(fit, flange), flange)
    for camera in fit.unknowns.lenses:
        is_free = fit.cell.cameras[camera].intrinsics != "hold" or ("lens", camera) in fit.unknowns
        is_free &= camera not in fit.unknowns.fields
        if is_free and images_of(pairs, camera):
            found = best_field(fit, pairs, camera, SIGNIFICANT)
            if found is not None:
                field, size, gain = found
                yield Candidate(gain, lens_field(camera, field, size), field=field)


def of_stops(fit: Fit, pairs: Sequence[Pair]) -> Iterator[Candidate]:
    """Candidates that differ from stop to stop, or before and after one.

    An image that is shifted at once shows in nothing that varies.
    """
    yield from of_arms(fit, pairs)
    jitters = [one for one in effects_of_lenses(fit) if isinstance(one, FocusJitter)]
    free = [name for name in fit.unknowns.lenses if ("lens", name) in fit.unknowns]
    yield from beside_zooms(fit, scored(fit, jitters), free if sole_flange(fit) else ())


def of_images(fit: Fit, pairs: Sequence[Pair]) -> Iterator[Candidate]:
    """Motion of rows while they are read, of cameras whose motion is not known; panes of glass."""
    swept = {sweep.camera for sweep in fit.cell.sweeps}
    for camera in fit.unknowns.lenses.keys() - swept:
        effect = RowMotion(camera, fit.unknowns.lenses[camera], stops_of(fit, camera))
        is_open = effect.name in {known.name for known in fit.unknowns.effects}
        if not is_open and 0 < len(effect.stops) <= _MOVING:
            score, bounds = of_rows(fit, pairs, effect.typical), effect.size
            size, gain = score.best(np.ones(len(score.pull)), bounds.low, bounds.high)
            if size * float(np.mean(effect.lens.matrix[:2])) > _LEAST_PX:
                # Tilts of a plane look much like it: beyond, arms' errors would be taken for it.
                member = starting_at(random_effect(effect), size, _SHOWN * size)
                yield Candidate(gain, member, effect)
        opened_names = {known.name for known in fit.unknowns.effects}
        displacements = (Window.tried(camera), *_sags(fit, pairs, camera))
        for tried in displacements:
            if tried[0].name not in opened_names and images_of(pairs, camera):
                best, size, gain = best_displacement(fit, pairs, tried)
                yield Candidate(gain, starting_at(random_effect(best), size), best)


def _sags(fit: Fit, pairs: Sequence[Pair], camera: str) -> Iterator[tuple[BoardSags, ...]]:
    """Sags of the only board that a camera sees, where a flange carries it."""
    boards = {pair.names[1] for pair in images_of(pairs, camera)}
    for board in boards if len(boards) == 1 else ():
        flange, edges = fit.cell.tree.branches[board].parent, fit.linearised.values
        points = corner_positions(fit.cell.boards[board])
        # Corners of a board that bends with its weight, at least: a tag is too small, and says too
        # little.
        if flange in fit.cell.arms and ("edge", board) in edges and len(points) >= 12:
            yield BoardSags.tried(camera, flange, edges["edge", board][:3, 2], points)


def of_distances(fit: Fit, pairs: Sequence[Pair]) -> Iterator[Candidate]:
    """Distances of measured poses that changed at once: as noise, they have a size of their own.

    A score does not see them so.
    """
    used, known = np.flatnonzero(fit.used), {effect.name for effect in fit.unknowns.effects}
    for camera in {fit.cell.sightings[at].seer for at in used} & fit.cell.cameras.keys():
        seen = [fit.cell.sightings[at] for at in used if fit.cell.sightings[at].seer == camera]
        stops = np.unique([one.stop for one in seen])
        is_measured = all(isinstance(one.evidence, MeasuredPose) for one in seen)
        if (
            not is_measured
            or len(stops) < processes.ENOUGH_STOPS
            or f"sight steps {camera}" in known
        ):
            continue
        progress = fit.cell.moments.progress[stops]
        tried = [
            SightSteps(camera, float(progress[at])) for at in evenly(len(stops) - 3, _ZOOMS) + 1
        ]
        scores = [of_effect(fit, one) for one in tried]
        best = int(
            np.argmax([float(one.pull @ one.pull / one.information[0, 0]) for one in scores])
        )
        gain = gain_of(fit, pairs, tried[best]) - np.log(len(tried))
        yield Candidate(gain, random_effect(tried[best]), tried[best])


def stops_of(fit: Fit, camera: str) -> IntArray:
    """(s,) stops of the views of one camera."""
    stops = [gram.stops for gram in fit.grams if gram.pair[0] == camera]
    return np.unique(np.concatenate([np.zeros(0, int), *stops]))


def of_arms(fit: Fit, pairs: Sequence[Pair]) -> Iterator[Candidate]:
    """Candidates that are effects of arms and their motion."""
    yield from scored(fit, effects_of_arms(fit))
    known = {effect.name for effect in fit.unknowns.effects}
    for effect in tried_effects(fit):
        if effect.name not in known:
            yield Candidate(gain_of(fit, pairs, effect), random_effect(effect), effect)


def scored(
    fit: Fit, effects: Iterable[Effect], flange: str = "", pairs: Sequence[Pair] = ()
) -> Iterator[Candidate]:
    """Candidates of effects that are not open yet; of a flange, given the errors of its arm."""
    known = {effect.name for effect in fit.unknowns.effects}
    found = list[tuple[Effect, float, float, float]]()
    for effect in effects:
        if effect.name not in known and effect.count:
            bounds = effect.size
            # One of very many unknowns is judged by some of them.
            effect_score = of_effect(fit, effect.typical, pairs)
            best = effect_score.best(np.ones(len(effect_score.pull)), bounds.low, bounds.high)
            found.append((effect, *best, np.nan))
    if flange:
        # An effect that gains little beside independent noise gains less beside errors that last;
        # one that differs from stop to stop does not last.
        lasting = [one[0] for one in found if one[0].typical is one[0]]
        clear = [one[0] for one in found if one[0] in lasting and 4.0 * one[2] >= SIGNIFICANT]
        if any(isinstance(one, Creeps | JointsCreep) for one in clear):
            creeps = [(one[2], one[0].about_m) for one in found if isinstance(one[0], BaseCreeps)]
            _, place = max(creeps, default=(0.0, ()))
            clear += [one for one in steps(fit, flange, place) if one.name not in known]
        added = [(one, added_by(fit, one, pairs)) for one in clear]
        lasting_scores = processes.scored(fit, flange, added) if clear else []
        others = [one for one in found if one[0] not in (clear if lasting_scores else ())]
        found = [*others, *((one, *best) for one, best in zip(clear, lasting_scores, strict=False))]
    for effect, size, gain, explained in found:
        # When something was moved is a free choice.
        off = np.log(_STEPS) if isinstance(effect, BaseSteps | MountSteps | JointsStep) else 0.0
        off += np.log(_ZOOMS) if isinstance(effect, LensSteps) else 0.0
        # Boards that swell are rarer by so much than what creeps.
        off += np.log(100.0) if isinstance(effect, BoardSwells) else 0.0
        member = starting_at(random_effect(effect), size)
        yield Candidate(gain - off, member, effect, explained=explained - off)


def starting_at(member: Vector, size: float, most: float = np.inf) -> Vector:
    """An unknown whose sizes start at a value, and are at most another."""
    priors = tuple(
        replace(prior, size=replace(prior.size, start=size, high=min(prior.size.high, most)))
        if prior.size
        else prior
        for prior in member.priors
    )
    return replace(member, priors=priors)


def sole_flange(fit: Fit) -> str:
    """The only arm, beside whose errors what lenses do is judged; empty where there are more."""
    return fit.unknowns.erring[0] if len(fit.unknowns.erring) == 1 else ""


def effects_of_lenses(fit: Fit) -> Iterator[Effect]:
    """Effects that a lens may have."""
    for camera, lens in fit.unknowns.lenses.items():
        if ("lens", camera) not in fit.unknowns:
            continue
        body = fit.cell.tree.body(camera)
        flange = body if body in fit.cell.arms else ""
        for kind in NAMED:
            yield from kind.of_lens(camera, lens, flange)
        if fit.cell.cameras[camera].focus == "auto":
            distances = [gram.distances for gram in fit.grams if gram.pair[0] == camera]
            reference_m = float(np.median(np.concatenate(distances)))
            is_stated = fit.cell.cameras[camera].stated is not None
            yield Breathing(camera, lens, reference_m, is_stated)
            is_breathing = f"breathing {camera}" in fit.sizes.keys() - fit.unknowns.closed
            yield FocusJitter(camera, lens, stops_of(fit, camera), is_breathing)


def effects_of_arms(fit: Fit) -> Iterator[Effect]:
    """Effects on the joints of arms whose postures are known."""
    for name in fit.unknowns.erring:
        arm = fit.cell.arms[name]
        if arm.has_joints and arm.model is not None:
            yield Play(name, arm.model)
            if arm.model.masses is None:
                yield Weight(name, arm.model)
            if arm.model.masses is not None or (arm.loads is not None and arm.loads.any):
                yield Springs(name, arm.model)


def effects_of_frames(fit: Fit, flange: str) -> Iterator[Effect]:
    """Effects on what an arm stands on, and on what it carries."""
    stops = np.unique([fit.cell.sightings[at].stop for at in np.flatnonzero(fit.used)])
    arm = fit.cell.arms[flange]
    stood = stops[np.isfinite(arm.poses[stops, 0, 0])]
    if len(stood) >= processes.ENOUGH_STOPS:
        is_swept = any(sweep.flange == flange for sweep in fit.cell.sweeps)
        robot = arm.model if arm.has_joints else None
        standing = Stood(arm.poses, stood, is_swept, _beside(fit, flange), robot)
        for kind in NAMED:
            yield from kind.of_flange(flange, standing)


def _beside(fit: Fit, flange: str) -> tuple[float, ...]:
    """Where a robot's base has what stands beside it, on average [m]; empty of nothing."""
    branches = fit.cell.tree.branches
    base = branches[flange].parent
    cell = branches[base].parent if base in branches else base
    stand = [at for at in fit.cell.unknown if at != base and branches[at].parent in (cell, base)]
    if not stand:
        return ()
    seen = (fit.cell.tree.path(base, at) for at in stand)
    moments = fit.cell.moments.take(np.zeros(1, int))
    places = [
        predicted(fit.cell, fit.unknowns, fit.state, path, moments, {}).poses[0, :3, 3]
        for path in seen
    ]
    return tuple(np.mean(places, axis=0).tolist())


def creeps_of_frames(fit: Fit) -> Iterator[Effect]:
    """Creep of cameras and targets beside others on the same base or flange."""
    cell = fit.cell
    parents = {name: cell.tree.branches[name].parent for name in cell.unknown}
    counts, seen = (
        Counter(parents.values()),
        [cell.sightings[at] for at in np.flatnonzero(fit.used)],
    )
    for name in (name for name in (*cell.cameras, *cell.boards) if name in parents):
        stops = {one.stop for one in seen if name in one.pair}
        if counts[parents[name]] > 1 and len(stops) >= processes.ENOUGH_STOPS:
            yield FrameCreeps(name)


def steps(fit: Fit, flange: str, place: tuple[float, ...]) -> Iterator[Effect]:
    """Effects of what was moved at once: rivals to those that creep, about a place [m]."""
    progress, arm = fit.cell.moments.progress, fit.cell.arms[flange]
    for at in (evenly(len(progress) - 3, _STEPS) + 1).tolist():
        yield BaseSteps(flange, place, float(progress[at]))
        yield MountSteps(flange, float(progress[at]))
        if arm.has_joints and arm.model is not None:
            yield JointsStep(flange, arm.model, float(progress[at]))


def moved_instead(fit: Fit, zoom: LensSteps) -> Iterator[Effect]:
    """Moves at the stop at which a lens changed: of what the only arm carries, and of its base."""
    progress = float(fit.cell.moments.progress[zoom.stop - 1])
    if flange := sole_flange(fit):
        yield BaseSteps(flange, _beside(fit, flange), progress)
        yield MountSteps(flange, progress)


def beside_zooms(
    fit: Fit, changes: Iterable[Candidate], anyway: Collection[str] = ()
) -> Iterator[Candidate]:
    """Candidates that change a lens, and that it changed at once beside clear ones, or anyway."""
    clear, grown, single = set(anyway), dict[str, float](), dict[str, Candidate]()
    for one in changes:
        yield one
        if 2.0 * one.gain >= SIGNIFICANT and one.lens:
            clear.add(one.lens)
        if isinstance(one.effect, LensGrows):
            grown[one.lens] = max(one.gain, grown.get(one.lens, -np.inf))
    for camera in clear:
        # Where views disagree, a stated lens may be that of either part.
        may_be_first = camera in anyway and fit.cell.cameras[camera].stated is not None
        for kind in (LensSteps, LensChanges):
            for one in scored(fit, zooms(fit, camera, kind, (False, True)[: 1 + may_be_first])):
                single[one.name] = max(one, single.get(one.name, one), key=lambda at: at.gain)
    likeliest = [one.effect for one in single.values() if one.effect is not None]
    for one in scored(fit, likeliest, sole_flange(fit)):
        # A lens that grows is judged beside an arm's lasting errors, as is a frame that moved.
        # Where it explains more there, so is one that changed at once.
        most = single[one.name].gain
        is_less = one.gain < grown.get(one.lens, -np.inf)
        yield replace(one, gain=min(one.gain, most) if is_less else max(one.gain, most))


def zooms(
    fit: Fit, camera: str, kind: type[LensSteps], are_first: Iterable[bool] = (False,)
) -> Iterator[Effect]:
    """Changes of a lens at once: rivals to what grows, and to what differs from stop to stop."""
    grams = [(gram.stops, fit.used[gram.rows]) for gram in fit.grams if gram.pair[0] == camera]
    stops = np.unique(np.concatenate([gram_stops[used] for gram_stops, used in grams]))
    changed = (evenly(len(stops) - 3, _ZOOMS) + 2).tolist()
    for at, is_first in product(changed, are_first):
        yield kind(camera, fit.unknowns.lenses[camera], int(stops[at]), is_first)


def tried_effects(fit: Fit) -> Iterator[Effect]:
    """Effects that are not linear in their values: no score has these."""
    for name in fit.unknowns.erring:
        arm = fit.cell.arms[name]
        if arm.has_joints and arm.model is not None and arm.heat is not None:
            heat = Heat(name, arm.model, arm.heat)
            if heat.is_shown(fit.cell.moments):
                yield heat


def gain_of(fit: Fit, pairs: Sequence[Pair], effect: Effect) -> float:
    """Log-likelihood of an effect against none, each at its most likely sizes of all else.

    It is linearised once, at the point where the fit was.
    """
    member = random_effect(effect)
    unknowns = fit.unknowns.with_members(member)
    unknowns = replace(unknowns, effects=(*unknowns.effects, effect))
    values = {**fit.linearised.values, member.key: np.zeros(member.count)}
    state = State(values, fit.linearised.errors)
    grams = linearised(fit.cell, unknowns, state, tuple(pairs))
    mixed = mixed_model(fit.cell, unknowns, state, grams, fit.used)
    starts, (low, high) = unknowns.starts(), unknowns.bounds()
    for name, value in fit.sizes.items():
        starts[unknowns.size_of(name)] = np.log(value)
    found = most_likely(mixed, np.clip(starts, low, high), low, high)
    return (fit.estimate.value - found.estimate.value) / 2.0
