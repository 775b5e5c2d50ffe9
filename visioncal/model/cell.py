"""A cell: a tree of frames, the arms that move in it, and what was seen."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from visioncal.core.types import Mask, Target
from visioncal.model.arm import Arm, Moments, Swept
from visioncal.model.sightings import Sighting
from visioncal.session.document import CameraTable
from visioncal.session.tree import Tree


@dataclass(frozen=True, eq=False)
class Cell:
    """One session as the estimator sees it.

    Edges of the tree are unknown, known (the reference: one robot's base), or a robot's; a robot is
    known by the frame of its flange.
    """

    tree: Tree
    arms: Mapping[str, Arm]  # By flange.
    cameras: Mapping[str, CameraTable]  # By frame.
    boards: Mapping[str, Target]  # By frame.
    sightings: tuple[Sighting, ...]
    moments: Moments  # At all s stops.
    sweeps: tuple[Swept, ...] = ()  # Sightings while robots moved.
    absent: Mapping[int, str] = field(default_factory=dict)  # Why views have no sighting.
    stations: tuple[int, ...] = ()  # Of the session, at the s stops.

    @cached_property
    def pairs(self) -> dict[tuple[str, str], list[int]]:
        """Indices of the sightings, by seer and seen."""
        found: dict[tuple[str, str], list[int]] = {}
        for index, sighting in enumerate(self.sightings):
            found.setdefault(sighting.pair, []).append(index)
        return found

    @property
    def held(self) -> Mask:
        """(n,) sightings that are predicted only."""
        return np.array([sighting.is_held for sighting in self.sightings], bool)

    @cached_property
    def unknown(self) -> tuple[str, ...]:
        """Frames whose edges are estimated: the unknown ones between what was seen by what."""
        passed = {step.frame for pair in self.pairs for step in self.tree.path(*pair)}
        return tuple(name for name in self.tree.unknown if name in passed)

    @cached_property
    def bodies(self) -> tuple[tuple[str, ...], ...]:
        """Flanges that sightings connect: each tuple's errors are eliminated together."""
        homes = {name: {name} for name in self.arms}
        for pair in self.pairs:
            joined = set[str]()
            for step in self.tree.path(*pair):
                if step.robot:
                    joined |= homes[step.robot]
            for name in joined:
                homes[name] = joined
        groups = {id(group): group for group in homes.values()}.values()
        return tuple(tuple(name for name in self.arms if name in group) for group in groups)

    def with_sightings(self, sightings: Sequence[Sighting]) -> "Cell":
        """The cell with others."""
        return replace(self, sightings=tuple(sightings))

    def only(self, rows: Iterable[int]) -> "Cell":
        """The cell with some of its sightings."""
        return self.with_sightings([self.sightings[row] for row in rows])

    def without(self, reasons: Mapping[int, str]) -> "Cell":
        """The cell without some rows of sightings, by reasons."""
        kept = [row for row in range(len(self.sightings)) if row not in reasons]
        absent = {self.sightings[row].view: reason for row, reason in reasons.items()}
        return replace(self.only(kept), absent={**self.absent, **absent})
