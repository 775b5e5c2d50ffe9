"""Marks of single cases of a test."""

from itertools import cycle, product

import pytest


def slow(*values):
    """A case that is left to the long run: another catches the same mistakes sooner."""
    return pytest.param(*values, marks=pytest.mark.slow)


def crossed(many, few):
    """All pairs of values; each value is in a pair that is run each time, and the others are slow.

    Args:
        many: The values of the first argument.
        few: Those of the second, no more of them.
    """
    quick = {*zip(many, cycle(few), strict=False)}
    return [pair if pair in quick else slow(*pair) for pair in product(many, few)]


def seeds(few, many):
    """The first seeds of a statistical test, and more of them that are left to the long run."""
    return [pytest.param(range(few), id=f"{few} seeds"), slow(range(many))]
