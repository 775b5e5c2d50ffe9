"""Effects: vectors of unknowns that act on many observations together, one file each.

Errors that grow with time, reach or gravity are a file and an entry in `RANDOM_EFFECTS`: from it
follow fit, covariance, budget, finding and rank.
"""

from visioncal.estimation.effects.base_creeps import BaseCreeps
from visioncal.estimation.effects.base_tilts import BaseTilts
from visioncal.estimation.effects.bracket_bends import BracketBends
from visioncal.estimation.effects.lens_grows import LensGrows
from visioncal.estimation.effects.random_effect import RandomEffect
from visioncal.estimation.effects.stops_short import StopsShort

RANDOM_EFFECTS: tuple[RandomEffect, ...] = (
    BaseTilts(),
    BaseCreeps(),
    BracketBends(),
    LensGrows(),
    StopsShort(),
)
