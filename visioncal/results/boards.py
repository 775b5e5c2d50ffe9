"""Targets by which a result was calibrated, with the shapes that it found them to have."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, Target
from visioncal.results.content import CalibrationContent
from visioncal.vision.board_shape import stated_board_sigma
from visioncal.vision.targets import target_document, target_from_document


@dataclass(frozen=True, eq=False)
class CalibratedBoard:
    """A target by which a result was calibrated."""

    name: str  # Its name in the session; that of an only one is empty.
    target: Target  # The target as stated.
    shape: FloatArray  # (s,) deviations from it; see `vision.board_shape.shape_basis`.

    def is_print_of(self, other: Target) -> bool:
        """Whether another target is stated as the same print, whatever the sigma of its size."""
        stated, seen = (
            {key: value for key, value in target_document(each).items() if key != "square_sigma_m"}
            for each in (self.target, other)
        )
        return stated == seen


def calibrated_boards(calibration: CalibrationContent) -> Iterator[CalibratedBoard]:
    """The targets of a result's fit, in its order; raises DataError where one cannot be read."""
    fit = calibration.joint_fit
    shapes = {
        "": calibration.board or calibration.rig,
        **calibration.boards,
        **calibration.rigs,
    }
    for name, document in ({} if fit is None else fit.targets).items():
        target, found = target_from_document(document, name or "target"), shapes.get(name)
        shape = np.zeros(len(stated_board_sigma(target)))
        if found is not None:
            shape[: len(found.values)] = found.values
        yield CalibratedBoard(name, target, shape)


def shape_seen(calibration: CalibrationContent, target: Target) -> FloatArray:
    """(s,) shape of a target: of a print by which was calibrated the one found, else as stated."""
    for board in calibrated_boards(calibration):
        if board.is_print_of(target):
            return board.shape
    return np.zeros(len(stated_board_sigma(target)))
