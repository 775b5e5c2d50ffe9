"""Independent sources of randomness of simulated cells."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np


class RandomStream(IntEnum):
    """Sources of randomness; those from 100 on are for cells with named things."""

    MOUNTING = 0
    POSES = 1
    ARM = 2
    ROBOT = 3
    WRONG = 4
    PIXELS = 5
    IMAGES = 6
    BACKDROP = 7
    PAIRS = 8
    LENS = 9
    SWEEP = 10
    BUMP = 11
    TOUCHES = 12
    MOUNTINGS = 100
    POSTURES = 101
    ARMS = 102
    ROBOTS = 103
    CORNERS = 104
    MEASURED = 105
    FAULTS = 106
    SHARE = 107
    LENS_VIEWS = 108
    READINGS = 109
    SWEEPS = 111


# Sources that another draw of the same cell changes, and those that another recording keeps.
_DRAWN_ANEW = (
    *(RandomStream.ARM, RandomStream.ROBOT, RandomStream.PIXELS),
    *(RandomStream.ARMS, RandomStream.ROBOTS, RandomStream.CORNERS),
)
_KEPT = (
    *(RandomStream.MOUNTING, RandomStream.ARM, RandomStream.LENS),
    *(RandomStream.MOUNTINGS, RandomStream.ARMS, RandomStream.LENS_VIEWS),
)
# Distinguishes a recording's randomness from a draw's.
_RECORDING = 1000


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawOptions:
    """Random seed of a cell, and the noise of corners."""

    pixel_sigma_px: float = 0.05  # Noise of simulated detections, per axis [px].
    # Seed of everything random. Each source of randomness has its own stream, so that changing one
    # option does not change the draws of others.
    seed: int = 0
    # Number of the draw of real arms and noise; the cell and the nominal postures are the same for
    # all.
    draw: int = 0
    # Number of the recording of the same cell and arms, with stops and noise of its own.
    recording: int = 0

    def stream(self, purpose: RandomStream, *index: int) -> np.random.Generator:
        """Generator of one source of randomness; `index` is of the thing or the view."""
        extra = [self.draw] if self.draw and purpose in _DRAWN_ANEW else []
        if self.recording and purpose not in _KEPT:
            extra += [_RECORDING, self.recording]
        return np.random.default_rng([self.seed, int(purpose), *extra, *index])
