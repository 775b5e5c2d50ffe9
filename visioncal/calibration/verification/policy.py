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
# Yes or no quantities; quantities with a limit, by unit.
_FLAGS = ("failed_check", "collision")
_UNITS = {"ambient_change_k": "K", "payload_change_kg": "kg", "age_days": "days"}
_COLUMNS = {"ambient_change_k": "ambient_c", "payload_change_kg": "payload_kg"}
_LABELS = {
    "failed_check": "a failed check",
    "collision": "a collision",
    "ambient_change_k": "the ambient temperature's change",
    "payload_change_kg": "the payload's change",
    "age_days": "the calibration's age",
}


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


@dataclass(frozen=True)
class TriggerFacts:
    """Input of the triggers."""

    values: Mapping[str, float]  # Figures by quantity.
    flags: Mapping[str, bool]  # Yes or no, by quantity.
    unknown: Mapping[str, str]  # Why a figure is unknown, by quantity.


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
    quantity, known = table.text("quantity"), (*_FLAGS, *_UNITS)
    if quantity not in known:
        raise DataError(
            f"{label}: quantity is {quantity!r}; known are {', '.join(known)}.",
            culprits=[label],
            next_step=did_you_mean(quantity, known),
        )
    return Trigger(quantity, None if quantity in _FLAGS else table.number("limit", positive=True))


def facts_of(
    session: Session,
    calibration: Calibration,
    *,
    failed: bool,
    collision: bool,
    now: datetime | None = None,
) -> TriggerFacts:
    """Collects the input of the triggers.

    Args:
        session: The check's session; its columns `ambient_c` and `payload_kg` are averaged.
        calibration: The checked calibration, with the mean conditions of its views.
        failed: Whether the check failed.
        collision: Whether a collision was reported.
        now: The time; that of the clock where None.
    """
    values, unknown = {}, {}
    before = calibration.means
    for quantity, column in _COLUMNS.items():
        readings = [view.numbers[column] for view in session.views if column in view.numbers]
        if column not in before:
            unknown[quantity] = f"the views that were calibrated with do not all have {column}"
        elif not readings:
            unknown[quantity] = f"the check's views have no {column}"
        else:
            values[quantity] = abs(float(np.mean(readings)) - before[column])
    age_days = _age_days(calibration.created, now or datetime.now(UTC))
    if age_days is None:
        unknown["age_days"] = f"the calibration's time is {calibration.created!r}"
    else:
        values["age_days"] = age_days
    return TriggerFacts(values, {"failed_check": failed, "collision": collision}, unknown)


def _age_days(created: str, now: datetime) -> float | None:
    try:
        then = datetime.fromisoformat(created)
    except ValueError:
        return None
    then = then if then.tzinfo else then.replace(tzinfo=UTC)
    return round((now - then).total_seconds() / _DAY_S, 1)


def outcomes(policy: Sequence[Trigger], facts: TriggerFacts) -> tuple[Outcome, ...]:
    """Evaluates each trigger."""
    return tuple(_outcome(trigger, facts) for trigger in policy)


def _outcome(trigger: Trigger, facts: TriggerFacts) -> Outcome:
    quantity, limit, label = trigger.quantity, trigger.limit, _LABELS[trigger.quantity]
    if limit is None:
        return Outcome(trigger, "fired" if facts.flags[quantity] else "quiet", None, label)
    if quantity in facts.unknown:
        return Outcome(trigger, "unknown", None, f"{label} ({facts.unknown[quantity]})")
    value = facts.values[quantity]
    words = f"{label}, {value:.4g} {_UNITS[quantity]} (limit {limit:g})"
    return Outcome(trigger, "fired" if value > limit else "quiet", value, words)
