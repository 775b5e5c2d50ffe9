"""Whether a result can be trusted, in plain sentences: of one camera and robot, or of many."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from visioncal.calibration.stages.cause_ranking import (
    MEASURE_BOARD,
    MOVED_AT_ONCE,
    NO_JOINTS,
    adding,
    ranked,
)
from visioncal.calibration.stages.need import Picks, need_met
from visioncal.core.limits import CalibrationLimits, NeedLimits
from visioncal.core.number_format import figure, percent
from visioncal.core.types import Mount, Need, Rejection
from visioncal.core.verdict import (
    AGREEMENT,
    EMPTY_IMAGE,
    EXCHANGED,
    GOOD_FOR,
    NEED,
    NOT_USABLE,
    NOTE,
    REVIEW,
    Finding,
    Step,
    Verdict,
    VerdictStatus,
    look_at,
    remarks,
)
from visioncal.estimation.observability import Direction
from visioncal.results import NeedMet, Rms, ViewResult
from visioncal.session.frames import thing_name

# Scatters under a nanometre and a micro-degree are rounding, and their ratios say nothing.
_ROUNDING = 1e-6
_LISTED_VIEWS, _LISTED_PARTS = 3, 3
_CAMERA_CAUSES = (
    "a board that moved, images paired with other poses, units or conventions of the poses, "
    "intrinsics, a warped board"
)
_CAUSES: Mapping[Mount, str] = {
    "eye-in-hand": _CAMERA_CAUSES,
    "eye-to-hand": _CAMERA_CAUSES,
    "instrument": "an instrument or a tool that moved, readings paired with other poses, units or "
    "conventions of the poses",
}
# Limits of views whose poses were measured, over those of views with corners: of a board that is
# seen squarely, sound ones are off by 8 times the median now and then.
_UNEVEN = 1.5
# So many views in a row are not left out by chance.
_LEAST_RUN = 3
# Kinds of findings about views that are left out.
_LEFT_OUT = (EXCHANGED, "turned_images", "wrong_pose", "something_moved")
# Views that disagree by less than so many times what their sensor's noise makes are explained: of a
# small board far away, nothing better is to be had.
_OF_NOISE = 1.5


@dataclass(frozen=True)
class Pair:
    """What one camera or instrument saw of one target.

    Attributes:
        views: What became of each view.
        rms: Residuals of the used ones.
        held_out: Residuals of these, left out in turn.
        holdout: Residuals of those held back by the session; None where there are none.
        disagreeing: Those whose robot pose and image do not belong together.
        name: Both, by name; empty where there are no others.
        noise: What the sensor's own noise makes of its views.
        away: `held_out` with the same weights as `noise`; None where all views weigh alike.
    """

    views: Sequence[ViewResult]
    rms: Rms
    held_out: Rms
    holdout: Rms | None = None
    disagreeing: Sequence[Rejection] = ()
    name: str = ""
    noise: Rms = field(default_factory=lambda: Rms(0.0, 0.0))
    away: Rms | None = None


@dataclass(frozen=True)
class Sensor:
    """A camera or an instrument.

    Attributes:
        used: How many of its views are used.
        lost: Those that could not be; those held back on purpose are not among them.
        disagreeing: How many of these have a robot pose and an image that do not belong together.
        pixel_px: Noise of a corner's coordinate; None without images [px].
        level: By how much more its poses scatter than their noise says.
        spared: How many were not needed, as others stand for them.
        name: Its frame; empty where there is no other.
    """

    used: int
    lost: Sequence[Rejection] = ()
    disagreeing: Sequence[int] = ()
    pixel_px: float | None = None
    level: float = 1.0
    spared: int = 0
    name: str = ""


@dataclass(frozen=True)
class Arm:
    """A robot.

    Attributes:
        stops: At how many stops it has a part in the fit.
        away_mm: Noise of its flange; None where that cannot be separated from the cameras' [mm].
        away_deg: The same in rotation [deg].
        surely: Ends of their 95 % intervals below [mm, deg]; as found where None.
        errs: Whether its errors follow its posture, which is said elsewhere.
        workspace_mm: Predicted sigma of a tool's place all over a calibrated arm's workspace, in
            the median; None for a nominal arm [mm].
        modelled: Whether its model is known.
        by_functions: Whether functions of its joints follow the very stops of the fit.
        can_tilt: Whether its flange turns about more than one direction.
        name: Its name; empty where there is no other.
    """

    stops: int
    away_mm: float | None = None
    away_deg: float | None = None
    surely: tuple[float, float] | None = None
    errs: bool = False
    workspace_mm: float | None = None
    modelled: bool = False
    by_functions: bool = False
    can_tilt: bool = True
    name: str = ""


@dataclass(frozen=True)
class Place:
    """How well a place is known where it counts.

    Attributes:
        words: What it is, in words.
        budget_mm: Its standard deviation by source, and as a `total` [mm].
        radius95_mm: It is right to within this in 95 % of cases [mm].
    """

    words: str
    budget_mm: Mapping[str, float]
    radius95_mm: float


@dataclass(frozen=True)
class Findings:
    """What the verdict is made of.

    Attributes:
        pairs: What each camera saw of each target.
        sensors: The cameras and instruments.
        arms: The robots.
        worst: The worst directions of all unknown edges; the first is named in a good verdict.
        places: How well places are known.
        warnings: What earlier stages had to say.
        notes: What of it is no reason for doubt.
        mount: What observed whom.
        need: What the task needs; None where that is not said.
        picks: What picks err by, by each camera and robot; empty where that is not predicted.
    """

    pairs: Sequence[Pair]
    sensors: Sequence[Sensor]
    arms: Sequence[Arm]
    worst: Sequence[Direction]
    places: Sequence[Place]
    warnings: Sequence[Finding] = ()
    notes: Sequence[str] = ()
    mount: Mount = "eye-in-hand"
    need: Need | None = None
    picks: Sequence[Picks] = ()

    @property
    def plannable(self) -> bool:
        """Whether views can be proposed: of cameras, by arms whose models are known."""
        has_images = any(it.pixel_px is not None for it in self.sensors)
        return has_images and all(it.modelled for it in self.arms)

    @property
    def of_camera(self) -> str:
        """The option that names, of several cameras that a robot looks with, the least known."""
        cameras = dict.fromkeys(it.camera for it in self.picks)
        if len({it.name for it in self.sensors}) < 2 or not cameras:
            return ""
        weak_m = {
            camera: max((it.sigma for it in self.worst if _is_offset_of(it, camera)), default=0.0)
            for camera in cameras
        }
        return f" --camera {thing_name(max(cameras, key=weak_m.__getitem__), 'camera')}"

    @property
    def rms(self) -> Rms:
        """Residuals of all used views."""
        return self._pooled(lambda it: it.rms)

    @property
    def held_out(self) -> Rms:
        """Residuals of all of them, left out in turn."""
        return self._pooled(lambda it: it.held_out)

    def _pooled(self, of: Callable[[Pair], Rms]) -> Rms:
        if len(self.pairs) == 1:
            return of(self.pairs[0])
        counts = np.array([sum(view.used for view in it.views) for it in self.pairs])

        def pooled(values: Sequence[float | None]) -> float | None:
            known = [
                (it, count) for it, count in zip(values, counts, strict=True) if it is not None
            ]
            if not any(count for _, count in known):
                return None
            squares, weights = np.array(known).T
            return float(np.sqrt(np.average(squares**2, weights=weights)))

        each = [of(it) for it in self.pairs]
        return Rms(pooled([it.mm for it in each]) or 0.0, pooled([it.deg for it in each]))


def _is_offset_of(direction: Direction, frame: str) -> bool:
    return not direction.is_rotation and direction.words.startswith(f"{frame}'s ")


def judge(findings: Findings) -> Verdict:
    """Says whether the result can be trusted, why, and what to do next.

    Returns:
        `bad` with a reason that settles it, `check` with doubts, `good` without. Where the task
        says what it needs, the chance that picks land within it decides: good from 0.95, check from
        0.5, bad below, and never good where something is not explained.
    """
    limits = CalibrationLimits()
    scatter = list(_scatter_doubts(findings, limits))
    pairs, sensors = findings.pairs, findings.sensors
    doubts = [
        *scatter,
        *(doubt for it in pairs for doubt in _disagreement_doubts(it)),
        *_outlier_doubts(findings, limits),
        *(doubt for it in pairs for doubt in _holdout_doubts(it, findings.mount, limits)),
        # Sigmas of views that disagree wildly say nothing about the motion.
        *([] if any(it.is_fatal for it in scatter) else _accuracy_doubts(findings, limits)),
        *_stop_doubts(findings, limits),
        *(doubt for it in sensors for doubt in _lost_doubts(it, limits)),
        *(doubt for it in sensors for doubt in _noise_doubts(it, limits)),
        *([] if scatter else _robot_doubts(findings, limits)),
        *(_warned(it, findings) for it in findings.warnings if it.kind not in NOT_USABLE),
    ]
    good_for_mm = _good_for_mm(findings.picks, doubts)
    met = need_met(findings.need, findings.picks)
    status: VerdictStatus = "good" if not doubts else "check"
    hints: list[Finding] = []
    if met is None:
        status = "bad" if any(doubt.is_fatal for doubt in doubts) else status
    elif met.probability >= NeedLimits.probability[0]:
        enough = met.need.mm or 0.0
        # Where nothing was seen, later picks may be all the same.
        hints = [replace(it, kind=NOTE) for it in doubts if it.kind == EMPTY_IMAGE]
        doubts = [it for it in doubts if it.until_mm > enough]
        status = "check" if doubts else "good"
    else:
        status = "check" if met.probability >= NeedLimits.probability[1] else "bad"
    ordered: Sequence[Finding] = sorted(doubts, key=lambda doubt: not doubt.is_fatal)
    if status != "good":
        ordered = ranked(
            ordered,
            findings.picks,
            met,
            more=_helping(findings),
            left_out_mm=findings.held_out.mm,
        )
    said = list(ordered)
    if met is None:
        said += _good_for(findings, good_for_mm, status)
    else:
        said.insert(
            len(said) * (met.probability >= NeedLimits.probability[0]),
            Finding(NEED, _met_words(findings, met)),
        )
    said += [] if doubts else [_praise(findings, is_enough=status == "good")]
    said += [*hints, *(it for it in findings.warnings if it.kind in NOT_USABLE)]
    return Verdict(status, (*said, *remarks(findings.notes, NOTE)), good_for_mm)


def _warned(found: Finding, findings: Findings) -> Finding:
    """A stage's warning, with what the result is without the views that it has left out."""
    left_out = found.kind in _LEFT_OUT
    without_it = _without(found.views, findings.held_out)
    return replace(found, without_it=without_it) if left_out else found


