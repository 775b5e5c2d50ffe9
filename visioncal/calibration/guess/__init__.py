"""Search for the right reading of recorded poses: units, inverses, rotations, pairing, mount."""

from visioncal.calibration.guess.decide import (
    NO_READING,
    ONE_AXIS,
    POSE_OPTIONS,
    Guess,
    guess_reading,
)
from visioncal.calibration.guess.fit import CAMERA_OVER_BOARD, SWITCH_OFF, are_of_camera
from visioncal.calibration.guess.readings import Hypothesis
from visioncal.calibration.guess.recording import CLEAR, FEWEST_ROWS, Candidate
