"""Sightings by the frames between which they were made."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.transforms import apply
from visioncal.core.types import Corners, FloatArray, IntArray
from visioncal.model import Cell, Moments, Sighting
from visioncal.model.boards import SHAPES, shape_basis, shape_count
from visioncal.session.tree import PathStep
from visioncal.vision.targets import corner_positions


@dataclass(frozen=True, eq=False)
class Pair:
    """The sightings of one frame by another, in arrays."""

    rows: IntArray  # (k,) their indices.
    stops: IntArray  # (k,)
    sightings: tuple[Sighting, ...]
    path: tuple[PathStep, ...]
    moments: Moments  # (k) theirs.
    points: FloatArray  # (c, 3) corners of the board [m].
    is_loose: bool  # Whether each may be elsewhere.

    @property
    def names(self) -> tuple[str, str]:
        """Seer and seen."""
        return self.sightings[0].pair

    @cached_property
    def counts(self) -> IntArray:
        """(k,) numbers of corners."""
        return np.array([len(at.ids) for at in self.corners])

    @cached_property
    def corners(self) -> tuple[Corners, ...]:
        """The corners of each; empty of what was measured otherwise."""
        return tuple(at.corners for at in self.sightings if at.corners is not None)

    @cached_property
    def ids(self) -> IntArray:
        """(n,) numbers of all corners."""
        return np.concatenate([at.ids for at in self.corners])

    @cached_property
    def px(self) -> FloatArray:
        """(n, 2) all corners [px]."""
        return np.concatenate([at.px for at in self.corners])

    @cached_property
    def owner(self) -> IntArray:
        """(n,) index of each corner's sighting in the pair."""
        return np.repeat(np.arange(len(self.rows)), self.counts)

    @cached_property
    def weights(self) -> FloatArray:
        """(n,) typical noise over each corner's; over the noise itself where that is stated."""
        each = [
            (np.ones(len(at.ids)) if at.weights is None else at.weights) / (at.stated_px or 1.0)
            for at in self.corners
        ]
        return np.concatenate(each)

    def padded(self, rows: FloatArray) -> FloatArray:
        """(k, most corners, ...) of (n, ...) rows of corners; zeros where there are fewer."""
        within = np.arange(len(rows)) - (np.cumsum(self.counts) - self.counts)[self.owner]
        found = np.zeros((len(self.rows), int(self.counts.max()), *rows.shape[1:]))
        found[self.owner, within] = rows
        return found

    @property
    def middle(self) -> FloatArray:
        """(3,) middle of the board; its origin where its corners are not known [m]."""
        return self.points.mean(axis=0) if len(self.points) else np.zeros(3)

    def distances(self, poses: FloatArray) -> FloatArray:
        """(k,) of the board's middle along the camera's axis [m], at (k, 4, 4) poses."""
        return apply(poses, self.middle[None])[:, 0, 2]

    def twists(self, by_effects: Mapping[str, FloatArray]) -> FloatArray:
        """(k, 6) twists per second of what is seen, in its own frame.

        By the (k, 6, 6) right perturbations of `seer_from_seen` by those of each edge in the path.
        """
        rates = self.moments.rates
        pairs = ((slope, rates.get((self.names[0], name))) for name, slope in by_effects.items())
        each = [(slope @ rate[:, :, None])[:, :, 0] for slope, rate in pairs if rate is not None]
        return np.asarray(sum(each, np.zeros((len(self.rows), 6))))

    @cached_property
    def basis(self) -> FloatArray:
        """(c, 3, s) derivatives of the board's corners by its shape [m]."""
        return shape_basis(self.points, is_loose=self.is_loose)


def pairs_of(cell: Cell, most: int = 50) -> tuple[Pair, ...]:
    """All sightings of a cell, by what they are of; those measured and those in images apart.

    Of more than `most`, several pairs are made: rows of all corners at once would fill the memory.
    """
    found = []
    for names, indices in cell.pairs.items():
        kinds: dict[tuple[type, bool], list[int]] = {}
        for index in indices:
            sighting = cell.sightings[index]
            kinds.setdefault((type(sighting.evidence), sighting.is_stated), []).append(index)
        parts = [
            group[at : at + most] for group in kinds.values() for at in range(0, len(group), most)
        ]
        for rows in parts:
            stops = np.array([cell.sightings[row].stop for row in rows])
            board = cell.boards.get(names[1])
            points = np.zeros((0, 3)) if board is None else corner_positions(board)
            pair = Pair(
                np.array(rows), stops, tuple(cell.sightings[row] for row in rows),
                cell.tree.path(*names), cell.moments.take(stops), points,
                shape_count(board) > SHAPES,
            )  # fmt: skip
            found.append(pair)
    return tuple(found)


def images_of(pairs: Sequence[Pair], camera: str) -> list[Pair]:
    """The pairs that are images of one camera."""
    return [pair for pair in pairs if pair.names[0] == camera and pair.corners]
