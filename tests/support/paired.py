"""Paired comparisons of what two programs made of the same sessions, world by world.

An interval is one of 95 %, of a ratio or of a difference of shares. What differs beyond chance is
decided for all comparisons together (Holm 1979).
"""

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import binomtest, t

# A ratio nearer to 1 matters to nobody: 1 % of an error is a tenth of what any simulation here
# resolves; 3 % of processor time is what neighbours on the same machine change in a warm process.
ACCURACY, TIME = np.log(1.01), np.log(1.03)
# Probability of any false alarm in a whole comparison.
FALSE_ALARM = 0.05
ALL = "all worlds"


@dataclass(frozen=True)
class Outcome:
    """What one checkout made of one session."""

    status: str  # The verdict, or "refused", "bug" or "late".
    cause: str = ""  # The likeliest cause, or the class of a refusal; empty where there is none.
    seconds: float = float("nan")  # Processor time.
    # Errors by their unit; smaller is better, and only ratios count.
    errors: Mapping[str, float] = field(default_factory=dict)
    nees: float | None = None  # Squared error over covariance per degree of freedom.
    beyond: bool = False  # Whether the error is as unlikely as three sigma.
    # Whether the fault that the world has is named, or none where it has none.
    is_right: bool | None = None
    off: float | None = None  # Squared difference of a stated probability and what came true.


@dataclass(frozen=True)
class Pair:
    """What both checkouts made of one session of a world."""

    world: str
    seed: int
    before: Outcome
    after: Outcome


@dataclass(frozen=True)
class Change:
    """One comparison: the means, the interval of their paired ratio or difference, its chance."""

    world: str
    what: str  # What is compared.
    before: float  # Means; geometric ones of errors and times.
    after: float
    low: float  # The interval of 95 %.
    high: float
    chance: float  # Probability of a change at least so large where none is that matters.
    is_worse: bool

    def __str__(self) -> str:
        if self.before == self.after:
            return f"{self.before:.3g}"
        interval = f" ({self.low:.3g} to {self.high:.3g})" if np.isfinite(self.low) else ""
        return f"{self.before:.3g} -> {self.after:.3g}{interval}"


def of_ratios(world: str, what: str, pairs: Sequence[tuple[float, float]]) -> Change | None:
    """Paired t test of log ratios against those that do not matter."""
    logs = np.log([pair for pair in pairs if min(pair) > 0.0 and np.isfinite(pair).all()])
    if not len(logs):
        return None
    means, (low, high, chance) = logs.mean(axis=0), _interval(
        logs[:, 1] - logs[:, 0], TIME if what == "s" else ACCURACY
    )  # fmt: skip
    worse = means[1] > means[0]
    if what == "NEES":
        # A covariance is right at 1; the mean of its squares says whether it is.
        before, after = np.abs(np.log(np.exp(logs).mean(axis=0)))
        worse = after > before
    return Change(world, what, *np.exp([*means, low, high]).tolist(), chance, bool(worse))


def _interval(differences: np.ndarray, margin: float) -> tuple[float, float, float]:
    """95 % interval of a mean, and the chance that it is beyond the margin."""
    mean, freedom = differences.mean(), len(differences) - 1
    if freedom < 2:
        return float("nan"), float("nan"), 1.0
    error = differences.std(ddof=1) / np.sqrt(len(differences))
    half = float(t.isf(0.025, freedom)) * error
    beyond = max(abs(mean) - margin, 0.0)
    chance = 1.0 if beyond == 0.0 else 2.0 * t.sf(beyond / error, freedom) if error else 0.0
    return float(mean - half), float(mean + half), float(min(chance, 1.0))


def of_shares(
    world: str, what: str, pairs: Sequence[tuple[bool, bool]], *, wanted: bool
) -> Change | None:
    """Exact test of the pairs that differ (McNemar)."""
    if not pairs:
        return None
    before, after = np.mean(pairs, axis=0).tolist()
    gained = sum(after > before for before, after in pairs)
    lost = sum(after < before for before, after in pairs)
    chance = binomtest(gained, gained + lost).pvalue if gained + lost else 1.0
    shares = [int(after) - int(before) for before, after in pairs]
    half = 1.96 * float(np.std(shares)) / np.sqrt(len(shares))
    middle = after - before
    return Change(world, what, before, after, middle - half, middle + half, float(chance),
                  (after < before) == wanted)  # fmt: skip


