"""Which reading of the poses is right: units, inverses, rotations, pairing, mount."""

from visioncal.calibration.guess.decide import guess_reading
from visioncal.calibration.guess.result import Candidate, Guess

__all__ = ["Candidate", "Guess", "guess_reading"]
