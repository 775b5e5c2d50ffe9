"""Effects: vectors of unknowns that act on many observations together, one file each.

Delays within an image are estimated wherever a camera sees a moving target while the robot streams
its poses: each is a file, and an entry in `EFFECTS`.
"""

from visioncal.estimation.effects.delays import Delay
from visioncal.estimation.effects.rolling_shutter import ROLLING_SHUTTER

EFFECTS: tuple[Delay, ...] = (ROLLING_SHUTTER,)