def changes(world: str, pairs: Sequence[Pair]) -> Iterator[Change]:
    """All comparisons of a world."""
    answered = [pair for pair in pairs if pair.before.errors and pair.after.errors]
    found: list[Change | None] = []
    for unit in dict.fromkeys(unit for pair in answered for unit in pair.before.errors):
        sizes = [(pair.before.errors[unit], pair.after.errors[unit]) for pair in answered
                 if unit in pair.before.errors and unit in pair.after.errors]  # fmt: skip
        found.append(of_ratios(world, unit, sizes))
    squares = [(pair.before.nees, pair.after.nees) for pair in pairs]
    found.append(of_ratios(world, "NEES", [two for two in squares if None not in two]))
    times = [(pair.before.seconds, pair.after.seconds) for pair in pairs]
    found.append(of_ratios(world, "s", times))
    offs = [(pair.before.off, pair.after.off) for pair in pairs if pair.before.off is not None]
    offs = [two for two in offs if None not in two]
    if offs:
        array = np.array(offs, dtype=float)
        low, high, chance = _interval(array[:, 1] - array[:, 0], 0.0)
        means = array.mean(axis=0).tolist()
        found.append(Change(world, "need", *means, low, high, chance, means[1] > means[0]))
    for what, wanted, is_so in (
        ("refused", False, lambda one: one.status == "refused"),
        ("broken", False, lambda one: one.status in ("bug", "late")),
        ("good", True, lambda one: one.status in ("good", "pass")),
        ("good beyond 3 sigma", False, lambda one: one.status == "good" and one.beyond),
    ):
        flags = [(is_so(pair.before), is_so(pair.after)) for pair in pairs]
        found.append(of_shares(world, what, flags, wanted=wanted))
    named = [(pair.before.is_right, pair.after.is_right) for pair in pairs]
    named = [two for two in named if None not in two]
    found.append(of_shares(world, "cause named", named, wanted=True))
    # What is right in a world with a fault is its cause, and no verdict is.
    is_faulty = world != ALL and bool(named)
    yield from (item for item in found if item and not (is_faulty and item.what == "good"))


def beyond_chance(found: Sequence[Change]) -> list[Change]:
    """Those that differ where as many are compared (Holm's limits)."""
    ordered = sorted(found, key=lambda item: item.chance)
    kept = itertools.takewhile(
        lambda pair: pair[1].chance * (len(ordered) - pair[0]) < FALSE_ALARM, enumerate(ordered)
    )
    return [item for _, item in kept]


def report(pairs: Sequence[Pair]) -> tuple[str, list[Change]]:
    """The table with its last line, and what differs beyond chance."""
    groups = {name: [pair for pair in pairs if pair.world == name]
              for name in sorted({pair.world for pair in pairs})}  # fmt: skip
    groups[ALL] = list(pairs)
    compared = {name: {item.what: item for item in changes(name, of)}
                for name, of in groups.items()}  # fmt: skip
    errors = dict.fromkeys(unit for pair in pairs for unit in pair.before.errors)
    columns = [*errors, "NEES", "need", "s", "good beyond 3 sigma", "cause named", "refused",
               "broken"]  # fmt: skip
    columns = [name for name in columns
               if any(name in row and row[name].before + row[name].after > 0.0
                      for row in compared.values())]  # fmt: skip
    lines = [["world", "sessions", "verdicts", *columns, "other first causes"],
             ["---"] * (len(columns) + 4)]  # fmt: skip
    for name, of in groups.items():
        sides = [Counter(side) for side in zip(*((pair.before.status, pair.after.status)
                                                for pair in of), strict=True)]  # fmt: skip
        words = [", ".join(f"{count} {status}" for status, count in sorted(side.items()))
                 for side in sides]  # fmt: skip
        others = Counter(f"{pair.before.cause or 'none'} -> {pair.after.cause or 'none'}"
                         for pair in of if pair.before.cause != pair.after.cause)  # fmt: skip
        lines.append([
            name, str(len(of)), words[0] if words[0] == words[1] else " -> ".join(words),
            *(str(compared[name].get(column, "")) for column in columns),
            ", ".join(f"{count} {kind}" for kind, count in others.most_common(3)),
        ])  # fmt: skip
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    odd = beyond_chance([item for row in compared.values() for item in row.values()])
    parts = [
        f"{word}: " + "; ".join(f"{item.world}, {item.what} {item}" for item in of)
        for word, of in (("worse", [item for item in odd if item.is_worse]),
                         ("better", [item for item in odd if not item.is_worse])) if of
    ]  # fmt: skip
    return f"{table}\n\n{'. '.join(parts) or 'within chance'}", odd
