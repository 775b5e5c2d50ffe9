"""Whether a tool's or a fixture's frame can be trusted, in plain sentences."""

from collections.abc import Sequence
from dataclasses import dataclass

from visioncal.calibration import Verdict, VerdictStatus


@dataclass(frozen=True)
class Doubt:
    """A reason not to trust a frame, and whether it settles the matter."""

    sentence: str
    is_fatal: bool = False


def verdict_of(doubts: Sequence[Doubt], praise: str) -> Verdict:
    """Makes a verdict: `bad` with a reason that settles it, `check` with doubts, else `good`."""
    if not doubts:
        return Verdict("good", (praise,))
    status: VerdictStatus = "bad" if any(it.is_fatal for it in doubts) else "check"
    ordered = sorted(doubts, key=lambda it: not it.is_fatal)
    return Verdict(status, tuple(it.sentence for it in ordered))
