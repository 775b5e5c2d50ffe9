"""What stops that were approached from both sides say of the play in the joints."""

from collections.abc import Iterator, Sequence

import numpy as np

from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.estimation.armmodel import BACKLASH, ArmModel
from visioncal.results.arm import JointBacklash


def plays_of(model: ArmModel, covariance: FloatArray) -> tuple[JointBacklash, ...]:
    """Tells the play of each joint; nothing where stops did not come from both sides.

    Joints lag. Where they lead as a whole, the column approach says which way they moved.

    Args:
        model: The arm.
        covariance: (p, p) covariance of its errors.
    """
    if BACKLASH not in model.weights:
        return ()
    place = model.place_of(BACKLASH)
    sigmas = model.weights[BACKLASH] * np.sqrt(np.diag(covariance)[place])
    names = model.nominal.joint_names
    sign = np.copysign(1.0, np.sum(model.backlash / sigmas**2))
    columns = zip(names, (sign * model.backlash).tolist(), sigmas.tolist(), strict=True)
    return tuple(JointBacklash(name, band, sigma) for name, band, sigma in columns)


def remarks(plays: Sequence[JointBacklash]) -> Iterator[str]:
    """Says which joints have play, for the verdict."""
    sure = [it for it in plays if it.is_sure]
    if not sure:
        return
    words = ", ".join(
        f"{it.joint} {figure(1e3 * abs(it.deadband_rad))} +- {figure(1e3 * it.sigma_rad)} mrad"
        for it in sure
    )
    yield (
        f"Joints have play: {words}. The calibrated arm stands in the middle of it: approach every "
        "stop from the same side where half of that matters."
    )
