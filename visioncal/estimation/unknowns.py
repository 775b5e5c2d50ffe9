"""Names of a fit's unknowns, and the one place that knows their columns.

An unknown is named by its kind and by what it is of, as `("lens", "cam_left")`:

    edge         a frame   its pose `parent_from_frame`: six columns, its right perturbation
                           (rotation [rad], translation [m]); of a mere point the rotation is exact
    lens         a camera  fx, fy, cx, cy [px], and distortion
    board        a target  shape of a printed board (`BOARD_NAMES`), or (3 k,) points of a rig [m]
    size                   relative sizes of targets whose poses a program measured in images
    lens errors  a camera  errors of the lens beyond its model, in units of their size
    arm          a robot   errors of the arm: those of its model, or twists of its links [rad]
    temperature  a robot   growth of the arm with its temperature
    clock        a pair    the camera's clock less the robot's [s]
    rolling shutter        time from an image's first row to its last [s]

and what grows: an unknown of each kind in `model.effects.NAMED`, of a robot or a camera. Cameras
and frames have the names of the tree of frames, robots and targets those of the session; the names
of only ones may be empty.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from visioncal.core.types import IntArray, Mask

EDGE, LENS, BOARD, LENS_ERRORS, ARM = "edge", "lens", "board", "lens errors", "arm"
SIZE = "size"


class Unknown(NamedTuple):
    """Name of an unknown of one or more values."""

    kind: str  # See the module.
    name: str = ""  # Its owner.

    @classmethod
    def of_effect(cls, name: str) -> "Unknown":
        """The unknown of an effect's name, such as `clock of cam and robot a`."""
        kind, _, owner = name.partition(" of ")
        return cls(kind, owner)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The unknowns of a fit with their columns; of exact values there are none."""

    # The columns of each unknown, among p in all; those of edges come first.
    parts: Mapping[Unknown, slice]
    # (c,) ascending indices of the columns among an unknown's values, where some of these are exact
    # as stated; all others have a column for each value.
    uncertain: Mapping[Unknown, IntArray] = field(default_factory=dict)
    # (p,) mask of the columns that the fit moved. Others keep their value, and count in the
    # covariance.
    moved: Mask = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __getitem__(self, unknown: tuple[str, str]) -> slice:
        return self.parts.get(Unknown(*unknown), slice(0, 0))

    def of(self, kind: str) -> tuple[str, ...]:
        """Names of the unknowns of a kind, in the order of their columns."""
        return tuple(unknown.name for unknown in self.all_of(kind))

    def all_of(self, *kinds: str) -> tuple[Unknown, ...]:
        """All unknowns of some kinds, kind by kind."""
        return tuple(unknown for kind in kinds for unknown in self.parts if unknown.kind == kind)

    def columns(self, *chosen: tuple[str, str]) -> IntArray:
        """(c,) columns of some unknowns, in their order; none of those that there are not."""
        parts = [np.arange(part.start, part.stop) for part in map(self.__getitem__, chosen)]
        return np.concatenate([np.zeros(0, dtype=np.int64), *parts])

    def of_kinds(self, *kinds: str) -> IntArray:
        """(c,) columns of all unknowns of some kinds, kind by kind."""
        return self.columns(*self.all_of(*kinds))

    def values_of(self, unknown: tuple[str, str], *, moved: bool = False) -> IntArray:
        """(c,) which of an unknown's values are uncertain; only those that the fit `moved`."""
        at = self[unknown]
        values = self.uncertain.get(Unknown(*unknown), np.arange(at.stop - at.start))
        return values[self.moved[at]] if moved else values