def _without(views: Sequence[int], held_out: Rms) -> str:
    left_out = f"view {views[0]}" if len(views) == 1 else "these views"
    return f"Without {left_out}, the others predict each other to {_both(held_out)}."


def _good_for_mm(picks: Sequence[Picks], doubts: Sequence[Finding]) -> float | None:
    """The least need that would be met by all pairs; None where none would, or none is known."""
    least = max((it.until_mm for it in doubts), default=0.0)
    if not picks or np.isinf(least):
        return None
    return max(least, *(it.good_for_mm for it in picks))


def _good_for(
    findings: Findings, good_for_mm: float | None, status: VerdictStatus
) -> tuple[Finding, ...]:
    if good_for_mm is None:
        return ()
    verb = "would be" if status == "bad" else "is"
    worst = max(findings.picks, key=lambda it: it.good_for_mm)
    sensor = "instrument" if worst.camera.startswith("instrument") else "camera"
    words = (
        f"It {verb} good for tasks of {figure(good_for_mm)} mm and more at "
        f"{figure(worst.distance_m)} m from the {sensor}."
    )
    return (Finding(GOOD_FOR, words),)


def _met_words(findings: Findings, met: NeedMet) -> str:
    """How likely picks land within what is needed."""
    need, worst = met.need, min(findings.picks, key=lambda it: it.probability(met.need))
    within = [f"{value:g} {unit}" for value, unit in ((need.mm, "mm"), (need.deg, "deg")) if value]
    where = "where the views looked" if need.at == "views" else f"at {list(need.at)} m in the base"
    who = f" by robot {worst.robot} of what {worst.camera} sees" if len(findings.picks) > 1 else ""
    return (
        f"A pick{who} {where} lands within {' and '.join(within)} with a probability of "
        f"{percent(met.probability)}; 95 % land within {worst.stays_within(need)}."
    )


