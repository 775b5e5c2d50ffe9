"""Results of views, and their residuals."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from visioncal.core.codec import DROPPED, INLINE, KEPT
from visioncal.core.number_format import figure
from visioncal.session.frames import frame_of_object, frames_of_kind, object_name, robots_between

# Reason of a view with the role holdout.
HELD_BACK = "held out of the fit by the session (role = holdout)"
# Begins the reason of a view that was left out because pose and image are inconsistent.
CONTRADICTS = "disagrees with "
_NOT_LEFT_OUT = "none was left out: the residuals of the whole cell's fit"
# Kinds of observers and of observed frames.
_KINDS = ("camera", "instrument", "target", "point")


@dataclass(frozen=True)
class Rms:
    """Root mean square residuals.

    `deg` is None where an instrument read only positions, `px` where no image was used.
    """

    mm: float
    deg: float | None = None
    px: float | None = None

    @property
    def words(self) -> str:
        """Residuals of position and, where known, of rotation in words."""
        turned = "" if self.deg is None else f" and {figure(self.deg)} deg"
        return f"{figure(self.mm)} mm{turned}"


@dataclass(frozen=True)
class ViewResult:
    """Result of one view. A figure that could not be computed is None, and absent on disk."""

    view: int  # The view's number.
    used: bool  # Whether the fit used it.
    reason: Annotated[str, KEPT] = ""  # Why it was not used, in words; empty for a used view.
    corners: int | None = None  # Number of detected corners.
    rms_px: float | None = None  # Reprojection error through the whole chain of frames [px].
    # Distance of the target's position by this view from its mean, or in a whole cell from its
    # prediction by the rest of the cell [mm].
    residual_mm: float | None = None
    # The same in rotation [deg]; None where only a position was read.
    residual_deg: float | None = None
    # Frame of the camera or instrument; empty where there is only one.
    seer: Annotated[str, DROPPED] = ""
    # Frame of the target or point; empty where there is only one.
    seen: Annotated[str, DROPPED] = ""
    # In a whole cell, its stop, or the view's number where stops are not numbered.
    stop: int | None = None
    # In a whole cell, position residual by a fit without its stop [mm].
    left_out_mm: float | None = None
    left_out_deg: float | None = None  # The same in rotation [deg].
    left_out_px: float | None = None  # Reprojection error by that fit [px].

    @property
    def contradicts(self) -> bool:
        """Whether it was left out because it contradicts the others."""
        return not self.used and self.reason.startswith(CONTRADICTS)

    @property
    def of_pair(self) -> "ViewResult":
        """The result as one of a single camera, robot and target, without names."""
        return replace(
            self, seer="", seen="", stop=None, left_out_mm=None, left_out_deg=None, left_out_px=None
        )


@dataclass(frozen=True, kw_only=True)
class CellView:
    """Result of one observation of a whole cell, with names instead of frames."""

    camera: str | None = None  # Name of the camera; None for an instrument.
    instrument: str | None = None  # Name of the instrument; None for a camera.
    target: str | None = None  # Name of the observed target; None for a point.
    point: str | None = None  # Name of the measured point; None for a target.
    # The robots between observer and observed object.
    robots: Annotated[tuple[str, ...], KEPT] = ()
    figures: Annotated[ViewResult, INLINE]  # The other fields.

    def __post_init__(self) -> None:
        if (self.camera or self.instrument) is None or (self.target or self.point) is None:
            raise ValueError("camera or instrument, or target or point, is missing")

    @classmethod
    def of(cls, tree: Mapping[str, str], view: ViewResult) -> "CellView":
        """Form of an observation; `tree` has the parent of each frame."""
        connected = {view.seer, view.seen} <= tree.keys()
        robots = robots_between(tree, view.seer, view.seen) if connected else ()
        named = tuple(robot or "robot" for robot in robots)
        seer = "camera" if frames_of_kind([view.seer], "camera") else "instrument"
        seen = "target" if frames_of_kind([view.seen], "target") else "point"
        names: dict[str, Any] = {
            seer: object_name(view.seer, seer),
            seen: object_name(view.seen, seen),
        }
        return cls(robots=named, figures=replace(view, seer="", seen=""), **names)

    def result(self, tree: Mapping[str, str]) -> ViewResult:
        """The observation; inverse of `of`."""
        names = ((kind, getattr(self, kind)) for kind in _KINDS)
        seer, seen = (frame_of_object(tree, kind, name) for kind, name in names if name is not None)
        return replace(self.figures, seer=seer, seen=seen)


@dataclass(frozen=True)
class Validation:
    """Residuals of views that were not in the fit."""

    method: str  # How views were left out, in words.
    held_out: Rms  # Residuals of all used views, left out in turn.
    holdout: Rms | None = None  # Residuals of the views that the session declares as `holdout`.

    @classmethod
    def of(cls, method: str, views: Sequence[ViewResult]) -> "Validation":
        """Validation from the residuals of views; `method` is empty where none were left out."""
        if not method:
            return cls(_NOT_LEFT_OUT, rms_of(views), holdout_rms(views))
        return cls(method, left_out_rms(views), holdout_rms(views))

    @property
    def is_of_unseen(self) -> bool:
        """Whether views were left out; else these are residuals of the fit."""
        return self.method != _NOT_LEFT_OUT


def rms_of(views: Iterable[ViewResult]) -> Rms:
    """Root mean square residuals over the used views; zero without any."""
    used = [view for view in views if view.used]

    def rms(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return float(np.sqrt(np.mean(np.square(known)))) if known else None

    return Rms(
        rms([view.residual_mm for view in used]) or 0.0,
        rms([view.residual_deg for view in used]),
        rms([view.rms_px for view in used]),
    )


def left_out_rms(views: Iterable[ViewResult]) -> Rms:
    """Root mean square residuals of views by fits without them."""
    unseen = (
        replace(
            view,
            residual_mm=view.left_out_mm,
            residual_deg=view.left_out_deg,
            rms_px=view.left_out_px,
        )
        for view in views
    )
    return rms_of(unseen)


def holdout_rms(views: Iterable[ViewResult]) -> Rms | None:
    """Root mean square residuals of the session's holdout views; None without any."""
    held = [
        replace(view, used=True)
        for view in views
        if view.reason == HELD_BACK and view.residual_mm is not None
    ]
    return rms_of(held) if held else None


def worst_view(views: Sequence[ViewResult], rms: Rms) -> int | None:
    """Number of the view with the largest relative residual, used or not; None without any.

    Args:
        views: Results of the views.
        rms: Residuals of the used views, as units of millimetres, degrees and pixels.
    """

    def relative(view: ViewResult) -> float:
        pairs = ((view.residual_mm, rms.mm), (view.residual_deg, rms.deg), (view.rms_px, rms.px))
        return max((value / typical for value, typical in pairs if value and typical), default=0.0)

    worst = max(views, key=relative, default=None)
    return worst.view if worst is not None and relative(worst) else None
