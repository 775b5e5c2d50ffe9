"""Fits in which some sightings say nothing of their poses, by brute force."""

from dataclasses import replace

import numpy as np

from visioncal.fit.assemble import mixed_model


def without_poses(fit, rows):
    """The fit in which an (n,) mask of sightings have poses of their own, at the same sizes."""
    grams = []
    for gram in fit.grams:
        one = rows[gram.rows]
        parts = [beside_pose(part, one) for part in gram.parts]
        grams.append(replace(gram, parts=tuple(parts)))
    mixed = mixed_model(fit.cell, fit.unknowns, fit.linearised, grams, fit.used)
    estimate = mixed.at(fit.estimate.logs)
    return replace(fit, mixed=mixed, used=fit.used & ~rows, estimate=estimate)


def beside_pose(part, rows):
    """Products of rows of one size, less what poses of their own explain of a mask of them."""
    if part.posed.shape[1]:
        # What poses explain stands apart from the rest.
        left = 1.0 * (~rows | (part.sign < 0))
        names = ("heads", "pulls", "squares", "posed")
        return replace(part, **{name: (getattr(part, name).T * left).T for name in names})
    heads, h = part.heads.copy(), part.heads.shape[1]
    functions = part.functions.shape[1]
    posed = np.zeros((len(heads), 6, 2 * functions))
    pulls, squares = part.pulls.copy(), part.squares.copy()
    for row in np.flatnonzero(rows):
        head = part.heads[row, :6]
        inverse = np.linalg.pinv(head[:, :6], hermitian=True)
        heads[row] -= head[:, :h].T @ inverse @ head
        pulls[row] -= head[:, -1] @ inverse @ head[:, h:-1]
        squares[row] -= head[:, -1] @ inverse @ head[:, -1]
        if functions:
            posed[row] = np.linalg.cholesky(inverse).T @ head[:, h:-1]
    return replace(part, heads=heads, pulls=pulls, squares=squares, posed=posed, sign=-1.0)
