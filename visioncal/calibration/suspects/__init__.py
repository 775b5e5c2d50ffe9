"""Faults of a result: checks against limits, tests of its fit, causes, and the verdict."""
