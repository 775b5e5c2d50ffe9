"""Triggers of a recalibration, from a policy table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import DocumentTable, read_toml
from visioncal.core.number_format import did_you_mean
from visioncal.results import Calibration
from visioncal.session import Session

State: TypeAlias = Literal["fired", "quiet", "unknown"]

_FILE = Path(__file__).with_name("policy.toml")
_DAY_S = 86400.0
# Names in words, with the units of quantities that have a limit; the others are yes or no.
_QUANTITIES = {
    "failed_check": ("a failed check", ""),
    "collision": ("a collision", ""),
    "ambient_change_k": ("the ambient temperature's change", "K"),
    "payload_change_kg": ("the payload's change", "kg"),
    "age_days": ("the calibration's age", "days"),
}
_COLUMNS = {"ambient_change_k": "ambient_c", "payload_change_kg": "payload_kg"}


@dataclass(frozen=True)
class Trigger:
    """A reason to calibrate again."""

    quantity: str  # The quantity that is compared.
    limit: float | None = None  # The limit beyond which it fires; None for a yes or no quantity.


@dataclass(frozen=True)
class Outcome:
    """Evaluation of one trigger."""

    trigger: Trigger  # The trigger.
    state: State  # Whether it fired, or could not be judged.
    # The figure that was compared with the limit; None for yes or no, and where unknown.
    value: float | None
    words: str  # Its name, with figure and limit, or why the figure is unknown.

    @property
    def document(self) -> dict[str, Any]:
        """Its entry in verify.json; unknown values are absent."""
        figures = {"limit": self.trigger.limit, "value": self.value}
        known = {name: figure for name, figure in figures.items() if figure is not None}
        stated = {"quantity": self.trigger.quantity, "state": self.state}
        return {**stated, **known, "words": self.words}


def load_policy(path: Path | None = None) -> tuple[Trigger, ...]:
    """Reads a table of triggers.

    Args:
        path: A custom file; the shipped one where None.

    Raises:
        DataError: The file is missing, or a trigger has an unknown quantity or no limit.
    """
    file = _FILE if path is None else path
    rows = read_toml(file, str(file)).get("trigger")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise DataError(
            f"{file}: it holds no [[trigger]].",
            culprits=[str(file)],
            next_step='Write [[trigger]], quantity = "age_days", limit = 365.0, and so on.',
        )
    return tuple(_trigger(row, f"{file}, trigger {at}") for at, row in enumerate(rows, start=1))


def _trigger(row: Mapping[str, Any], label: str) -> Trigger:
    table = DocumentTable(row, label)
    quantity = table.text("quantity")
    if quantity not in _QUANTITIES:
        raise DataError(
            f"{label}: quantity is {quantity!r}; known are {', '.join(_QUANTITIES)}.",
            culprits=[label],
            next_step=did_you_mean(quantity, _QUANTITIES),
        )
    has_limit = bool(_QUANTITIES[quantity][1])
    return Trigger(quantity, table.number("limit", positive=True) if has_limit else None)


def outcomes(
    policy: Sequence[Trigger],
    session: Session,
    calibration: Calibration,
    *,
    failed: bool,
    collision: bool,
    now: datetime | None = None,
) -> tuple[Outcome, ...]:
    """Evaluates each trigger.

    Args:
        policy: The triggers.
        session: The check's session; its columns `ambient_c` and `payload_kg` are averaged.
        calibration: The checked calibration, with the mean conditions of its views.
        failed: Whether the check failed.
        collision: Whether a collision was reported.
        now: The time; that of the clock where None.
    """
    flags = {"failed_check": failed, "collision": collision}
    evaluated = []
    for trigger in policy:
        quantity, limit = trigger.quantity, trigger.limit
        label, unit = _QUANTITIES[quantity]
        if limit is None:
            state: State = "fired" if flags[quantity] else "quiet"
            evaluated.append(Outcome(trigger, state, None, label))
            continue
        found = (
            _age_days(calibration.created, now or datetime.now(UTC))
            if quantity == "age_days"
            else _change(session, calibration, _COLUMNS[quantity])
        )
        if isinstance(found, str):
            evaluated.append(Outcome(trigger, "unknown", None, f"{label} ({found})"))
            continue
        words = f"{label}, {found:.4g} {unit} (limit {limit:g})"
        evaluated.append(Outcome(trigger, "fired" if found > limit else "quiet", found, words))
    return tuple(evaluated)


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
    return round((now - then).total_seconds() / _DAY_S, 1)
