"""From what was seen to the fit of the whole cell: start, agreement, lenses and boards."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.alignment.arms import ArmsAsked, ArmsErrors, arms_errors
from visioncal.alignment.cell import Cell
from visioncal.alignment.looking import CameraLook, Looked
from visioncal.alignment.reading import nominal_spread, places_alone
from visioncal.alignment.ties import ambiguous_error, untied_robots
from visioncal.estimator.joint import Problem, Scene, chance_limit
from visioncal.estimator.linalg import covariance
from visioncal.estimator.network import Common, Network, Sightings, State
from visioncal.estimator.networkagree import Agreed, agree, settle
from visioncal.estimator.networkfit import fit_network, normal_equations
from visioncal.estimator.networklooks import Looks, Seen
from visioncal.stages.choose import chosen, padded
from visioncal.stages.pnp import ViewPoses
from visioncal.stages.sighted import Sighted
from visioncal.stages.tie import pick, tie
from visioncal.targets import first_corners, rotation_transforms
from visioncal.types import Corners, FloatArray, IntArray, Mask, Target

# Values that move by less than this share of their sigma have settled.
_SETTLED, _ROUNDS = 0.02, 6


@dataclass(frozen=True, eq=False)
class Solved:
    """The fit of a whole cell.

    Attributes:
        cell: The cell; its rows are the observations in the fit's order.
        agreed: The fit, what it uses, and what moved.
        seen: What all corners say of lenses and boards; None without images.
        poses: Each row's one pose.
        untied: Frames that nothing ties to the rest.
        arms: The robots' own errors; the last of what is shared.
    """

    cell: Cell
    agreed: Agreed
    seen: Seen | None
    poses: tuple[ViewPoses, ...]
    untied: tuple[str, ...]
    arms: ArmsErrors

    @property
    def looks_count(self) -> int:
        """How many values of lenses and boards are free: the first of what is shared."""
        return 0 if self.seen is None else len(self.seen.free)


def solve(cell: Cell, looked: Looked, asked: ArmsAsked = "reported") -> Solved:
    """Solves a whole cell.

    Args:
        cell: The cell.
        looked: What its cameras saw.
        asked: What is to be estimated of the robots' arms.

    Raises:
        DegenerateError: A robot is tied to nothing, or a frame may be in two places.
    """
    missing = {
        it.view: looked.reasons.get(it.view, "nothing was found in its image")
        for it in cell.rows
        if it.view not in looked.poses
    }
    cell = cell.without(missing)
    cell, lost = _tied_part(cell)
    views = [looked.poses[it.view] for it in cell.rows]
    cell, views, network, state, unplaced = _started(cell, views)
    agreed = agree(network, state, _movable(network))
    agreed = _levelled(cell, views, agreed)
    seen, arms = None, arms_errors(cell, asked)
    if looked.cameras:
        agreed, seen = _with_looks(cell, looked.cameras, views, agreed, arms)
    elif len(arms):
        agreed = _with_arms(agreed, arms)
    agreed = settle(agreed, _movable(agreed.network))
    return Solved(cell, agreed, seen, tuple(views), (*lost, *unplaced), arms)


def _levelled(cell: Cell, views: Sequence[ViewPoses], agreed: Agreed) -> Agreed:
    """Asks for the noise level of cameras, too, now that what is wrong is out.

    Corners of one image may err alike, as those of small squares do: poses then scatter by more
    than corners do about them, but never by less.
    """
    sensors = sensors_of(cell, views)
    frames = tuple(dict.fromkeys((*sensors, *(it.seer for it in cell.rows))))
    places = {it: at for at, it in enumerate(frames)}
    network = agreed.network
    sightings = replace(
        network.sightings, sensors=np.array([places[it.seer] for it in cell.rows], dtype=np.int64)
    )
    more = np.ones(len(frames) - len(sensors))
    noise = agreed.fit.noise
    return replace(
        agreed,
        network=replace(
            network,
            sightings=sightings,
            least_levels=np.concatenate([np.zeros(len(sensors)), more]),
        ),
        fit=replace(
            agreed.fit, noise=replace(noise, sensors=np.concatenate([noise.sensors, more]))
        ),
    )


def _with_arms(agreed: Agreed, arms: ArmsErrors) -> Agreed:
    network = arms.added(agreed.network)
    state = State(agreed.fit.state.edges, np.zeros(len(arms)))
    fit = fit_network(network.subset(agreed.used), state, agreed.fit.noise)
    return replace(agreed, network=network, fit=fit)


def _movable(network: Network) -> tuple[str, ...]:
    """What may be bumped or slip: all that is unknown but bases."""
    bases = {branch.parent for branch in network.tree.branches.values() if branch.robot}
    return tuple(it for it in network.tree.unknown if it not in bases)


def _tied_part(cell: Cell) -> tuple[Cell, tuple[str, ...]]:
    """The part of a cell that observations tie together, and the frames outside."""
    tied = cell.tied()
    lost = tuple(it for it in cell.tree.branches if it not in tied)
    untied_robots(cell, lost)
    return _without_frames(cell, lost), tuple(it for it in lost if not _is_flange(cell, it))


def _is_flange(cell: Cell, frame: str) -> bool:
    return bool(cell.tree.branches[frame].robot)


def _without_frames(cell: Cell, frames: Sequence[str]) -> Cell:
    tree = cell.tree.without(frames)
    reasons = {
        it.view: f"nothing ties {it.seer if it.seer in frames else it.seen} to the rest of the cell"
        for it in cell.rows
        if it.seer not in tree.branches or it.seen not in tree.branches
    }
    robots = set(tree.robots)
    poses = {name: it for name, it in cell.poses.items() if name in robots}
    return replace(cell.without(reasons), tree=tree, poses=poses)


def _started(
    cell: Cell, views: Sequence[ViewPoses]
) -> tuple[Cell, list[ViewPoses], Network, State, tuple[str, ...]]:
    """Finds a start, and gives each view its one pose by it."""
    targets = _targets(cell)
    tied = tie(cell.tree, cell.poses, _sighted(cell, views, targets))
    if tied.untied:
        untied_robots(cell, tied.untied)
        kept = _without_frames(cell, tied.untied)
        rows = {it.view for it in kept.rows}
        cell, views = kept, [it for it in views if it.view in rows]
    if tied.ambiguous:
        raise ambiguous_error(cell, tied.ambiguous)
    edges = np.array([tied.edges[it] for it in cell.tree.unknown]).reshape(-1, 4, 4)
    state = State(edges, np.zeros(0))
    rough = _network(cell, [chosen(it, 0, None) for it in views])
    picks = pick(rough.predicted(state), _sighted(cell, views, targets))
    firsts = dict(zip(targets, first_corners(tuple(targets.values())).tolist(), strict=True))
    views = [
        chosen(view, at, targets.get(row.seen), firsts.get(row.seen, 0))
        for view, at, row in zip(views, picks.tolist(), cell.rows, strict=True)
    ]
    return cell, views, _network(cell, views), state, tied.untied


def _targets(cell: Cell) -> dict[str, Target]:
    """The printed targets by their frames."""
    return {f"target_{name}" if name else "target": it for name, it in cell.session.plates.items()}


def _sighted(cell: Cell, views: Sequence[ViewPoses], targets: Mapping[str, Target]) -> Sighted:
    candidates = padded(views)
    turns = np.zeros(candidates.valid.shape, dtype=np.int64)
    for row, view in zip(turns, views, strict=True):
        row[: len(view.turns)] = view.turns
    return Sighted(
        tuple(it.seer for it in cell.rows),
        tuple(it.seen for it in cell.rows),
        np.array([it.station for it in cell.rows]),
        candidates,
        turns,
        {
            frame: turned
            for frame, it in targets.items()
            if len(turned := rotation_transforms(it)) > 1
        },
        _places(cell),
    )


def _places(cell: Cell) -> Mask:
    """(n,) whether each observation tells a place alone."""
    alone = places_alone(cell)
    return np.array([alone[it.view] for it in cell.rows], dtype=bool)


def _network(cell: Cell, views: Sequence[ViewPoses]) -> Network:
    """The network of views with one pose each, lenses and boards as they are taken to be."""
    given = np.array([not it.covariance.any() for it in views])
    levels = {it: at for at, it in enumerate(sensors_of(cell, views))}
    sensors = [
        levels[row.seer] if is_sensed(row.seer, view) else -1
        for row, view in zip(cell.rows, views, strict=True)
    ]
    spread, places = np.array([it.covariance[0] for it in views]), _places(cell)
    spread[given] = nominal_spread()
    turned = {row.seen for row, place in zip(cell.rows, places.tolist(), strict=True) if not place}
    return Network(
        cell.tree,
        cell.poses,
        Sightings(
            tuple(it.seer for it in cell.rows),
            tuple(it.seen for it in cell.rows),
            np.array([it.station for it in cell.rows]),
            np.array(sensors, dtype=np.int64),
            np.array([it.cam_from_target[0] for it in views]),
            spread,
            ~places,
            np.zeros((len(views), 6, 0)),
        ),
        Common.none(),
        frozenset(it.seen for it in cell.rows) - turned,
    )


def is_sensed(seer: str, view: ViewPoses) -> bool:
    """Whether an observation's noise is known up to a level: those of corners is known."""
    return seer.startswith("instrument") or not view.covariance.any()


