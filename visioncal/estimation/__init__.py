"""Estimation: the problem of a cell over its tree of frames, its residuals, and its solver."""
