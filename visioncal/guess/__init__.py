"""Which reading of the poses is right: units, inverses, rotations, pairing, mount."""

from visioncal.guess.decide import guess_reading
from visioncal.guess.result import Candidate, Guess

__all__ = ["Candidate", "Guess", "guess_reading"]
