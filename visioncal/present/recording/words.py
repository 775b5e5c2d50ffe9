"""What a result is made of, in words for people."""

import numpy as np

from visioncal.results.arm import NOMINAL, ArmLevel, ArmParameter, ArmResult

# What each source of uncertainty is, for people.
SOURCES = {
    "pixels": "noise of the corners",
    "instrument": "the instrument's readings",
    "robot": "the robot, from stop to stop",
    "poses": "noise of the poses",
    "intrinsics": "uncertainty of the lens",
    "board": "uncertainty of the board",
    "arm": "errors of the arm's links",
    "temperature": "uncertainty of the arm's drift with temperature",
    "priors": "what was measured by hand",
    "held_values": "values that are held",
    "noise_level": "how well the robot's noise is known",
    "lens_field": "the lens beyond its model",
    "misfit": "neighbouring stops that err alike",
}
# What each level frees, for people.
LEVELS = {
    NOMINAL: "the arm as stated",
    "backlash": "play of the joints",
    "offsets": "offsets of the joints",
    "geometry": "geometry of the links",
    "eccentricity": "geometry and eccentric gears",
    "elastic": "geometry, gears, and joints that bend",
    "functions": "geometry, gears, gravity, and functions of the joints",
}
_SYMBOLS = {
    "theta": "\N{GREEK SMALL LETTER THETA}",
    "alpha": "\N{GREEK SMALL LETTER ALPHA}",
    "beta": "\N{GREEK SMALL LETTER BETA}",
    "sine": "eccentricity, sine",
    "cosine": "eccentricity, cosine",
    "ratio": "gear ratio",
}
# Units on disk with those for people, and how many of these one of them is.
_UNITS = {"_m": ("mm", 1e3), "_rad": ("\N{DEGREE SIGN}", float(np.rad2deg(1.0)))}


def joint_words(name: str) -> str:
    """A joint's name for people."""
    return name.replace("_", " ")


def level_words(name: str) -> str:
    """What a level of the arm's model frees."""
    return LEVELS.get(name, name.replace("_", " "))


def level_reason(arm: ArmResult) -> str:
    """Why this level was taken, or none, in one sentence."""
    if not arm.is_calibrated:
        return (
            "No level was taken: none predicts stops that are left out of the fit better than "
            "the arm as stated does, beyond chance."
        )
    return (
        f"Taken: {level_words(arm.level)}. It predicts stops that are left out of the fit to "
        f"{_held_out(arm.chosen)}, the arm as stated to {_held_out(arm.nominal)}."
    )


def _held_out(level: ArmLevel) -> str:
    turned = "" if level.held_out_deg is None else f" and {level.held_out_deg:.2g} deg"
    return f"{level.held_out_mm:.2g} mm{turned}"


def parameter_words(name: str) -> tuple[str, str, float]:
    """A parameter's symbol, its unit for people, and how many of these one on disk is."""
    suffix = next((it for it in _UNITS if name.endswith(it)), "")
    unit, scale = _UNITS.get(suffix, ("", 1.0))
    stem = name.removesuffix(suffix)
    return _SYMBOLS.get(stem, stem.replace("_", " ")), unit, scale


def by_joint(arm: ArmResult) -> dict[str, list[ArmParameter]]:
    """The parameters by their joint."""
    groups: dict[str, list[ArmParameter]] = {}
    for it in arm.parameters:
        groups.setdefault(it.joint, []).append(it)
    return groups
