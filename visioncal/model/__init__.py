"""A cell's sightings, and all that they depend on: frames, arms, boards, sightings, effects."""

from visioncal.model.arm import Arm as Arm
from visioncal.model.arm import Moments as Moments
from visioncal.model.arm import Reported as Reported
from visioncal.model.arm import Swept as Swept
from visioncal.model.cell import Cell as Cell
from visioncal.model.reading import read_cell as read_cell
from visioncal.model.sightings import MeasuredPlace as MeasuredPlace
from visioncal.model.sightings import MeasuredPose as MeasuredPose
from visioncal.model.sightings import Sighting as Sighting
