"""The answers to sixty cells and to real recordings stay what they are, and so do messages."""

import pytest
from support.fuzz.broken_sessions import BROKEN
from support.kept_answers import REAL, away_in_sigmas, cases, checkup_of, kept, sizes_apart

# Beside an edge's own uncertainty, no user sees another estimator that is a fifth of it away.
EDGE_SIGMAS = 0.2
# Sizes of noise and sigmas from 20 views are themselves known to 15 %.
SIZE_SHARE = 0.15
# A message's figures are such sizes, with two digits: rounded by up to 5 % more.
FIGURE_SHARE = 0.2

# Those whose effect is in a quicker cell, too.
SLOW = {
    "bow, 1", "cell",
    "2 wrong, 1", "6 wrong, 1", "two boards, 1",
    "2 wrong to hand, 1", "4 wrong to hand, 1", "cell, board moved", "lens 1 px off to hand, 1",
    "to hand, lens estimated, 1", "two boards, 3 wrong, 1", "wrong arm to hand, 1",
    "wrong arm, 2", "wrong arm, 3 wrong, 1", "wrong arm, two boards, 1", "4 wrong, 1",
    "in hand, lens estimated, 2", "in hand, lens given, 2", "to hand, lens given, 2",
    "wrong arm, poses to hand, 1",
    "cell, both", "cell, camera bumped", "cell, half seen", "cell, kinematics",
    "cell, lens estimated, one in hand", "cell, offsets", "cell, tracker", "cell, wrong arms",
    "cell, wrong arms as reported", "cell, wrong rows", "springs, 1",
    "sweep to hand", "tracker, places, wrong arm",
    "springs, loads, 1", "sweep", "eccentricity, 1", "translation, 1", "backlash, 1",
    "6 wrong to hand, 1", "wrong arm, 1", "one axis, 1", "two boards to hand, 1",
    "to hand, lens estimated, 2", "lens 1 px off, 1",
    "sound arm, 1", "wrong arm, poses, 1", "coarse robot, 1", "small tilts, 1", "6 views, 1",
}  # fmt: skip
# Of each kind of message one.
QUICK = {"two images missing"}


def slow(names, is_slow):
    """The names, of which some are slow."""
    return [pytest.param(name, marks=pytest.mark.slow if is_slow(name) else ()) for name in names]


def assert_same_message(found, before):
    """The same kind with the same figures."""
    (kind, figures), (kind_before, figures_before) = found, before
    assert kind == kind_before
    assert figures == pytest.approx(figures_before, rel=FIGURE_SHARE)


@pytest.mark.parametrize("name", slow(sorted(cases()), lambda name: name in SLOW or "real" in name))
def test_a_cell_has_the_answer_that_is_kept(name):
    answer, before, said = cases()[name](), kept()[name], kept("messages")[name]
    assert answer.status == before["status"]
    assert answer.edges.keys() == before["edges"].keys()
    assert away_in_sigmas(answer, before) < EDGE_SIGMAS
    assert sizes_apart(answer, before) < SIZE_SHARE
    if answer.status == "refused":
        assert_same_message(answer.message, said[0])
    else:
        # What a cause's figures are follows the estimate; what it is does not.
        kinds = [] if answer.message is None else [answer.message[0]]
        assert kinds == [kind for kind, _ in said]


@pytest.mark.parametrize("name", slow(BROKEN, lambda name: name not in QUICK))
def test_a_broken_session_has_the_messages_that_are_kept(name):
    for found, before in zip(checkup_of(name), kept("messages")[name], strict=True):
        assert_same_message(found, before)


def test_kept_answers_are_those_of_the_cells():
    names = {name for name in kept() if REAL.is_dir() or not name.startswith("real")}
    assert names == set(cases())
    assert kept("messages").keys() == kept().keys() | BROKEN.keys()
