"""calibration.json of a whole cell: the sections of one camera's, several of a kind by name.

What differs: `tree` says what each frame hangs on, `reference` which frame the cell's is, and
`cameras`, `robots` and `targets` have by name what `camera` and `robot` have of one.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Literal

import numpy as np

from visioncal.core.codec import INLINE, KEPT, names_but, read, read_fields, write
from visioncal.core.version import __version__
from visioncal.results.alignment import Alignment, Moved, Sight, Untied
from visioncal.results.edge import JointCovariance, StoredEdge
from visioncal.results.frame import Frame
from visioncal.results.lens import CameraResult
from visioncal.results.parts import (
    HELD_BACK,
    SCHEMA,
    NeedMet,
    Rms,
    RobotResult,
    SessionForm,
    StoredVerdict,
    ViewResult,
    check_schema,
)
from visioncal.results.sections import CellDetails, CellSections
from visioncal.session import frame_name
from visioncal.session.frames import frames_of_kind, robots_between, thing_name


@dataclass(frozen=True, kw_only=True)
class CellView:
    """What became of one observation of a whole cell.

    Attributes:
        view: The number of its row.
        stop: Its stop, or the view's number where the session has none.
        camera: The camera that saw it; or else an instrument did.
        instrument: The instrument that read it.
        target: The target that was seen; or else a point was.
        point: The point that was read.
        robots: The robots that move both before each other.
        used: Whether the fit used it.
        reason: Why it was not used, in words; empty for a used one.
        residual_mm: How far it is from what the rest of the cell predicts [mm].
        residual_deg: The same in rotation [deg].
        corners: How many corners were found in its image.
        rms_px: Reprojection error through the whole chain of frames [px].
        left_out_mm: How far it is from what a fit predicts that was made without its stop [mm].
        left_out_deg: The same in rotation [deg].
        left_out_px: Reprojection error by such a fit [px].
    """

    view: int
    stop: int
    camera: str | None = None
    instrument: str | None = None
    target: str | None = None
    point: str | None = None
    robots: Annotated[tuple[str, ...], KEPT] = ()
    used: bool
    reason: Annotated[str, KEPT] = ""
    residual_mm: float | None = None
    residual_deg: float | None = None
    corners: int | None = None
    rms_px: float | None = None
    left_out_mm: float | None = None
    left_out_deg: float | None = None
    left_out_px: float | None = None

    def __post_init__(self) -> None:
        """Checks that something was seen by something.

        Raises:
            ValueError: It was not.
        """
        if (self.camera or self.instrument) is None or (self.target or self.point) is None:
            raise ValueError("camera or instrument, or target or point, is missing")

    @classmethod
    def of(cls, cell: Alignment, sight: Sight) -> "CellView":
        """Writes an observation."""
        both = {sight.seer, sight.seen} <= cell.frames.keys()
        robots = robots_between(cell.frames, sight.seer, sight.seen) if both else ()
        figures = {name: var for name, var in vars(sight).items() if name not in ("seer", "seen")}
        between = tuple(robot or "robot" for robot in robots)
        return cls(robots=between, **_seer_and_seen(sight), **figures)

    def sight(self, tree: Mapping[str, str]) -> Sight:
        """Reads it."""
        names = ("camera", "instrument", "target", "point")
        there = {word: name for word in names if (name := getattr(self, word)) is not None}
        seer, seen = (
            next(_frame(tree, kind, there[kind]) for kind in kinds if kind in there)
            for kinds in (names[:2], names[2:])
        )
        figures = {name: var for name, var in vars(self).items() if name not in (*names, "robots")}
        return Sight(seer=seer, seen=seen, **figures)


@dataclass(frozen=True, kw_only=True)
class PairResiduals:
    """Residuals of views of a target by a camera that were left out [mm, deg, px]."""

    camera: str | None = None
    instrument: str | None = None
    target: str | None = None
    point: str | None = None
    views: int
    rms: Annotated[Rms, INLINE]


@dataclass(frozen=True, kw_only=True)
class CellValidation:
    """Residuals of what was left out of fits in turn: of all, and by camera and target.

    Attributes:
        method: How observations were left out, in words.
        held_out: Their residuals.
        holdout: Residuals of those that the session declares as `holdout`.
        pairs: Residuals by camera and target.
    """

    method: str
    held_out: Rms
    holdout: Rms | None = None
    pairs: Annotated[tuple[PairResiduals, ...], KEPT] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class CellForm:
    """calibration.json of a whole cell, but for its further sections.

    Attributes:
        schema: The version of this form.
        visioncal: The version of the program.
        created: When, in ISO 8601.
        session: The session.
        reference: The frame that stands for the cell.
        tree: What each frame hangs on.
        transforms: The estimated transforms by name.
        joint_covariance: Their covariance together.
        cameras: The cameras by name.
        robots: The robots by name: the nominal model, and what was found of the arm.
        targets: What was printed, by name and as it is described.
        noise: Estimated standard deviations, by frame or robot and by name.
        views: One entry for each observation.
        rms: Residuals over the used ones.
        moved: What moved while the session was taken.
        untied: Frames that nothing ties to the rest.
        weakest: The weakest link, in words.
        verdict: Whether to trust it.
        need: What the task needs, and how likely picks meet it.
        details: Further figures.
        validation: Residuals of what was left out.
        frames: Tools and fixtures by the transform that places them.
    """

    schema: Literal[1]
    visioncal: str = __version__
    created: str
    session: SessionForm
    reference: str
    tree: Mapping[str, str]
    transforms: Mapping[str, StoredEdge]
    joint_covariance: JointCovariance
    cameras: Mapping[str, CameraResult]
    robots: Mapping[str, RobotResult]
    targets: Mapping[str, Mapping[str, Any]]
    noise: Mapping[str, Mapping[str, float]]
    views: tuple[CellView, ...]
    rms: Rms
    moved: tuple[Moved, ...]
    untied: tuple[Untied, ...]
    weakest: str
    verdict: StoredVerdict
    need: NeedMet | None = None
    details: CellDetails
    validation: CellValidation | None = None
    frames: Mapping[str, Frame] = field(default_factory=dict)


# Fields that a cell has under the same names.
_SAME = names_but(
    CellForm,
    "schema visioncal session tree transforms joint_covariance cameras robots views rms "
    "validation frames",
)


def is_whole(document: Mapping[str, Any]) -> bool:
    """Whether a document is of a whole cell, as calibration.json has it."""
    return "tree" in document


def whole_document(cell: Alignment) -> dict[str, Any]:
    """Builds the content of calibration.json; what was not computed is absent."""
    form = CellForm(
        schema=SCHEMA,
        session=SessionForm(cell.session_name, cell.session_sha256),
        tree=cell.frames,
        transforms=cell.edges,
        joint_covariance=JointCovariance.of(cell.edges, cell.joint_covariance),
        cameras={thing_name(frame, "camera"): camera for frame, camera in cell.cameras.items()},
        robots=cell.arms,
        views=tuple(CellView.of(cell, sight) for sight in cell.sights),
        rms=rms_of(cell.sights),
        validation=_validation(cell) if cell.left_out else None,
        frames=cell.placed,
        **{name: getattr(cell, name) for name in _SAME},
    )
    return write(CellForm, form) | write(CellSections, cell)


def read_whole(document: Mapping[str, Any]) -> Alignment:
    """Reads what `whole_document` built.

    Raises:
        DataError: It is of another schema, or no whole cell; the message names the place.
    """
    check_schema(document)
    form = read(CellForm, document, "")
    own = {entry.name for entry in fields(CellForm)}
    rest = {key: value for key, value in document.items() if key not in own}
    tree = form.tree
    return Alignment(
        session_name=form.session.name,
        session_sha256=form.session.sha256,
        frames=tree,
        robots={name: thing_name(name, "robot") for name in frames_of_kind(tree, "flange")},
        edges=form.transforms,
        joint_covariance=form.joint_covariance.matrix,
        cameras={_frame(tree, "camera", name): camera for name, camera in form.cameras.items()},
        sights=tuple(view.sight(tree) for view in form.views),
        arms=form.robots,
        placed=form.frames,
        left_out="" if form.validation is None else form.validation.method,
        **{name: getattr(form, name) for name in _SAME},
        **read_fields(CellSections, rest, ""),
    )


def _validation(cell: Alignment) -> CellValidation:
    """Residuals of what was left out of fits in turn: of all, and by camera and target."""
    pairs: dict[tuple[str, str], list[Sight]] = {}
    for sight in cell.sights:
        if sight.left_out_mm is not None:
            pairs.setdefault((sight.seer, sight.seen), []).append(sight)
    return CellValidation(
        method=cell.left_out,
        held_out=left_out_rms(cell.sights),
        holdout=holdout_rms(cell.sights),
        pairs=tuple(
            PairResiduals(views=len(mine), rms=left_out_rms(mine), **_seer_and_seen(mine[0]))
            for mine in pairs.values()
        ),
    )


def _seer_and_seen(sight: Sight) -> dict[str, Any]:
    """What saw, and what was seen, by their kinds."""
    seer = "camera" if sight.seer in frames_of_kind([sight.seer], "camera") else "instrument"
    seen = "target" if sight.seen in frames_of_kind([sight.seen], "target") else "point"
    return {seer: thing_name(sight.seer, seer), seen: thing_name(sight.seen, seen)}


def left_out_rms(sights: Iterable[Sight]) -> Rms:
    """Root mean square residuals of observations by fits that were made without them."""
    unseen = (
        replace(
            sight,
            residual_mm=sight.left_out_mm,
            residual_deg=sight.left_out_deg,
            rms_px=sight.left_out_px,
        )
        for sight in sights
    )
    return rms_of(unseen)


def holdout_rms(sights: Iterable[Sight]) -> Rms | None:
    """Root mean square residuals of what the session holds back; None where that is nothing."""
    held = [
        replace(sight, used=True)
        for sight in sights
        if sight.reason == HELD_BACK and sight.residual_mm is not None
    ]
    return rms_of(held) if held else None


def rms_of(sights: Iterable[Sight]) -> Rms:
    """Root mean square residuals over the used ones of some observations; zero of none."""
    used = [sight for sight in sights if sight.used]

    def rms(values: list[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        return float(np.sqrt(np.mean(np.square(known)))) if known else None

    return Rms(
        rms([sight.residual_mm for sight in used]) or 0.0,
        rms([sight.residual_deg for sight in used]),
        rms([sight.rms_px for sight in used]),
    )


def view_results(sights: Iterable[Sight]) -> tuple[ViewResult, ...]:
    """Observations as one camera's views."""
    return tuple(
        ViewResult(
            sight.view,
            sight.used,
            sight.reason,
            sight.corners,
            sight.rms_px,
            sight.residual_mm,
            sight.residual_deg,
        )
        for sight in sights
    )


def _frame(tree: Mapping[str, str], kind: str, name: str) -> str:
    """The frame of what is called so."""
    frame = frame_name(kind, name)
    return frame if frame in tree or name != kind else frame_name(kind, "")
