"""The estimator's answers to sixty cells stay what they are."""

import pytest
from support.kept_answers import answer_of, away_in_sigmas, cases, kept, levels_apart, sigmas_apart

# Another processor's rounding moves a minimum by far less; what is known of any value is its sigma.
EDGE_SIGMAS = 1e-3
# A level is sought until it changes by 1e-4 of itself, and every sigma follows the levels.
LEVEL_SHARE = 2e-3


# Those of more than two seconds whose effect is in a quicker cell, too.
SLOW = {
    "cell, both", "cell, camera bumped", "cell, half seen", "cell, kinematics",
    "cell, lens estimated, one in hand", "cell, offsets", "cell, tracker", "cell, wrong arms",
    "cell, wrong arms as reported", "cell, wrong rows", "springs, 1",
    "sweep to hand", "tracker, places, wrong arm",
}  # fmt: skip
NAMES = [
    pytest.param(case, marks=pytest.mark.slow if case in SLOW else ()) for case in sorted(cases())
]


@pytest.mark.parametrize("name", NAMES)
def test_a_cell_has_the_answer_that_is_kept(name):
    answer, before = answer_of(cases()[name]), kept()[name]
    assert dict(answer.words) == before["words"]
    assert answer.edges.keys() == before["edges"].keys()
    assert away_in_sigmas(answer, before) < EDGE_SIGMAS
    assert sigmas_apart(answer, before) < LEVEL_SHARE
    assert levels_apart(answer, before) < LEVEL_SHARE


def test_kept_answers_are_those_of_the_cells():
    assert sorted(kept()) == sorted(cases())
