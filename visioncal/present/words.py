"""What a result is made of, in words for people."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.number_format import decimals_for, fixed, signed, significant
from visioncal.results.arm import NOMINAL, ArmLevel, ArmParameter, ArmResult, JointSpring

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
# Without a sigma: about a hundredth of what an arm repeats to.
_DECIMALS = {"mm": 3, "\N{DEGREE SIGN}": 4}


@dataclass(frozen=True)
class ParameterRow:
    """A number of the arm's model, as text; `sure` where its change is beyond chance."""

    symbol: str
    unit: str
    nominal: str
    identified: str
    change: str
    sigma: str
    sure: bool


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


def _parameter_words(name: str) -> tuple[str, str, float]:
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


def parameter_row(it: ArmParameter) -> ParameterRow:
    """Writes a number of the arm's model with as many digits as its change is known to."""
    symbol, unit, scale = _parameter_words(it.name)
    sigma = None if it.sigma is None else scale * it.sigma
    decimals = decimals_for(sigma) if sigma else _DECIMALS.get(unit, 5)
    return ParameterRow(
        symbol,
        unit,
        # As stated, whatever is known of it now.
        f"{scale * it.nominal + 0.0:.7g}",
        fixed(scale * it.identified, decimals),
        signed(scale * it.change, decimals),
        f"\N{PLUS-MINUS SIGN} {significant(sigma)}" if sigma else "",
        it.is_sure,
    )


def spring_words(spring: JointSpring) -> tuple[str, str, str]:
    """Writes a joint's stiffness and its sigma [kN m/rad], and the torques on it [N m]."""
    stiffness, sigma = spring.stiffness_nm_per_rad, spring.stiffness_sigma_nm_per_rad
    low, high = (f"{round(it, 1) + 0.0:g}" for it in spring.torque_nm)
    return (
        "taken for rigid" if stiffness is None else f"{1e-3 * stiffness:.4g}",
        "" if sigma is None else significant(1e-3 * sigma),
        f"{low} to {high}",
    )