def sensors_of(cell: Cell, views: Sequence[ViewPoses]) -> tuple[str, ...]:
    """The frames whose observations' noise is known up to a level; other cameras come behind."""
    pairs = zip(cell.rows, views, strict=True)
    return tuple(dict.fromkeys(row.seer for row, view in pairs if is_sensed(row.seer, view)))


def _with_looks(
    cell: Cell,
    cameras: Mapping[str, CameraLook],
    views: Sequence[ViewPoses],
    agreed: Agreed,
    arms: ArmsErrors,
) -> tuple[Agreed, Seen]:
    """Fits lenses and boards with the rest, and the arms' errors where they are asked for."""
    looks = _looks(cell, cameras, views)
    agreed, seen = _settled(cell, looks, looks.first, agreed, arms)
    wider = _wider(cell, seen, agreed, arms)
    if len(wider) > len(seen.free):
        agreed, seen = _settled(cell, seen.looks, wider, agreed, arms)
    return agreed, seen


def _looks(cell: Cell, cameras: Mapping[str, CameraLook], views: Sequence[ViewPoses]) -> Looks:
    targets = tuple(cell.session.boards.values())
    one = {it.view: it for it in views}
    problems, poses = {}, {}
    for name, it in cameras.items():
        scene = Scene(
            "eye-to-hand",
            targets,
            it.camera,
            it.estimated,
            it.table.intrinsics,
            it.table.matrix_sigma_px,
            tuple(cell.session.boards),
        )
        mine = [one.get(view.view, view) for view in it.views]
        corners: dict[int, Corners] = {
            view.view: view.corners for view in mine if view.corners is not None
        }
        problems[name] = Problem.of(scene, corners)
        poses[name] = np.array([view.cam_from_target[0] for view in mine])
    return Looks.of(problems, poses)


