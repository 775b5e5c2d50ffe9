"""What a verdict is made of, with nothing to doubt, and changes of it."""

from dataclasses import replace

from visioncal.calibration.suspects.judged import Findings, JudgedArm, JudgedPair, Sensor
from visioncal.core.directions import Direction
from visioncal.results import HELD_BACK, ViewResult


def directions(*sigmas):
    return tuple(
        Direction(f"the direction {at}", sigma, 5e-3, is_rotation=bool(at % 2))
        for at, sigma in enumerate(sigmas)
    )


LEFT_OUT = {"left_out_mm": 0.11, "left_out_deg": 0.011, "left_out_px": 0.12}


def views(count=20, **odd):
    """Views with like residuals, but for view 7 where `odd` says so."""
    plain = [ViewResult(at, True, "", 40, 0.1, 0.1, 0.01, **LEFT_OUT) for at in range(count)]
    return tuple(replace(view, **odd) if view.view == 7 else view for view in plain)


PAIR = JudgedPair(views())
SENSOR = Sensor(20, pixel_px=0.05)
ARM = JudgedArm(20, 0.1, 0.0057)
SOUND = Findings((PAIR,), (SENSOR,), (ARM,), directions(1e-4, 1e-4, 1e-4, 1e-4))
PARTS = {"pairs": PAIR, "sensors": SENSOR, "arms": ARM}


def changed(findings, **changes):
    """Findings with other values of their only pair, sensor and arm, or of their own.

    Residuals `rms`, `held_out` and `holdout` are those of every view.
    """
    (pair,) = findings.pairs
    shown = changes.get("views", pair.views)
    if rms := changes.pop("rms", None):
        shown = [replace(view, residual_mm=rms.mm, residual_deg=rms.deg) for view in shown]
    if held := changes.pop("held_out", None):
        shown = [replace(view, left_out_mm=held.mm, left_out_deg=held.deg) for view in shown]
    if back := changes.pop("holdout", None):
        figures = {"residual_mm": back.mm, "residual_deg": back.deg}
        shown = [*shown, ViewResult(90, False, HELD_BACK, **figures)]
    changes["views"] = shown
    for name, part in PARTS.items():
        part_changes = {
            change: changes.pop(change) for change in list(changes) if hasattr(part, change)
        }
        if part_changes:
            (now,) = getattr(findings, name)
            changes[name] = (replace(now, **part_changes),)
    return replace(findings, **changes)
