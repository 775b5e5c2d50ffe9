"""Sources of randomness of simulated cells, each independent of the others."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np


class RandomStream(IntEnum):
    """What is random in a cell; the numbers from 100 on are of whole cells, by their things."""

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


# What another draw of the same cell draws anew, and what another recording of it does not.
_DRAWN_ANEW = (
    *(RandomStream.ARM, RandomStream.ROBOT, RandomStream.PIXELS),
    *(RandomStream.ARMS, RandomStream.ROBOTS, RandomStream.CORNERS),
)
_KEPT = (
    *(RandomStream.MOUNTING, RandomStream.ARM, RandomStream.LENS),
    *(RandomStream.MOUNTINGS, RandomStream.ARMS, RandomStream.LENS_VIEWS),
)
# Sets a recording's randomness apart from a draw's.
_RECORDING = 1000


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawOptions:
    """Which of all cells is drawn, and how noisy corners are.

    Attributes:
        pixel_sigma_px: Noise of the simulated detections, per axis [px].
        seed: Of everything random. Each source of randomness has a stream of its own, so that a
            change of one option leaves the others' draws as they were.
        draw: Which draw of the real arms and of all noise; the cell, and what robots move to, are
            the same for all.
        recording: Which recording of the same cell and arms: each has stops and noise of its own.
    """

    pixel_sigma_px: float = 0.05
    seed: int = 0
    draw: int = 0
    recording: int = 0

    def stream(self, purpose: RandomStream, *index: int) -> np.random.Generator:
        """The generator of one source of randomness; `index` is of the thing or the view."""
        again = [self.draw] if self.draw and purpose in _DRAWN_ANEW else []
        if self.recording and purpose not in _KEPT:
            again += [_RECORDING, self.recording]
        return np.random.default_rng([self.seed, int(purpose), *again, *index])
