"""Search for the right reading of recorded poses: units, inverses, rotations, pairing, mount."""

from visioncal.calibration.guess.decide import guess_reading
from visioncal.calibration.guess.result import Candidate, Guess

__all__ = ["Candidate", "Guess", "guess_reading"]