def is_scattered(findings: Findings) -> bool:
    """Whether views disagree with each other by more than a sound cell's do."""
    return any(_scatter_doubts(findings, CalibrationLimits()))


def _praise(findings: Findings, *, is_enough: bool) -> Finding:
    keep = Step(
        "Use the result with its covariance, and keep it: visioncal verify and visioncal diff "
        "compare later stops with it."
    )
    used = sum(view.used for it in findings.pairs for view in it.views)
    worst = findings.worst[0]
    return Finding(
        AGREEMENT,
        f"All {used} used views agree: left out of the fit, they are predicted to "
        f"{_both(findings.held_out)} (rms), and "
        f"{worst.words}, its worst direction, is known to {figure(1e3 * worst.sigma)} mm.",
        keep if is_enough else None,
    )


def _both(rms: Rms) -> str:
    """Residuals in position and, where these are known, in rotation."""
    return f"{figure(rms.mm)} mm" + ("" if rms.deg is None else f" and {figure(rms.deg)} deg")


def _pairs(one: Rms, other: Rms) -> list[tuple[float, float]]:
    """Two sets' residuals side by side: of position and, where both are known, of rotation."""
    pairs = [(one.mm, other.mm)]
    if one.deg is not None and other.deg is not None:
        pairs.append((one.deg, other.deg))
    return pairs


