"""Cells that nobody chose, and all commands on some of them."""

import pytest
from support.fuzz.varied import walk
from support.marks import slow

# Together they have every kind of board, lens, mount and robot, two boards, every role, images that
# are torn, odd names, and all commands; the first two are run each time.
FIRST = (4,)
OTHERS = (1, 2, 3, *range(5, 25))
# Beyond this an error is no chance: in one cell of a million.
SURPRISING = 5.0


@pytest.mark.parametrize("seed", [*FIRST, *(slow(other) for other in OTHERS)])
def test_an_ordinary_cell_goes_through_all_commands(seed, tmp_path):
    done = walk(seed, tmp_path)
    assert not done.wrong
    assert not done.warned
    for command, status, said in done.steps:
        # The answer of some may be a bad verdict.
        assert status in (0, 2) or (status == 3 and command in ("calibrate", "verify")), said
        assert status == 0 or said.strip()
    if done.verdict == "good":
        assert done.sigmas < SURPRISING
