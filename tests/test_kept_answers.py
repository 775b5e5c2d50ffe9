"""The estimator's answers to sixty cells stay what they are."""

import pytest
from kept_answers import answer_of, away_in_sigmas, cases, kept, levels_apart, sigmas_apart

# Another processor's rounding moves a minimum by far less; what is known of any value is its sigma.
EDGE_SIGMAS = 1e-3
# A level is sought until it changes by 1e-4 of itself, and every sigma follows the levels.
LEVEL_SHARE = 2e-3


@pytest.mark.parametrize("name", sorted(cases()))
def test_a_cell_has_the_answer_that_is_kept(name):
    answer, before = answer_of(cases()[name]), kept()[name]
    assert dict(answer.words) == before["words"]
    assert answer.edges.keys() == before["edges"].keys()
    assert away_in_sigmas(answer, before) < EDGE_SIGMAS
    assert sigmas_apart(answer, before) < LEVEL_SHARE
    assert levels_apart(answer, before) < LEVEL_SHARE


def test_kept_answers_are_those_of_the_cells():
    assert sorted(kept()) == sorted(cases())
