"""Effects: vectors of unknowns that move many observations together, one file each.

Those of time within an image are looked for wherever a camera sees a moving target beside a
robot's stream: an effect of the kind is a file, and its entry in `EFFECTS`.
"""

from visioncal.estimation.effects.delays import Delay
from visioncal.estimation.effects.rolling_shutter import ROLLING_SHUTTER

EFFECTS: tuple[Delay, ...] = (ROLLING_SHUTTER,)
