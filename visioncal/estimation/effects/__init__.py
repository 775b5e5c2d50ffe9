"""Effects: vectors of unknowns that act on many observations together, one file each.

Errors that grow with time, reach or gravity are a file and an entry in `RANDOM_EFFECTS`: from it
follow fit, covariance, budget, finding and rank.
"""

from visioncal.estimation.effects.base_creeps import BASE_CREEPS
from visioncal.estimation.effects.base_tilts import BASE_TILTS
from visioncal.estimation.effects.bracket_bends import BRACKET_BENDS
from visioncal.estimation.effects.lens_grows import LENS_GROWS
from visioncal.estimation.effects.random_effect import RandomEffect

RANDOM_EFFECTS: tuple[RandomEffect, ...] = (BASE_TILTS, BASE_CREEPS, BRACKET_BENDS, LENS_GROWS)