def _scatter_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    yield from _pair_doubts(findings, limits)
    ratios = [
        outside / within
        for outside, within in _pairs(findings.held_out, findings.rms)
        if outside > _ROUNDING and within > 0.0
    ]
    ratio = max(ratios, default=0.0)
    followed = any(it.by_functions for it in findings.arms)
    if ratio > limits.optimism[0] and not followed:
        yield Finding(
            "optimism",
            f"Views left out fit {ratio:.1f} times worse than views in the fit: there are too few "
            "views for their noise.",
            _tilted(findings),
            is_fatal=ratio > limits.optimism[1],
            until_mm=0.0,
        )


def _is_of_arm(findings: Findings) -> bool:
    """Whether what is uncertain is mostly what an arm does wrong whose joints are not known."""
    has_no_joints = any(it.do is NO_JOINTS for it in findings.warnings)
    return has_no_joints and _is_mostly_of(findings, "arm", "robot", "poses")


def _is_of_board(findings: Findings) -> bool:
    """Whether it is mostly how well boards are known, which no view tells."""
    # A lens that is held has a part in what held values cost.
    names = {name.partition(" of ")[0] for it in findings.places for name in it.budget_mm}
    held = () if "lens" in names else ("held values",)
    return _is_mostly_of(findings, "board", *held)


def _is_mostly_of(findings: Findings, *sources: str) -> bool:
    of_these = of_all = 0.0
    for place in findings.places:
        for name, mm in place.budget_mm.items():
            of_these += mm**2 * name.startswith(sources)
            of_all += mm**2 * (name == "total")
    return of_these > 0.5 * of_all


def _helping(findings: Findings) -> Step | None:
    """What makes a result less uncertain; None where that is said of the arm already."""
    if _is_of_board(findings):
        return MEASURE_BOARD
    if any(it.do is NO_JOINTS for it in findings.warnings):
        return None
    words = "Add views from other poses of the robot."
    return adding(words, modelled=findings.plannable, purpose=findings.of_camera)


def _tilted(findings: Findings) -> Step:
    words = "Add 5 views or more, tilted by 20 to 40 degrees about different axes."
    if not all(it.can_tilt for it in findings.arms):
        words = "Add 5 views or more, all over the workspace and turned as far as the arm turns."
    return adding(words, modelled=findings.plannable, purpose=findings.of_camera)


def _pair_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    words, views, is_fatal = [], list[ViewResult](), False
    for pair in findings.pairs:
        held = pair.away or pair.held_out
        beyond = [
            (f"{figure(value)} {unit} (doubt begins at {check:g})", value > bad)
            for value, unit, (check, bad), noise in zip(
                (held.mm, held.deg),
                ("mm", "deg"),
                (limits.scatter_mm, limits.scatter_deg),
                (pair.noise.mm, pair.noise.deg or 0.0),
                strict=True,
            )
            if value is not None and value > max(check, _OF_NOISE * noise)
        ]
        if beyond:
            away = " and ".join(it for it, _ in beyond)
            words.append(f"{away} ({pair.name})" if pair.name else away)
            views += pair.views
            is_fatal |= any(it for _, it in beyond)
    if words:
        worst = _worst_views(views)
        named = ", ".join(f"view {view.view} ({_residual(view)})" for view in worst)
        yield Finding(
            "unexplained",
            f"Left out of the fit, views disagree with the others by "
            f"{', '.join(words)}, rms; the worst are {named}.",
            Step(
                f"Look at the worst views for possible causes: {_CAUSES[findings.mount]}, or an "
                "arm with large model errors.",
                REVIEW,
            ),
            tuple(it.view for it in worst),
            is_fatal=is_fatal,
            until_mm=0.0,
        )


