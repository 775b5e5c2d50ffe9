"""Whether temperatures explain how the views move in the course of a session."""

from collections.abc import Iterator

from visioncal.errors import DataError, DegenerateError
from visioncal.estimation.arm import SIGNIFICANT
from visioncal.figures import figure
from visioncal.files import some_of
from visioncal.thermal import ThermalFit

LEVEL = "thermal"
_ADVICE = (
    "Begin with a cold robot, let it work for an hour or more, and look at the same few reference "
    "views every five to ten minutes."
)


def refuse_missing(missing: str) -> DataError:
    """The error of a session that lacks what the level needs."""
    return DataError(
        f"level {LEVEL!r} needs to know what heats the arm: {missing}.",
        culprits=["level"],
        next_step="Record temp1_c ... or current1_a ... with stamp_s in streams/NAME.csv, and "
        "stamp_s, q1_rad ... with every view.",
    )


def refuse_uninformative(why: str) -> DegenerateError:
    """The error of a session all of whose views were taken about equally warm."""
    return DegenerateError(
        f"thermal: {why}: the views do not tell how the arm drifts.",
        culprits=["temperatures"],
        next_step=_ADVICE,
    )


def is_found(fit: ThermalFit) -> bool:
    """Whether drift explains the views by more than chance."""
    return fit.gain > SIGNIFICANT


def findings(fit: ThermalFit) -> Iterator[str]:
    """Says what was found, for the verdict."""
    if not is_found(fit):
        yield (
            f"The joints warmed up by {figure(float(fit.rises_k.max()))} K, and the views show no "
            "drift with it beyond chance: none is compensated."
        )
        return
    yield (
        f"The arm drifts with its temperature: residuals of {figure(1e3 * fit.before_m)} mm become "
        f"{figure(1e3 * fit.after_m)} mm. Its transforms are those of the arm as it was at the "
        "start; give temperatures to calibration.base_from_flange and to visioncal correct."
    )
    # Currents tell a gain and a growth by their product alone.
    measured = fit.model.heating.kind == "temperatures"
    counted = ("growth", "drift") if measured else ("drift",)
    names = [it for it in fit.not_told if it.startswith(counted)]
    if names:
        yield (
            f"The views do not tell {some_of(names, 6)}: what is known of arms, steel and "
            "aluminium stands for these."
        )
