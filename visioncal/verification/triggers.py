"""Triggers of a recalibration: a failed check, a collision, other conditions, age."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

import numpy as np

from visioncal.results import Calibration
from visioncal.session import Session

State: TypeAlias = Literal["fired", "quiet", "unknown"]

# Quantities in words, with usual limit, unit and the column of the sessions that has it.
LIMITS = {
    "ambient_change_k": ("the ambient temperature's change", 10.0, "K", "ambient_c"),
    "payload_change_kg": ("the payload's change", 5.0, "kg", "payload_kg"),
    "age_days": ("the calibration's age", 365.0, "days", ""),
}


@dataclass(frozen=True)
class Trigger:
    """A reason to calibrate again, and whether it is given."""

    quantity: str  # The quantity that is compared.
    state: State  # Whether it fired, or could not be judged.
    words: str  # Its name, with figure and limit, or why the figure is unknown.
    limit: float | None = None  # The limit beyond which it fires; None for yes or no.
    value: float | None = None  # The figure that was compared; None where unknown.

    @property
    def document(self) -> dict[str, Any]:
        """The trigger's entry in verify.json; unknown values are absent."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def triggers_of(
    session: Session,
    calibration: Calibration,
    *,
    failed: bool,
    collision: bool,
    limits: Mapping[str, float | None] = MappingProxyType({}),
    now: datetime | None = None,
) -> tuple[Trigger, ...]:
    """Evaluates each trigger.

    Args:
        session: The check's session; its columns `ambient_c` and `payload_kg` are averaged.
        calibration: The checked calibration, with the mean conditions of its views.
        failed: Whether the check failed.
        collision: Whether a collision was reported.
        limits: Other limits than the usual ones by quantity; None where the usual one holds.
        now: The time; that of the clock where None.
    """
    triggers = [
        Trigger("failed_check", "fired" if failed else "quiet", "a failed check"),
        Trigger("collision", "fired" if collision else "quiet", "a collision"),
    ]
    for quantity, (label, usual, unit, column) in LIMITS.items():
        limit = usual if (stated := limits.get(quantity)) is None else stated
        found = (
            _change(session, calibration, column)
            if column
            else _age_days(calibration.created, now or datetime.now(UTC))
        )
        if isinstance(found, str):
            triggers.append(Trigger(quantity, "unknown", f"{label} ({found})", limit))
            continue
        words = f"{label}, {found:.4g} {unit} (limit {limit:g})"
        state: State = "fired" if found > limit else "quiet"
        triggers.append(Trigger(quantity, state, words, limit, found))
    return tuple(triggers)


def _change(session: Session, calibration: Calibration, column: str) -> float | str:
    """Change of a column's mean since the calibration; in words why it is unknown."""
    readings = [view.numbers[column] for view in session.views if column in view.numbers]
    if column not in calibration.means:
        return f"the views that were calibrated with do not all have {column}"
    if not readings:
        return f"the check's views have no {column}"
    return abs(float(np.mean(readings)) - calibration.means[column])


def _age_days(created: str, now: datetime) -> float | str:
    """Age of a calibration [days]; in words why it is unknown."""
    try:
        then = datetime.fromisoformat(created)
    except ValueError:
        return f"the calibration's time is {created!r}"
    then = then if then.tzinfo else then.replace(tzinfo=UTC)
    return round((now - then) / timedelta(days=1), 1)
