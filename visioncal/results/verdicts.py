"""A verdict in calibration.json."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

from visioncal.core.codec import DROPPED, Written
from visioncal.core.verdict import Finding, Step, Verdict, VerdictStatus


@dataclass(frozen=True, kw_only=True)
class CauseForm:
    """What may be why a result is not good.

    Attributes:
        cause: What it is, as a short name that stays.
        probability: How likely it is.
        sentence: What it is, with its figures.
        without_it: What the result would be without it, in a sentence; absent where not computed.
        do: What to do about it, with a command where one does it.
    """

    cause: str
    probability: float
    sentence: str
    without_it: Annotated[str, DROPPED] = ""
    do: Annotated[str, DROPPED] = ""

    @classmethod
    def of(cls, found: Finding) -> "CauseForm":
        """Writes a finding that may be the cause."""
        return cls(
            cause=found.kind,
            probability=found.probability,
            sentence=found.words,
            without_it=found.without_it,
            do="" if found.do is None else str(found.do),
        )

    def finding(self, words: str) -> Finding:
        """Reads it, with the words of a reason that begins with its sentence."""
        step = Step(self.do) if self.do else None
        return Finding(
            self.cause, words, step, probability=self.probability, without_it=self.without_it
        )


@dataclass(frozen=True, kw_only=True)
class VerdictForm:
    """Whether a result can be trusted.

    Attributes:
        status: In one word.
        reasons: Why, in plain sentences.
        good_for_mm: The least need that it would be good for [mm]; absent where it is good for
            none.
        causes: What may be why it is not good, likeliest first.
        findings: The reasons one by one; absent in files of earlier versions.
    """

    status: VerdictStatus
    reasons: tuple[str, ...]
    good_for_mm: float | None = None
    causes: tuple[CauseForm, ...] = ()
    findings: tuple[Finding, ...] | None = None

    @classmethod
    def of(cls, verdict: Verdict) -> "VerdictForm":
        """Writes a verdict."""
        return cls(
            status=verdict.status,
            reasons=verdict.reasons,
            good_for_mm=verdict.good_for_mm,
            causes=tuple(map(CauseForm.of, verdict.causes)),
            findings=verdict.findings,
        )

    def verdict(self, _: str) -> Verdict:
        """Reads it."""
        found = tuple(self._earlier()) if self.findings is None else self.findings
        return Verdict(self.status, found, self.good_for_mm)

    def _earlier(self) -> Iterator[Finding]:
        """Findings of reasons and causes, of which a reason may begin with a cause's sentence."""
        causes = {it.sentence: it for it in self.causes}
        for reason in self.reasons:
            begun = next((it for it in causes if reason.startswith(it)), None)
            if begun is None:
                yield Finding("remark", reason)
            else:
                yield causes.pop(begun).finding(reason)
        yield from (it.finding(sentence) for sentence, it in causes.items())


StoredVerdict = Annotated[Verdict, Written(VerdictForm.of, VerdictForm.verdict, VerdictForm)]