def _worst_views(views: Sequence[ViewResult]) -> list[ViewResult]:
    measured = [view for view in views if view.used and view.residual_mm is not None]
    return sorted(measured, key=lambda view: -(view.residual_mm or 0.0))[:_LISTED_VIEWS]


def _disagreement_doubts(pair: Pair) -> Iterator[Finding]:
    """Names the views that were left out because they contradict the others."""
    out = pair.disagreeing
    if not out:
        return
    views, run = tuple(it.view for it in out), _run(pair)
    if len(out) == 1:
        named, them, rows = f"view {views[0]}", "it", "its row"
        words = f"View {views[0]} was left out. It {out[0].reason}."
    else:
        named, them, rows = f"views {', '.join(map(str, views))}", "them", "their rows"
        words = f"V{named[1:]} were left out. View {views[0]} {out[0].reason}.{run}"
    step = (
        Step("Fasten what moved, and calibrate the views before and after it apart.")
        if run
        else Step(
            f"Compare image and pose of {named}: record {them} again, or in views.csv, delete "
            f"{rows}.",
            look_at(views[0]),
        )
    )
    kind, without_it = "something_moved" if run else "wrong_views", _without(views, pair.held_out)
    yield Finding(kind, words, step, views, without_it=without_it).of(pair.name)


def _run(pair: Pair) -> str:
    """Says so where the views that were left out follow each other, with no other between them."""
    out = [it.view for it in pair.disagreeing]
    compared = [it.view for it in pair.views if it.used or it.view in out]
    first = compared.index(out[0])
    end = first + len(out)
    if len(out) < _LEAST_RUN or compared[first:end] != out or compared == out:
        return ""
    when = f"from view {out[0]} on" if first else f"before view {compared[end]}"
    if first and end < len(compared):
        when = f"from view {out[0]} to view {out[-1]}"
    return f" They follow each other: {when}, something had moved."


def _outlier_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    """Names single views whose residual stands out from the others'."""
    # Where the corners show how well each view sees the board, the consensus has judged them
    # better.
    if any(it.away_mm is not None for it in findings.arms):
        return
    for pair in findings.pairs:
        for view, ratio in outlying_views(pair.views, limits.outlier):
            words = (
                f"View {view.view} stands out: it places the target {_residual(view, ' and ')} "
                f"from the others, {ratio:.0f} times what is typical. It is in the fit and pulls "
                "at it."
            )
            step = Step(
                "Look at its image and its pose, and take it out of views.csv if one is wrong.",
                look_at(view.view),
            )
            yield Finding("wrong_views", words, step, (view.view,)).of(pair.name)


def outlying_views(
    views: Sequence[ViewResult], limit: float = CalibrationLimits.outlier
) -> tuple[tuple[ViewResult, float], ...]:
    """The used views whose residual is over so many times the median, with their ratios."""
    used = [view for view in views if view.used]
    if not used:
        return ()
    away = np.array([[view.residual_mm or 0.0, view.residual_deg or 0.0] for view in used])
    ratios = (away / np.maximum(np.median(away, axis=0), _ROUNDING)).max(axis=1)
    pairs = zip(used, ratios.tolist(), strict=True)
    return tuple(
        (view, it)
        for view, it in pairs
        if it > (limit if view.rms_px is not None else _UNEVEN * limit)
    )


def _residual(view: ViewResult, between: str = ", ") -> str:
    turned = "" if view.residual_deg is None else f"{between}{figure(view.residual_deg)} deg"
    return f"{figure(view.residual_mm or 0.0)} mm{turned}"


