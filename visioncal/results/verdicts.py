"""The verdict and the need in calibration.json."""

from collections.abc import Mapping
from typing import Any, get_args

from visioncal.core.types import Need
from visioncal.results.parts import Cause, NeedMet, Picker, Verdict, VerdictStatus


def verdict_document(verdict: Verdict) -> dict[str, Any]:
    """Writes a verdict; what was not computed is absent."""
    document: dict[str, Any] = {"status": verdict.status, "reasons": list(verdict.reasons)}
    if verdict.good_for_mm is not None:
        document["good_for_mm"] = verdict.good_for_mm
    if verdict.causes:
        document["causes"] = [
            {name: it for name, it in vars(cause).items() if it != ""} for cause in verdict.causes
        ]
    return document


def read_verdict(document: Mapping[str, Any]) -> Verdict:
    """Reads what `verdict_document` wrote.

    Raises:
        ValueError: The status is none.
    """
    if document["status"] not in get_args(VerdictStatus):
        raise ValueError(f"verdict.status is {document['status']!r}")
    return Verdict(
        document["status"],
        tuple(document["reasons"]),
        document.get("good_for_mm"),
        tuple(Cause(**it) for it in document.get("causes", ())),
    )


def need_document(met: NeedMet | None) -> dict[str, Any]:
    """Writes what the task needs as `need`; nothing where that is not said."""
    if met is None:
        return {}
    need = met.need
    at = need.at if need.at == "views" else list(need.at)
    document: dict[str, Any] = {
        "mm": need.mm,
        "deg": need.deg,
        "at": at,
        "probability": met.probability,
    }
    if met.pairs:
        document["pairs"] = [vars(it) for it in met.pairs]
    return {"need": {name: it for name, it in document.items() if it is not None}}


def read_need(document: Mapping[str, Any]) -> NeedMet | None:
    """Reads what `need_document` added to a document.

    Raises:
        ValueError: It names no place.
    """
    found = document.get("need")
    if found is None:
        return None
    at = found["at"]
    if at != "views":
        x, y, z = map(float, at)
        at = (x, y, z)
    need = Need(found.get("mm"), found.get("deg"), at)
    pairs = tuple(Picker(**it) for it in found.get("pairs", ()))
    return NeedMet(need, found["probability"], pairs)