def _settled(
    cell: Cell, looks: Looks, free: IntArray, agreed: Agreed, arms: ArmsErrors
) -> tuple[Agreed, Seen]:
    """Linearises corners and fits the cell in turn, until lenses and boards stay."""
    bent = np.zeros(len(arms))
    for _ in range(_ROUNDS):
        seen = looks.seen(free)
        network = arms.added(with_seen(cell, agreed.network, seen))
        state = State(agreed.fit.state.edges, np.concatenate([np.zeros(len(free)), bent]))
        part = network.subset(agreed.used)
        fit = fit_network(part, state, agreed.fit.noise)
        change, bent = np.split(fit.state.shared, [len(free)])
        sigma = np.sqrt(np.diag(covariance(normal_equations(part, fit.state, fit.noise)[0])))
        sigma = sigma[6 * len(fit.state.edges) :][: len(free)]
        agreed = replace(agreed, network=network, fit=fit)
        if np.all(np.abs(change) <= _SETTLED * sigma):
            break
        looks = seen.looks.moved(free, change)
    return agreed, seen


def with_seen(cell: Cell, network: Network, seen: Seen) -> Network:
    """The network with poses as its lenses and boards make them."""
    places = {view: at for at, view in enumerate(seen.views)}
    rows = np.array([places.get(it.view, -1) for it in cell.rows], dtype=np.int64)
    mine = rows >= 0
    measured, spread = network.sightings.measured.copy(), network.sightings.covariance.copy()
    by_free = np.zeros((len(rows), 6, len(seen.free)))
    measured[mine] = seen.looks.poses[rows[mine]]
    spread[mine], by_free[mine] = seen.spread[rows[mine]], seen.by_free[rows[mine]]
    sightings = replace(network.sightings, measured=measured, covariance=spread, by_shared=by_free)
    return replace(network, sightings=sightings, common=seen.common, by_flange={})


