"""Estimation of a cell: one problem of blocks over a tree of frames, and its solver."""