def _holdout_doubts(pair: Pair, mount: Mount, limits: CalibrationLimits) -> Iterator[Finding]:
    holdout, held = pair.holdout, pair.held_out
    if holdout is None:
        return
    pairs = _pairs(holdout, held)
    ratio = max(back / max(left, _ROUNDING) for back, left in pairs)
    if ratio > limits.holdout and max(back for back, _ in pairs) > _ROUNDING:
        observed = "readings" if mount == "instrument" else "images"
        words = (
            f"The views that the session holds back are missed by {_both(holdout)}, {ratio:.0f} "
            "times worse than views left out in turn. They lie where the result does not hold, or "
            f"their poses or {observed} are wrong."
        )
        step = Step("Record views where the result is to hold, with role = fit.")
        yield Finding("holdout", words, step).of(pair.name)


def _accuracy_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    """Judges the answer where it counts."""
    # Edges are known in the arm's own frames. Those of a calibrated arm are as open as the errors
    # of the first and the last link, which its poses make up for.
    # What moved at once is in all that is known, and more views do not help.
    if any(it.kind in MOVED_AT_ONCE for it in findings.warnings):
        return
    if any(it.workspace_mm is None for it in findings.arms):
        yield from _sigma_doubts(findings, limits)
        yield from _budget_doubts(findings, limits)
    for it in findings.arms:
        if it.workspace_mm is not None and it.workspace_mm > limits.sigma_mm[0]:
            seen = any(sensor.pixel_px is not None for sensor in findings.sensors)
            board = (
                " The board's size counts in it, as no view shows when an arm and a board are "
                "both too large: measure its squares, and state square_sigma_m."
            )
            words = (
                "All over the workspace the calibrated arm places its tool to "
                f"{figure(it.workspace_mm)} mm (sigma, in the median; doubt begins at "
                f"{limits.sigma_mm[0]:g}).{board if seen else ''}"
            )
            step = adding(
                "Add views with other postures of the arm, all over the workspace.",
                modelled=findings.plannable,
                purpose=f" --for kinematics{findings.of_camera}",
            )
            is_fatal = it.workspace_mm > limits.sigma_mm[1]
            found = Finding("workspace", words, step, is_fatal=is_fatal, until_mm=0.0)
            yield found.of(_robot(it))


def _sigma_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    weak, is_fatal = [], False
    for direction in findings.worst:
        scale, unit, (check, bad) = (
            (np.rad2deg(1.0), "deg", limits.sigma_deg)
            if direction.is_rotation
            else (1e3, "mm", limits.sigma_mm)
        )
        sigma = direction.sigma * scale
        if sigma > check:
            weak.append(f"{direction.words} ({figure(sigma)} {unit})")
            is_fatal |= bool(sigma > bad)
    if weak:
        of_arm, of_board = _is_of_arm(findings), _is_of_board(findings)
        least = f"{limits.sigma_mm[0]:g} mm and {limits.sigma_deg[0]:g} deg"
        known = f"known to {', '.join(weak)} (sigma; doubt begins at {least}): most of that"
        words = (
            f"As mounts, {known} is the arm's, and is the same in every recording."
            if of_arm
            else f"Frames are {known} is the board's, as well as its size is stated."
            if of_board
            else f"Weakly determined by the motion, with their sigmas: {', '.join(weak)}; doubt "
            f"begins at {least}."
        )
        yield Finding(
            "weak_motion",
            words,
            NO_JOINTS if of_arm else MEASURE_BOARD if of_board else _tilted(findings),
            is_fatal=is_fatal,
            until_mm=0.0,
        )


def _budget_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    """Says what makes the result uncertain where it is to be used."""
    beyond = [it for it in findings.places if it.budget_mm["total"] > limits.sigma_mm[0]]
    if not beyond:
        return
    worst = max(beyond, key=lambda it: it.budget_mm["total"])
    budget = worst.budget_mm
    parts = sorted((at for at in budget.items() if at[0] != "total"), key=lambda at: -at[1])
    others = [
        f"{it.words} ({figure(it.budget_mm['total'])} mm)" for it in beyond if it is not worst
    ]
    yield Finding(
        "place",
        f"{worst.words} is placed to {figure(budget['total'])} mm (sigma; 95 % "
        f"within {figure(worst.radius95_mm)} mm): "
        + ", ".join(f"{figure(mm)} mm from the {name}" for name, mm in parts[:_LISTED_PARTS])
        + "."
        + (f" Over {limits.sigma_mm[0]:g} mm are also {', '.join(others)}." if others else ""),
        MEASURE_BOARD if _is_of_board(findings) else None,
        is_fatal=budget["total"] > limits.sigma_mm[1],
        until_mm=0.0,
    )


