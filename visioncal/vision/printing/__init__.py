"""Printable boards: a target's dark shapes on a page, written at exact size."""
