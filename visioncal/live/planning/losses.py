"""What keeps a robot from the stops that were tried, counted and put into words."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import some_of
from visioncal.core.types import Mask

IMAGE = "the whole board in the image"
GUESS = "the whole board in the image although the guesses are off"
FOCUS, TILT, DISTANCE = "the range of focus", "the tilt", "the distance"
HIDDEN, BEHIND_ARM = "a free line of sight", "a line of sight past the arm"
AWAY, REACH = "the arm's length", "the arm's reach"
LIMITS, CLEARANCE = "the joints' limits", "the clearance"
_ADVICE = {
    IMAGE: "Look whether guesses, board and camera are the cell's; widen --distance-mm.",
    GUESS: "Measure more closely where camera and board are, or allow a greater distance.",
    FOCUS: "Widen --focus-mm, or set --distance-mm to where the image is sharp.",
    HIDDEN: "Look whether the boxes are where they stand, or put the board elsewhere.",
    BEHIND_ARM: "Put the camera where the arm comes less between it and the board, or hold the "
    "board farther away from the arm.",
    TILT: "Widen --tilt-deg, or turn the board towards the camera.",
    DISTANCE: "Widen --distance-mm, or put the board elsewhere.",
    AWAY: "Put the board nearer to the arm, allow smaller distances, or look whether the guesses "
    "are right.",
    REACH: "Put the board where the arm can look at it from all sides, or look whether the guesses "
    "are right.",
    LIMITS: "Put the board elsewhere, or look whether the limits are the robot's.",
    CLEARANCE: "Move one of the two, lower --clearance-mm, or look whether --box, --floor and "
    "guesses are right.",
}


# So many limits are named in a message, those that most was lost to.
_NAMED = 6


@dataclass
class Losses:
    """How many tries each limit let through, in the order in which they are looked at.

    Attributes:
        tried: How many came to each limit.
        lost: How many did not pass it.
        named: The same, with the joint or the pair of bodies where it is known.
    """

    tried: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)
    named: Counter[str] = field(default_factory=Counter)

    def passed(self, limit: str, good: Mask) -> Mask:
        """Counts what a limit lets through, and returns it."""
        self.tried[limit] += len(good)
        self.lost[limit] += int(np.sum(~good))
        return good

    def blame(self, limit: str, names: Sequence[str]) -> None:
        """Names what was in the way of tries that were lost to a limit."""
        self.named.update(f"{limit} ({name})" for name in names)

    def counts(self) -> Mapping[str, int]:
        """How many were lost to what, the most first."""
        counts = Counter(self.named)
        for limit, times in self.lost.items():
            known = sum(it for name, it in self.named.items() if name.startswith(f"{limit} ("))
            counts[limit] += times - known
        return {limit: times for limit, times in counts.most_common() if times > 0}

    def worst(self) -> str:
        """The limit that lets the smallest share through."""
        left = {it: 1.0 - self.lost[it] / tried for it, tried in self.tried.items() if tried}
        return min(left, key=lambda limit: left[limit])

    def error(self, found: int, wished: int) -> DataError:
        """The error of a search that found too few."""
        worst = self.worst()
        own = {name: it for name, it in self.counts().items() if name.startswith(f"{worst} (")}
        culprit = max(own, key=lambda name: own[name], default=worst)
        tried = max(self.tried.values())
        lost = some_of([f"{times} to {what}" for what, times in self.counts().items()], _NAMED)
        share = 100.0 * self.lost[worst] / self.tried[worst]
        return DataError(
            f"plan: {found} of {wished} possible stops were found in {tried} tries. Lost were "
            f"{lost}. Most in the way is {culprit}: {worst} kept out {share:.1f} % of the "
            f"{self.tried[worst]} that came so far.",
            culprits=[culprit],
            next_step=_ADVICE[worst],
        )
