"""Marks of single cases of a test."""

import pytest


def slow(*values):
    """A case that is left to the long run: another catches the same mistakes sooner."""
    return pytest.param(*values, marks=pytest.mark.slow)