def _stop_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    used = sum(view.used for it in findings.pairs for view in it.views)
    check, bad = limits.stops
    for it in findings.arms:
        if it.stops < check:
            counted = f"{used} views" if it.stops == used else f"{it.stops} stops"
            words = f"Only {counted} are used; {check} or more are needed to check the result."
            step, is_fatal = _tilted(findings), it.stops < bad
            kind = "too_few_stops" if is_fatal else "few_stops"
            found = Finding(kind, words, step, is_fatal=is_fatal, until_mm=0.0)
            yield found.of(_robot(it))


def _lost_doubts(sensor: Sensor, limits: CalibrationLimits) -> Iterator[Finding]:
    lost = sensor.lost
    count_all = sensor.used + sensor.spared + len(lost)
    share = len(lost) / max(count_all, 1)
    if share > limits.lost_share[0]:
        details, disagree = "", {*sensor.disagreeing}
        others = [it for it in lost if it.view not in disagree]
        if disagree:
            count = len(disagree) if others else "all"
            details = f"; {count} of them disagree with the others"
        if others:
            details += f"; the first{' but for these' if disagree else ''}: view {others[0].view}, "
            details += others[0].reason
        words = f"{len(lost)} of {count_all} views are not used{details}."
        words_do = "Look at the first of them, and repeat what is missing."
        step = Step(words_do, look_at(others[0].view)) if others else None
        views, is_fatal = tuple(it.view for it in lost), share > limits.lost_share[1]
        # Those that disagree have a finding of their own.
        kind = "lost_views" if others else "left_out"
        yield Finding(kind, words, step, views, is_fatal=is_fatal).of(sensor.name)


def _noise_doubts(sensor: Sensor, limits: CalibrationLimits) -> Iterator[Finding]:
    check, bad = limits.pixel_px
    noise = sensor.pixel_px
    if noise is None:
        return
    if noise > check:
        words = (
            f"Corners deviate by {figure(noise)} px from any pose of a flat board (doubt begins at "
            f"{check:g}): the intrinsics do not fit this camera, the board is not flat, or images "
            "are blurred."
        )
        step = Step("Look for blur, glare, and a lens or a board that is not as stated.")
        yield Finding("corner_noise", words, step, is_fatal=noise > bad).of(sensor.name)
    if sensor.level > limits.level:
        words = (
            f"Its poses scatter {figure(sensor.level)} times as much as its corners say: squares "
            "of few pixels, blur, or a lens that is not as stated."
        )
        step = Step("Go nearer, or show it larger squares.")
        yield Finding("corner_noise", words, step).of(sensor.name)


def _robot(arm: Arm) -> str:
    return f"Robot {arm.name}" if arm.name else ""


def _robot_doubts(findings: Findings, limits: CalibrationLimits) -> Iterator[Finding]:
    """An arm is a good instrument: what looks like its error is often something else's."""
    # What chance makes of a good arm's noise, where poses are coarse, is no error. A task that
    # needs ten times as much has an arm that is as good as it has to be.
    for it in findings.arms:
        if it.away_mm is None or it.away_deg is None or it.errs:
            continue
        found_mm, found_deg = it.surely or (it.away_mm, it.away_deg)
        beyond = max(it.away_mm / limits.robot_mm, it.away_deg / limits.robot_deg)
        if max(found_mm / limits.robot_mm, found_deg / limits.robot_deg) > 1.0:
            cause, step = (
                (
                    "the instrument reads worse than is stated of it, was moved, or the arm's "
                    "model is off by as much.",
                    Step("Read a few stops twice to see how well readings repeat."),
                )
                if findings.mount == "instrument"
                else (
                    "the board is of another size than stated, or warped, the intrinsics are not "
                    "this camera's, the arm's model is off by as much, or poses were read before "
                    "the arm stood still.",
                    Step(
                        "Stand still before each image, and read one pose twice to see how well it "
                        "repeats; measure the board over many squares; check the lens and the "
                        "arm's model."
                    ),
                )
            )
            words = (
                f"The residuals would take a flange that is off by {figure(it.away_mm)} mm and "
                f"{figure(it.away_deg)} deg from stop to stop; arms repeat to 0.1 mm. More likely "
                f"{cause}"
            )
            until_mm = 10.0 * beyond * limits.robot_mm
            yield Finding("unexplained", words, step, until_mm=until_mm).of(_robot(it))