def _wider(cell: Cell, seen: Seen, agreed: Agreed, arms: ArmsErrors) -> IntArray:
    """What more the corners ask to set free: boards' bends, and lenses that were stated."""
    looks = seen.looks
    groups: list[IntArray] = [looks.shape_of(it) for it in range(len(looks.scales))]
    for name, problem in looks.problems.items():
        lens = np.arange(looks.lenses[name].start, looks.lenses[name].stop)
        if problem.scene.mode == "auto" and not np.isin(lens, seen.free).all():
            groups.append(lens)
    if not all(it.has_spare_corners for it in looks.problems.values()):
        return seen.free
    every = np.unique(np.concatenate([seen.free, *groups]))
    network = arms.added(with_seen(cell, agreed.network, looks.seen(every)))
    scores = _Scores.of(network, agreed, every, arms)
    free = seen.free
    while groups:
        gain, at = max((scores.gain(free, it), at) for at, it in enumerate(groups))
        if gain <= 0.0:
            break
        free = np.union1d(free, groups.pop(at))
    return free


@dataclass(frozen=True, eq=False)
class _Scores:
    """Normal equations with (f,) values free beside the edges: those that stand at some places."""

    information: FloatArray
    gradient: FloatArray
    free: IntArray
    arms: int

    @classmethod
    def of(cls, network: Network, agreed: Agreed, free: IntArray, arms: ArmsErrors) -> "_Scores":
        bent = agreed.fit.state.shared[len(agreed.fit.state.shared) - len(arms) :]
        shared = np.concatenate([np.zeros(len(free)), bent])
        state = State(agreed.fit.state.edges, shared)
        part = network.subset(agreed.used)
        return cls(*normal_equations(part, state, agreed.fit.noise), free, len(arms))

    def gain(self, free: IntArray, group: IntArray) -> float:
        """By how much more than chance the squared error falls with a group free (Rao)."""
        more = np.setdiff1d(group, free)
        return self._score(np.union1d(free, more)) - self._score(free) - chance_limit(len(more))

    def _score(self, free: IntArray) -> float:
        size = len(self.gradient)
        edges, arms = size - len(self.free) - self.arms, np.arange(size - self.arms, size)
        at = np.concatenate([np.arange(edges), edges + np.searchsorted(self.free, free), arms])
        gradient = self.gradient[at]
        return float(gradient @ covariance(self.information[np.ix_(at, at)]) @ gradient)
