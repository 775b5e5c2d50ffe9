"""What is printed of a board, drawn in any of its maps with edges of a given width."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from visioncal.core.types import FloatArray, IntArray, Mask, Target
from visioncal.vision.dense.library import library
from visioncal.vision.targets import corner_positions, marked_squares, marker_cells

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, eq=False)
class Print:
    """A board as a grid of light and dark cells.

    Attributes:
        x: (c + 1,) lines along x, from the board's origin [squares].
        y: (r + 1,) lines along y.
        light: (r + 2, c + 2) which cells are light; around the board all are.
        inset: How far a light square's marker is from its edges [squares]; infinite without one.
    """

    x: FloatArray
    y: FloatArray
    light: Mask
    inset: float

    @classmethod
    def of(cls, target: Target) -> Self:
        """The print of a checkerboard or a ChArUco board."""
        if target.kind == "checkerboard":
            columns, rows = target.columns + 1, target.rows + 1
            light = np.add.outer(np.arange(rows), np.arange(columns)) % 2 == 1
            return cls(
                np.arange(columns + 1.0) - 1, np.arange(rows + 1.0) - 1, _paper(light), np.inf
            )
        share = target.marker_m / target.square_m
        inset = (1.0 - share) / 2
        side = len(marker_cells(target.dictionary, 0))
        cuts = np.concatenate([[0.0], inset + share * np.arange(side + 1) / side])
        light = np.zeros((target.rows * len(cuts), target.columns * len(cuts)), bool)
        for number, (column, row) in enumerate(marked_squares(target).tolist()):
            square = np.ones((len(cuts), len(cuts)), bool)
            square[1:-1, 1:-1] = ~marker_cells(target.dictionary, number)
            low_x, low_y = column * len(cuts), row * len(cuts)
            light[low_y : low_y + len(cuts), low_x : low_x + len(cuts)] = square
        x, y = (
            np.append(np.add.outer(np.arange(count), cuts).ravel(), count)
            for count in (target.columns, target.rows)
        )
        return cls(x, y, _paper(light), inset)

    def light_at(self, places: FloatArray) -> Mask:
        """(n,) which of (n, 2) places [squares] lie on light cells."""
        column = np.searchsorted(self.x, places[:, 0])
        row = np.searchsorted(self.y, places[:, 1])
        return np.asarray(self.light[row, column])

    def drawn(self, x: "Tensor", y: "Tensor", sigma_x: "Tensor", sigma_y: "Tensor") -> "Tensor":
        """Draws the print: 1 where it is light, 0 where dark, edges as of a Gaussian.

        Args:
            x: (...) places on the board [squares].
            y: Likewise.
            sigma_x: Widths of edges across the lines of constant x [squares].
            sigma_y: Likewise.
        """
        torch = library("torch")
        light = torch.as_tensor(self.light, dtype=x.dtype, device=x.device)
        (at_x, beyond_x), (at_y, beyond_y) = (
            _nearest(torch.as_tensor(lines, dtype=x.dtype, device=x.device), at, sigma)
            for lines, at, sigma in ((self.x, x, sigma_x), (self.y, y, sigma_y))
        )
        upper = torch.lerp(light[at_y, at_x], light[at_y, at_x + 1], beyond_x)
        lower = torch.lerp(light[at_y + 1, at_x], light[at_y + 1, at_x + 1], beyond_x)
        return torch.lerp(upper, lower, beyond_y)


def _paper(light: Mask) -> Mask:
    return np.pad(light, 1, constant_values=True)


def _nearest(lines: "Tensor", at: "Tensor", sigma: "Tensor") -> "tuple[Tensor, Tensor]":
    """The line next to each place, and the share of a Gaussian there that lies beyond it."""
    torch = library("torch")
    near = torch.bucketize(at.contiguous(), (lines[1:] + lines[:-1]) / 2)
    return near, torch.special.ndtr((at - lines[near]) / sigma)


def board_places(target: Target, ids: IntArray) -> FloatArray:
    """(n, 2) corners on the board [squares]."""
    return np.asarray(corner_positions(target)[ids, :2] / target.square_m)
