"""The comparison of two checkouts finds a loss of a tenth, and no loss where there is none."""

from dataclasses import replace

import numpy as np
import pytest
from support.paired import Outcome, Pair, report

WORLDS, SEEDS = 12, 20


def pairs(rng, spread=0.2, **planted):
    """Outcomes of both sides: alike but for what another path of rounding and search changes.

    `planted`: factors of after's errors, NEES and processor time, in all worlds.
    """
    found = []
    for world in range(WORLDS):
        for seed in range(SEEDS):
            before = Outcome(
                "good" if rng.random() < 0.7 else "check",
                seconds=float(np.exp(rng.normal())),
                errors={"mm": float(np.exp(rng.normal(-2.0, 0.5)))},
                nees=float(rng.chisquare(6) / 6),
            )
            factor = {name: planted.get(name, 1.0) * float(np.exp(rng.normal(0.0, spread)))
                      for name in ("mm", "nees", "seconds")}  # fmt: skip
            after = replace(
                before,
                seconds=before.seconds * factor["seconds"],
                errors={"mm": before.errors["mm"] * factor["mm"]},
                nees=before.nees * factor["nees"],
            )
            found.append(Pair(f"world {world}", seed, before, after))
    return found


@pytest.mark.parametrize(
    ("planted", "what"),
    # A covariance that states sigmas a tenth too small has a NEES 1.21 times as large.
    [({"mm": 1.1}, "mm"), ({"nees": 1.21}, "NEES"), ({"seconds": 1.1}, "s")],
)
def test_a_loss_of_a_tenth_is_found_and_is_a_gain_the_other_way(planted, what):
    found = pairs(np.random.default_rng(1), **planted)
    text, odd = report(found)
    assert {item.what for item in odd} == {what}
    # Of one world alone, chance decides on which side of 1 the mean of 20 squares is.
    assert [item.is_worse for item in odd if item.world == "all worlds"] == [True]
    assert "worse: " in text.splitlines()[-1]
    back = report([Pair(pair.world, pair.seed, pair.after, pair.before) for pair in found])[1]
    assert [item.is_worse for item in back if item.world == "all worlds"] == [False]


def test_no_loss_is_no_finding():
    # One in twenty comparisons may find something; of forty, more than six by chance in 1 of 300.
    alarms = sum(bool(report(pairs(np.random.default_rng(seed)))[1]) for seed in range(40))
    assert alarms <= 6
    # Nor is what matters to nobody.
    for changes in ({"spread": 0.0}, {"spread": 1e-6, "mm": 1.005, "seconds": 1.02}):
        text, odd = report(pairs(np.random.default_rng(0), **changes))
        assert not odd
        assert text.endswith("within chance")


def with_after(found, every, **changes):
    """The same pairs, every so many with another outcome."""
    return [replace(pair, after=replace(pair.after, **changes)) if at % every == 0 else pair
            for at, pair in enumerate(found)]  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "what"),
    [({"status": "refused"}, "refused"), ({"status": "bug"}, "broken"),
     ({"status": "check"}, "good"), ({"beyond": True}, "good beyond 3 sigma")],
)  # fmt: skip
def test_verdicts_that_change_are_found(changes, what):
    found = with_after(pairs(np.random.default_rng(2), spread=0.0), 8, **changes)
    assert (what, True) in {(item.what, item.is_worse) for item in report(found)[1]}


def test_a_cause_that_is_no_longer_named_is_found_where_the_verdict_is_not_asked():
    found = [
        replace(pair, before=replace(pair.before, is_right=True, cause="moved", status="check"),
                after=replace(pair.after, is_right=at % 4 > 0, cause="moved", status="good"))
        for at, pair in enumerate(pairs(np.random.default_rng(3), spread=0.0))
    ]  # fmt: skip
    worlds = {item.what for item in report(found)[1] if item.world != "all worlds"}
    assert "good" not in worlds
    assert any(item.what == "cause named" and item.is_worse for item in report(found)[1])
