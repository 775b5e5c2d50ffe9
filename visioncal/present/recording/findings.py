"""What a calibration found beside its edges: the board, the arm, and what makes it uncertain."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, Target
from visioncal.estimation.appearance import BOARD_NAMES, board_basis
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.vision.targets import corner_positions

_T = TypeVar("_T")
_BEND = "bow_"
# What each source of uncertainty is, for people.
SOURCES = {
    "pixels": "noise of the corners",
    "instrument": "the instrument's readings",
    "robot": "the robot, from stop to stop",
    "poses": "noise of the poses",
    "intrinsics": "what is open about the lens",
    "board": "what is open about the board",
    "arm": "errors of the arm's links",
    "temperature": "what is open about the arm's drift with temperature",
    "priors": "what was measured by hand",
    "held_values": "values that are held",
    "lens_field": "the lens beyond its model",
    "misfit": "neighbouring stops that err alike",
}


@dataclass(frozen=True, eq=False)
class Board:
    """The board as it was found to be.

    Attributes:
        shape: Its departure from the stated one, by the names of `BOARD_NAMES`.
        sigma: Standard deviations of what is open about it.
        estimated: What of it the fit moved.
        bend_mm: Within what depth its corners lie [mm].
    """

    shape: Mapping[str, float]
    sigma: Mapping[str, float]
    estimated: tuple[str, ...]
    bend_mm: float

    @property
    def is_bent(self) -> bool:
        """Whether its bend was estimated; else it was taken as flat."""
        return any(name.startswith(_BEND) for name in self.estimated)

    def squares_m(self, target: Target) -> tuple[float, float]:
        """Sides of its squares along the target's x and y [m]."""
        scale, half = 1.0 + self.shape["scale"], 0.5 * self.shape["aspect"]
        return target.square_m * (scale - half), target.square_m * (scale + half)

    def corners(self, target: Target) -> FloatArray:
        """(c, 3) where the corners lie in the target's frame, whose z points into the board [m]."""
        flat = corner_positions(target)
        return np.asarray(flat + board_basis(flat) @ [self.shape[it] for it in BOARD_NAMES])


@dataclass(frozen=True)
class Arm:
    """Errors that follow the arm's posture.

    Attributes:
        sigma_mm: Typical error of a link's lengths [mm].
        sigma_deg: Typical error of its angles [deg].
        likelihood_ratio: By how much they explain the residuals better than white noise.
        estimated: Whether they were estimated along with the edges.
    """

    sigma_mm: float
    sigma_deg: float
    likelihood_ratio: float
    estimated: bool


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How well a point is placed where the views look, and why not better.

    Attributes:
        distance_m: Of that point from the camera [m].
        parts_mm: Standard deviation by source, the largest first [mm]; one at least. Their squares
            add up to the total's.
        total_mm: Of all sources together [mm].
        radius95_mm: The point is right to within this in 95 % of cases [mm].
        noise_95: 95 % intervals of the noise's levels, by their names in `Calibration.noise`.
        spectrum: (12,) standard deviations along the principal directions of both edges, ascending,
            in units of the largest that are accepted.
    """

    distance_m: float
    parts_mm: Mapping[str, float]
    total_mm: float
    radius95_mm: float
    noise_95: Mapping[str, tuple[float, float]]
    spectrum: FloatArray

    def percent(self, source: str) -> str:
        """Writes a source's share of the variance."""
        part_mm = self.parts_mm[source]
        share = (part_mm / self.total_mm) ** 2 if self.total_mm > 0.0 else 0.0
        return "<1 %" if part_mm > 0.0 and share < 0.005 else f"{100 * share:.0f} %"


@dataclass(frozen=True, eq=False)
class Findings:
    """What there is of the three; older calibrations have none.

    Attributes:
        boards: By the name of the target, which is empty where there is one.
        arm: Errors of the arm.
        uncertainty: Of the result.
    """

    boards: Mapping[str, Board]
    arm: Arm | None
    uncertainty: Uncertainty | None

    @classmethod
    def of(cls, calibration: Calibration) -> "Findings":
        """Reads them from a calibration's further stages.

        Raises:
            DataError: One of them is not what this version writes.
        """
        return cls(
            _boards(calibration),
            read_stage(calibration, "arm_errors", _arm),
            read_stage(calibration, "uncertainty", _uncertainty),
        )


def read_stage(calibration: Calibration, name: str, read: Callable[[Any], _T]) -> _T | None:
    """Reads what one further stage found; None where it did not run.

    Raises:
        DataError: It is not what this version writes.
    """
    document = calibration.stages.get(name)
    if document is None:
        return None
    try:
        return read(document)
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise DataError(
            f"calibration of {calibration.session_name!r}: {name} cannot be read: {error!r}.",
            culprits=[name],
            next_step="Calibrate the session again.",
        ) from error


def _boards(calibration: Calibration) -> dict[str, Board]:
    only = read_stage(calibration, "board", _board)
    if only is not None:
        return {"": only}
    several = read_stage(
        calibration, "boards", lambda them: {str(it): _board(them[it]) for it in them}
    )
    return {} if several is None else several


def target_frames(calibration: Calibration, session: Session | None) -> dict[int, str]:
    """The frame of the target that each view shows, where the calibration places it."""
    placed = [name.rpartition("_from_")[2] for name in calibration.edges][1:]
    if session is None:
        return {}
    if not session.targets:
        # A target, or what an instrument reads in its place.
        return dict.fromkeys((view.number for view in session.views), placed[0])
    frames = {
        view.number: f"target_{name}" if (name := session.board_of(view)) else "target"
        for view in session.views
    }
    return {view: frame for view, frame in frames.items() if frame in placed}


def _board(document: Mapping[str, Any]) -> Board:
    return Board(
        {name: float(document["shape"][name]) for name in BOARD_NAMES},
        {name: float(it) for name, it in document["sigma"].items()},
        tuple(str(name) for name in document["estimated"]),
        float(document["bend_mm"]),
    )


def _arm(document: Mapping[str, Any]) -> Arm:
    return Arm(
        float(document["sigma_mm"]),
        float(document["sigma_deg"]),
        float(document["likelihood_ratio"]),
        bool(document["estimated"]),
    )


def _uncertainty(document: Mapping[str, Any]) -> Uncertainty | None:
    """None of a part of a whole cell, of which its noise alone is known."""
    if document.get("budget_mm") is None:
        return None
    budget = {str(name): float(it) for name, it in document["budget_mm"].items()}
    total = budget.pop("total")
    if not budget:
        raise ValueError("budget_mm has no source")
    intervals = {}
    for name, (low, high) in document["noise_95"].items():
        intervals[str(name)] = (float(low), float(high))
    return Uncertainty(
        float(np.linalg.norm(np.asarray(document["point_cam_m"], dtype=float))),
        dict(sorted(budget.items(), key=lambda it: -it[1])),
        total,
        float(document["radius95_mm"]),
        intervals,
        np.asarray(document["spectrum"], dtype=float).reshape(-1),
    )
