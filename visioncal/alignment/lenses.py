"""Lenses and boards of a whole cell, fitted with its frames: what is free of them, and how far."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.alignment.arms import ArmsErrors
from visioncal.alignment.cell import Cell
from visioncal.alignment.looking import CameraLook
from visioncal.estimator.joint import Problem, Scene, chance_limit
from visioncal.estimator.linalg import covariance
from visioncal.estimator.network import Network
from visioncal.estimator.networkagree import Agreed
from visioncal.estimator.networkfit import fit_network, normal_equations
from visioncal.estimator.networklooks import Looks, Seen
from visioncal.estimator.sightings import State
from visioncal.stages.pnp import ViewPoses
from visioncal.types import Corners, FloatArray, IntArray

# Values that move by less than this share of their sigma have settled.
_SETTLED, _ROUNDS = 0.02, 6


def with_looks(
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
