"""The verdict and the need in calibration.json."""

from collections.abc import Iterator, Mapping
from typing import Any, get_args

from visioncal.core.types import Need
from visioncal.core.verdict import Finding, Step, Verdict, VerdictStatus
from visioncal.results.parts import NeedMet, Picker


def verdict_document(verdict: Verdict) -> dict[str, Any]:
    """Writes a verdict; what was not computed is absent."""
    document: dict[str, Any] = {"status": verdict.status, "reasons": list(verdict.reasons)}
    if verdict.good_for_mm is not None:
        document["good_for_mm"] = verdict.good_for_mm
    if verdict.causes:
        document["causes"] = [_cause_document(it) for it in verdict.causes]
    document["findings"] = [_finding_document(it) for it in verdict.findings]
    return document


def _cause_document(found: Finding) -> dict[str, Any]:
    document = {
        "cause": found.kind,
        "probability": found.probability,
        "sentence": found.words,
        "without_it": found.without_it,
        "do": "" if found.do is None else str(found.do),
    }
    return {name: it for name, it in document.items() if it != ""}


def _finding_document(found: Finding) -> dict[str, Any]:
    step = found.do
    document = {
        "kind": found.kind,
        "words": found.words,
        "do": step and {name: it for name, it in vars(step).items() if it},
        "views": list(found.views),
        "probability": found.probability,
        "without_it": found.without_it,
    }
    return {name: it for name, it in document.items() if it}


def read_verdict(document: Mapping[str, Any]) -> Verdict:
    """Reads what `verdict_document` wrote, or what was written before findings were.

    Raises:
        ValueError: The status is none.
    """
    if document["status"] not in get_args(VerdictStatus):
        raise ValueError(f"verdict.status is {document['status']!r}")
    written = document.get("findings")
    findings = _earlier(document) if written is None else map(_read_finding, written)
    return Verdict(document["status"], tuple(findings), document.get("good_for_mm"))


def _read_finding(document: Mapping[str, Any]) -> Finding:
    step = document.get("do")
    return Finding(
        document["kind"],
        document["words"],
        None if step is None else Step(step["words"], step.get("command", "")),
        tuple(document.get("views", ())),
        document.get("probability", 0.0),
        document.get("without_it", ""),
    )


def _earlier(document: Mapping[str, Any]) -> Iterator[Finding]:
    """Findings of reasons and causes, of which a reason may begin with a cause's sentence."""
    causes = {it["sentence"]: it for it in document.get("causes", ())}
    for reason in document["reasons"]:
        begun = next((it for it in causes if reason.startswith(it)), None)
        if begun is None:
            yield Finding("remark", reason)
        else:
            yield _of_cause(causes.pop(begun), reason)
    yield from (_of_cause(it, sentence) for sentence, it in causes.items())


def _of_cause(cause: Mapping[str, Any], words: str) -> Finding:
    step = Step(cause["do"]) if cause.get("do") else None
    without_it = cause.get("without_it", "")
    return Finding(
        cause["cause"], words, step, probability=cause["probability"], without_it=without_it
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
