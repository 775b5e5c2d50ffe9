"""Shape of printed boards and rigs: derivatives of their corners, and stated sizes."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.types import FloatArray, Target
from visioncal.vision.targets import corner_positions

SCALE, ASPECT, SHEAR = 0, 1, 9  # Places among a shape's values.
_BENDS = slice(2, 9)
# Files use the same order; shear was added last.
BOARD_NAMES = (
    "scale",
    "aspect",
    *(f"bow_{name}" for name in (["xx", "xy", "yy", "xxx", "xxy", "xyy", "yyy"])),
    "shear",
)
# Exponents of the polynomial's terms.
_POWERS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))


def board_basis(positions: FloatArray) -> FloatArray:
    """Derivatives of the corner positions with respect to the board's shape.

    Args:
        positions: (c, 3) corners of the flat board, in the target's frame [m].

    Returns:
        (c, 3, 10) in the order of `BOARD_NAMES`; bows are in metres at the board's edge.
    """
    middle = (positions.min(axis=0) + positions.max(axis=0)) / 2
    half = float(np.ptp(positions, axis=0).max()) / 2
    u, v = ((positions - middle) / half)[:, :2].T
    basis = np.zeros((len(positions), 3, len(BOARD_NAMES)))
    basis[:, :, SCALE] = positions
    basis[:, 0, ASPECT], basis[:, 1, ASPECT] = -positions[:, 0] / 2, positions[:, 1] / 2
    basis[:, :2, SHEAR] = positions[:, 1::-1] / 2
    bows = np.stack([u**a * v**b for a, b in _POWERS], axis=1)
    plane = np.stack([np.ones_like(u), u, v], axis=1)
    basis[:, 2, _BENDS] = bows - plane @ np.linalg.lstsq(plane, bows, rcond=None)[0]
    return basis


def loose_basis(positions: FloatArray, *, is_loose: bool) -> FloatArray:
    """`board_basis` of (c, 3) corners, and derivatives by x and y of each where these are loose."""
    basis, count = board_basis(positions), len(positions)
    if not is_loose:
        return basis
    moved = np.zeros((count, 3, count, 2))
    moved[np.arange(count), :2, np.arange(count)] = np.eye(2)
    return np.concatenate([basis, moved.reshape(count, 3, -1)], axis=2)


def shape_basis(target: Target) -> FloatArray:
    """Derivatives (c, 3, s) of a target's corners with respect to its shape.

    The shape of a printed board is that of `board_basis`, and x and y of its corners where these
    have a size; that of a rig are the positions of its points, or nothing if the rig is exact.
    """
    positions = corner_positions(target)
    if not target.is_rig:
        return loose_basis(positions, is_loose=bool(target.point_sigmas_m))
    size = len(stated_board_sigma(target))
    return np.eye(3 * len(positions), size).reshape(len(positions), 3, size)


def shaped_corners(target: Target, shape: FloatArray) -> FloatArray:
    """(c, 3) corners of a target of a (s,) shape, in its frame, whose z points into it [m].

    The shape may be that of `BOARD_NAMES` alone, where its corners are loose.
    """
    return np.asarray(corner_positions(target) + shape_basis(target)[:, :, : len(shape)] @ shape)


def boards_basis(targets: Sequence[Target]) -> FloatArray:
    """Derivatives (c, 3, s) of several targets' corners with respect to all of their shapes."""
    parts = [shape_basis(target) for target in targets]
    flat = block_diag(*(part.reshape(3 * len(part), part.shape[2]) for part in parts))
    return np.asarray(flat.reshape(len(flat) // 3, 3, flat.shape[1]))


def shape_slices(targets: Sequence[Target], first: int = 0) -> tuple[slice, ...]:
    """Slice of each target's shape among all shapes, which begin at index `first`."""
    ends = first + np.cumsum([0, *(len(stated_board_sigma(target)) for target in targets)])
    return tuple(slice(*pair) for pair in pairwise(ends.tolist()))


def stated_board_sigma(target: Target) -> FloatArray:
    """(s,) stated standard deviations of the target's shape; zero where nothing is stated."""
    if target.is_rig:
        # Larger rigs are taken as exact: each point adds three unknowns common to all views.
        sigmas = target.point_sigmas_m if len(target.point_sigmas_m) <= 100 else ()
        return np.repeat(sigmas, 3).astype(float)
    shape = np.zeros(len(BOARD_NAMES))
    shape[SCALE] = target.square_sigma_m / target.square_m
    return np.append(shape, np.repeat(target.point_sigmas_m, 2))
