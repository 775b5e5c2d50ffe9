"""What became of the views, and how large their residuals are."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from visioncal.core.codec import DROPPED, INLINE, KEPT
from visioncal.core.number_format import figure
from visioncal.session.frames import frame_called, frames_of_kind, robots_between, thing_name

# Why a view is in no fit although nothing is wrong with it.
HELD_BACK = "held out of the fit by the session (role = holdout)"
_NOT_LEFT_OUT = "none was left out: the residuals of the whole cell's fit"
# What may see, and what may be seen.
_KINDS = ("camera", "instrument", "target", "point")


@dataclass(frozen=True)
class Rms:
    """Root mean square residuals.

    `deg` is None where an instrument read places alone, `px` where no image was used.
    """

    mm: float
    deg: float | None = None
    px: float | None = None

    @property
    def words(self) -> str:
        """In position and, where that is known, in rotation."""
        turned = "" if self.deg is None else f" and {figure(self.deg)} deg"
        return f"{figure(self.mm)} mm{turned}"


@dataclass(frozen=True)
class ViewResult:
    """What became of one view. A figure that could not be computed is None, and absent on disk.

    Attributes:
        view: The view's number.
        used: Whether the fit used it.
        reason: Why it was not used, in words; empty for a used view.
        corners: How many corners were found.
        rms_px: Reprojection error through the whole chain of frames [px].
        residual_mm: Distance of the target, as this view places it, from its mean place, or of a
            whole cell from where the rest of the cell predicts it [mm].
        residual_deg: The same in rotation [deg]; None where a place alone was read.
        seer: The frame of the camera or instrument; empty where there is one alone.
        seen: The frame of the target or point, likewise.
        stop: Of a whole cell, its stop, or the view's number where the session has none.
        left_out_mm: Of a whole cell, how far it is from what a fit predicts that was made without
            its stop [mm].
        left_out_deg: The same in rotation [deg].
        left_out_px: Reprojection error by such a fit [px].
    """

    view: int
    used: bool
    reason: Annotated[str, KEPT] = ""
    corners: int | None = None
    rms_px: float | None = None
    residual_mm: float | None = None
    residual_deg: float | None = None
    seer: Annotated[str, DROPPED] = ""
    seen: Annotated[str, DROPPED] = ""
    stop: int | None = None
    left_out_mm: float | None = None
    left_out_deg: float | None = None
    left_out_px: float | None = None

    @property
    def of_pair(self) -> "ViewResult":
        """The same where one camera saw one target by one robot, which need no names."""
        return replace(
            self,
            seer="",
            seen="",
            stop=None,
            left_out_mm=None,
            left_out_deg=None,
            left_out_px=None,
        )


@dataclass(frozen=True, kw_only=True)
class SeerAndSeen:
    """What saw and what was seen, by their kinds and names.

    Attributes:
        camera: The camera that saw it; or else an instrument did.
        instrument: The instrument that read it.
        target: The target that was seen; or else a point was.
        point: The point that was read.
    """

    camera: str | None = None
    instrument: str | None = None
    target: str | None = None
    point: str | None = None

    def __post_init__(self) -> None:
        """Checks that something was seen by something.

        Raises:
            ValueError: It was not.
        """
        if (self.camera or self.instrument) is None or (self.target or self.point) is None:
            raise ValueError("camera or instrument, or target or point, is missing")


def _names(view: ViewResult) -> dict[str, Any]:
    """What saw, and what was seen, by their kinds."""
    seer = "camera" if frames_of_kind([view.seer], "camera") else "instrument"
    seen = "target" if frames_of_kind([view.seen], "target") else "point"
    return {seer: thing_name(view.seer, seer), seen: thing_name(view.seen, seen)}


@dataclass(frozen=True, kw_only=True)
class CellView(SeerAndSeen):
    """What became of one observation of a whole cell, with names in the place of frames.

    Attributes:
        robots: The robots that move both before each other.
        figures: The rest of it.
    """

    robots: Annotated[tuple[str, ...], KEPT] = ()
    figures: Annotated[ViewResult, INLINE]

    @classmethod
    def of(cls, tree: Mapping[str, str], view: ViewResult) -> "CellView":
        """Writes an observation.

        Args:
            tree: What each frame hangs on.
            view: The observation.
        """
        are_tied = {view.seer, view.seen} <= tree.keys()
        robots = robots_between(tree, view.seer, view.seen) if are_tied else ()
        named = tuple(robot or "robot" for robot in robots)
        return cls(robots=named, figures=replace(view, seer="", seen=""), **_names(view))

    def result(self, tree: Mapping[str, str]) -> ViewResult:
        """Reads it; see `of`."""
        names = ((kind, getattr(self, kind)) for kind in _KINDS)
        seer, seen = (frame_called(tree, kind, name) for kind, name in names if name is not None)
        return replace(self.figures, seer=seer, seen=seen)


@dataclass(frozen=True, kw_only=True)
class PairResiduals(SeerAndSeen):
    """Residuals of views of a target by a camera that were left out [mm, deg, px]."""

    views: int
    rms: Annotated[Rms, INLINE]


@dataclass(frozen=True)
class Validation:
    """Residuals of views that the fit had not seen.

    Attributes:
        method: How views were left out, in words.
        held_out: Their residuals, over all used views in turn.
        holdout: Residuals of the views that the session declares as `holdout`.
        pairs: Of a whole cell, the residuals of those that were left out by camera and target.
    """

    method: str
    held_out: Rms
    holdout: Rms | None = None
    pairs: tuple[PairResiduals, ...] = ()

    @classmethod
    def of(cls, method: str, views: Sequence[ViewResult], *, by_pair: bool = False) -> "Validation":
        """What fits without some observations of a whole cell say of these.

        Args:
            method: How they were left out; empty where they were not.
            views: The observations.
            by_pair: Whether to say it of each camera and target, too.
        """
        if not method:
            return cls(_NOT_LEFT_OUT, rms_of(views), holdout_rms(views))
        pairs = _pairs(views) if by_pair else ()
        return cls(method, left_out_rms(views), holdout_rms(views), pairs)

    @property
    def is_of_unseen(self) -> bool:
        """Whether any were left out; else these are residuals of the fit."""
        return self.method != _NOT_LEFT_OUT


def _pairs(views: Iterable[ViewResult]) -> tuple[PairResiduals, ...]:
    """Residuals of what was left out of fits in turn, by camera and target."""
    pairs: dict[tuple[str, str], list[ViewResult]] = {}
    for view in views:
        if view.left_out_mm is not None:
            pairs.setdefault((view.seer, view.seen), []).append(view)
    return tuple(
        PairResiduals(views=len(mine), rms=left_out_rms(mine), **_names(mine[0]))
        for mine in pairs.values()
    )


def rms_of(views: Iterable[ViewResult]) -> Rms:
    """Root mean square residuals over the used ones of some views; zero of none."""
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
    """Root mean square residuals of views by fits that were made without them."""
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
    """Root mean square residuals of what the session holds back; None where that is nothing."""
    held = [
        replace(view, used=True)
        for view in views
        if view.reason == HELD_BACK and view.residual_mm is not None
    ]
    return rms_of(held) if held else None


def worst_view(views: Sequence[ViewResult], rms: Rms) -> int | None:
    """The number of the view that is farthest off, used or not; None where none is known.

    Args:
        views: What became of each.
        rms: Residuals of the used ones, in units of which millimetres, degrees and pixels compare.
    """

    def off(view: ViewResult) -> float:
        pairs = (
            (view.residual_mm, rms.mm),
            (view.residual_deg, rms.deg),
            (view.rms_px, rms.px),
        )
        return max((value / typical for value, typical in pairs if value and typical), default=0.0)

    worst = max(views, key=off, default=None)
    return worst.view if worst is not None and off(worst) else None
