"""Views left out as of another place: at one end of the session, here and there, on the way."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.core.limits import CLEAR_RATIO, FEWEST_STOPS, FEWEST_VIEWS, CalibrationLimits
from visioncal.core.number_format import figure, mm_and_deg, ranges, view_words
from visioncal.core.transforms import LEVER_M, exp, invert, log, pose_difference, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Target
from visioncal.core.verdict import Finding, Option, Remedy, mending, or_alone
from visioncal.estimation.moves import find_push, observations_over
from visioncal.estimation.outliers import InlierFit
from visioncal.estimation.problem import Problem
from visioncal.estimation.robot_likelihood import robot_likelihood
from visioncal.estimation.steps import FRAME, Candidate, Step, step_of, with_step
from visioncal.robot.errors import TWIST_UNITS
from visioncal.vision.targets import half_turn_of

# Views among many outliers of one end that agree by chance, one of so many; what a step that few
# times exceeds the noise leaves of these, and poses that are wrong apart never do.
_BY_CHANCE, _AT_END = 4, 0.6
# Probability below which outliers that are all views of one end are so by no chance.
_ONE_END = 1e-3
# An industrial arm errs by so much at most [mm, deg].
_ARM_ERRS = CalibrationLimits.arm_errors
# A knock moves what is fastened by less [mm, deg].
KNOCKED = 20.0, 5.0
# Of views before or after a frame of the controller was switched.
OF_OTHER_FRAMES = ": their result is for the tool and the base frame that were active there"
# Another size turns nothing, and a small marker's noise less than so [rad].
_TURNED_RAD = 0.2
# Largest share of the way to another stop at which an arm is, and least share of outliers for which
# that holds: one in hundreds is along that line by chance.
_ON_THE_WAY, _MOST_ON_THE_WAY = 0.4, 0.6
IN_MOTION = Remedy(
    "Wait until the arm stands still before each image, and log the measured pose then; or record "
    "times of images and of a stream of poses (stamp_s, streams): then the delay is estimated."
)
# Errors of an arm as a twist [rad].
_ARM_LEAVES = float(np.hypot(1e-3 * _ARM_ERRS[0] / LEVER_M, np.deg2rad(_ARM_ERRS[1])))


@dataclass(frozen=True)
class PoseFault:
    """A fault of poses or images that explains outliers."""

    found: Finding  # The finding.
    rows: tuple[int, ...]  # The observations that it explains.
    short: str = ""  # The fault as a clause, for each of these; empty where the finding suffices.


def fault_of(
    cell_fit: CellFit, kind: str, rows: Sequence[int], words: str, do: Remedy, short: str = ""
) -> PoseFault:
    """A fault of some observations, in words in which {views} are theirs."""
    views = tuple(cell_fit.cell.rows[row].view for row in rows)
    words = words.format(views=view_words(views))
    found = Finding(kind, f"{words[0].upper()}{words[1:]}", do, views)
    return PoseFault(found, tuple(rows), short)


def _in_motion(cell_fit: CellFit, outliers: IntArray) -> Iterator[PoseFault]:
    """Outliers at which the arm was on its way from the last stop, or to the next one."""
    inliers, part = cell_fit.inlier_fit, cell_fit.inlier_fit.problem
    (poses, *others), stops = part.poses.values(), part.observations.stops[outliers]
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    linear = part.linear(inliers.fit.state)
    noise = part.total_covariance(linear, inliers.fit.noise)[outliers]
    if others or len(outliers) < FEWEST_VIEWS or not noise.any():
        return
    residuals, by_flange = linear.residuals[outliers], linear.by_flanges[outliers]
    at, found = np.searchsorted(known, stops), list[tuple[int, bool, IntArray, FloatArray]]()
    for by in (-1, 1):
        other = known[np.clip(at + by, 0, len(known) - 1)]
        ways = log(invert(poses[stops]) @ poses[other])
        # Most programs have a tool move along a line.
        ways[:, 3:] = np.einsum(
            "nji,nj->ni", poses[stops][:, :3, :3], poses[other][:, :3, 3] - poses[stops][:, :3, 3]
        )
        moved = (by_flange @ ways[:, :, None])[:, :, 0]
        white = np.linalg.solve(noise, np.stack([residuals, moved], axis=2))
        before, cross, square = (
            np.einsum("ni,ni->n", *pair)
            for pair in (
                (residuals, white[:, :, 0]),
                (moved, white[:, :, 0]),
                (moved, white[:, :, 1]),
            )
        )
        shares = -cross / np.maximum(square, np.finfo(float).tiny)
        left = before - shares**2 * square
        explained = (CLEAR_RATIO**2 * left < before) & (np.abs(shares) < _ON_THE_WAY)
        for is_beyond in (False, True):
            rows = np.flatnonzero(explained & ((shares < 0.0) == is_beyond))
            found.append((by, is_beyond, rows, np.abs(shares[rows])))
    by, is_beyond, rows, shares = max(found, key=lambda item: len(item[2]))
    if len(rows) < max(FEWEST_VIEWS, _MOST_ON_THE_WAY * len(outliers)):
        return
    which = "last" if by < 0 else "next"
    when = {
        (-1, False): "the image was taken before the arm had arrived, as of commanded poses",
        (-1, True): "the pose was read before the arm had arrived",
        (1, False): "the image was taken once the arm had left",
        (1, True): "the pose was read once the arm had left",
    }[by, is_beyond]
    low, high = (figure(100.0 * float(share)) for share in (shares.min(), shares.max()))
    how = f"by {low}{f' to {high}' * (low != high)} % of the way to the {which} stop"
    short = f"the arm moved between image and pose, {how}"
    words = f"{{views}} were left out: {short}, along the line between both: {when}."
    yield fault_of(cell_fit, "something_moved", outliers[rows].tolist(), words, IN_MOTION, short)


@dataclass(frozen=True, eq=False)
class _EndRun:
    """Outliers that are the views at one end of the session."""

    rows: IntArray  # The outliers there.
    order: IntArray  # (n,) all observations in the order of their stops.
    at: int  # Place among these of the first observation after the change.
    is_first: bool  # Whether it is the end before.
    change: tuple[str, FloatArray] | None  # Common to these; see `_common_change`.

    @property
    def later(self) -> IntArray:
        """Observations after the change, in the session's order."""
        return np.sort(self.order[self.at :])

    @property
    def is_whole(self) -> bool:
        """Whether all views of this end are out."""
        return len(self.rows) == (self.at if self.is_first else len(self.order) - self.at)


def _end_run(cell_fit: CellFit) -> _EndRun:
    inliers = cell_fit.inlier_fit
    order = np.argsort(inliers.problem.observations.stops, kind="stable")
    is_used = inliers.used[order]
    ends = np.append(0, np.cumsum(np.where(is_used, -_BY_CHANCE, 1)))
    first, last = int(ends.argmin()), int(ends.argmax())
    before, after = order[:last][~is_used[:last]], order[first:][~is_used[first:]]
    is_first = len(before) > len(after)
    run, at = (before, last) if is_first else (after, first)
    most = _AT_END if len(run) > FEWEST_VIEWS else 1.0 / CLEAR_RATIO
    change = _common_change(inliers, run, most) if len(run) >= FEWEST_VIEWS else None
    return _EndRun(run, order, at, is_first, change)


def views_apart(cell_fit: CellFit) -> frozenset[int]:
    """Views of one end of the session of which camera, target or a frame was another one."""
    if not cell_fit.cell.session.has_one_pair or cell_fit.inlier_fit.used.all():
        return frozenset()
    run = _end_run(cell_fit)
    if run.change is None:
        return frozenset()
    return frozenset(cell_fit.cell.rows[row].view for row in run.rows.tolist())


def later_part(cell_fit: CellFit) -> tuple[Problem, tuple[Step, ...]] | None:
    """The used views with all after a frame moved, and the step, of each frame that it may be.

    None where the views after it are used, or before a tool or base frame that was switched.
    """
    if not cell_fit.cell.session.has_one_pair or cell_fit.inlier_fit.used.all():
        return None
    found, inliers = _end_run(cell_fit), cell_fit.inlier_fit
    if found.change is None or found.is_first or is_switched(found.change[1]):
        return None
    rows, state, every = found.rows, inliers.fit.state, np.arange(len(inliers.used))
    if found.change[0]:
        rows, _ = _alike(inliers, rows, *found.change)
    problem = inliers.problem.subset(inliers.used | np.isin(every, rows))
    later, steps = inliers.problem.subset(np.isin(every, rows)), list[Step]()
    at = int(inliers.problem.observations.stops[found.order[found.at]])
    for frame in filter(lambda name: later.observations.involves(name).all(), later.unknown):
        candidate, flat = Candidate(FRAME, frame, np.array([at])), np.zeros((6, 6))
        step = Step(candidate, at, log(step_of(later, frame, state)[0]), flat, 0.0, flat)
        # Each view after it is a part of the step: a likelihood with tails would drop few of them.
        stepped, fit = with_step(problem, inliers.fit, step)
        misfit = robot_likelihood(stepped, fit.state, fit.noise).negative_log_likelihood
        steps.append(replace(step, gain=-2.0 * misfit))
    return problem, tuple(sorted(steps, key=lambda step: -step.gain))


def _moved_run(
    cell_fit: CellFit, found: _EndRun, alike: tuple[str, FloatArray] | None
) -> Iterator[PoseFault]:
    """Outliers at one end of the session that agree, as where something moved, or here and there.

    `alike` is the change that all outliers have in common, of those without one at an end.
    """
    inliers, rows = cell_fit.inlier_fit, cell_fit.cell.rows
    run, change, order = found.rows, found.change, found.order
    is_used = inliers.used[order]
    words = "Fasten camera and target, keep one board, and one tool and base frame in the "
    words += "controller, and record again"
    if cell_fit.cell.mount == "instrument":
        words = "Leave the instrument where it stands and one probe in one nest, and record again"
    if len(run) == np.sum(~is_used) and found.is_whole:
        # All views of one end and no others: by another pose of each, that is hardly chance.
        by_chance = 2.0 * len(order) / math.comb(len(order), len(run))
        change = change or (("", np.eye(4)) if by_chance < _ONE_END else None)
    if change is not None:
        # Picks come after the session.
        later = [rows[row].view for row in found.later.tolist()]
        when = f"{'before' if found.is_first else 'from'} view {rows[int(order[found.at])].view}"
        when += " on" * (not found.is_first)
        which = "from there on" if found.is_first else "before"
        kept = f" The result is that of the views {which}."
        if not found.is_first and not is_switched(change[1]):
            kept = " The result has it where it was last, by these views."
        words += f"; or calibrate the {len(later)} views from there on alone"
        is_far = pose_difference(np.eye(4), change[1])[0] > _ARM_ERRS[0]
        note = OF_OTHER_FRAMES * is_far
        do = or_alone(f"{words}{note}.", later)
        if is_switched(change[1]):
            these = [rows[row].view for row in np.sort(run).tolist()]
            otherwise = f"{words[0].lower()}{words[1:]} (--views {ranges(later)}){note}."
            do = _tool_taken_off(cell_fit, change, these, otherwise) or do
    else:
        # Views here and there, as of every second row.
        if alike is None:
            return
        when = "in all of these"
        run, change = _alike(inliers, np.sort(order[~is_used]), *alike)
        some = [rows[row].view for row in run.tolist()]
        words += ". The result is that of the other views; calibrate these alone, too."
        otherwise = "the result is that of the other views."
        do = _tool_taken_off(cell_fit, change, some, otherwise) or or_alone(words, some)
        kept = ""
    what, how = _changed_words(cell_fit, *change)
    outliers = np.sort(run).tolist()
    if by_arm := cell_fit.instead_of(change[1]):
        how += by_arm
    elif change[0] and np.less(pose_difference(np.eye(4), change[1]), _ARM_ERRS).all():
        how += ", or another load bends the arm"
    words = f"{{views}} were left out: {when}, {what} was another one{how}.{kept}"
    yield fault_of(cell_fit, "something_moved", outliers, words, do, f"{when}, something had moved")


def of_moved(cell_fit: CellFit, outliers: IntArray) -> Iterator[PoseFault]:
    """Outliers of one robot and one camera that one change explains, or an arm on its way."""
    found, alike = _end_run(cell_fit), None
    if found.change is None and len(outliers) >= FEWEST_VIEWS:
        # Of views here and there, wrong poses alike by chance are no frame.
        alike = _common_change(cell_fit.inlier_fit, outliers, 1.0 / CLEAR_RATIO, _ARM_LEAVES)
    # One change of a frame explains a push along the motion, too.
    is_free = found.change is None and alike is None
    on_the_way = [*_in_motion(cell_fit, outliers)] if is_free else []
    yield from on_the_way or _moved_run(cell_fit, found, alike)


def pushed_base(cell_fit: CellFit) -> Iterator[PoseFault]:
    """Outliers from some stop on that agree on one other pose of a robot's base."""
    inliers, cell = cell_fit.inlier_fit, cell_fit.cell
    push = find_push(inliers.problem, inliers.fit, inliers.used)
    if push is None:
        return
    (base, stop, change), stops = push, inliers.problem.observations.stops
    is_over = observations_over(inliers.problem, inliers.fit, base)
    out = np.flatnonzero(is_over & ~inliers.used & (stops >= stop))
    last = cell.stops[stops[is_over & (stops < stop)].max()]
    moved = mm_and_deg(*pose_difference(np.eye(4), exp(change)))
    words = (
        f"between stops {last} and {cell.stops[stop]}, {base} moved by {moved}. The result has it "
        "where it stood first: {views}, later, were left out."
    )
    do = cell.or_separately(f"Fasten {base}", stop)
    yield fault_of(cell_fit, "something_moved", out.tolist(), words, do, f"{base} had moved")


def _tool_taken_off(
    cell_fit: CellFit, change: tuple[str, FloatArray], views: Sequence[int], otherwise: str
) -> Remedy | None:
    """Advice by a change that some views have in common; see `tool_taken_off`."""
    frame, step = change
    if not frame or _is_turned_in_place(frame, step):
        return None
    edge = cell_fit.fit.frames[frame]
    return tool_taken_off(cell_fit, frame, (edge, edge @ step), views, otherwise)


def _is_turned_in_place(frame: str, step: FloatArray) -> bool:
    """Whether a target turned about its own origin, which no tool has there by chance."""
    mm, deg = pose_difference(np.eye(4), step)
    return not frame.startswith("cam") and mm < _ARM_ERRS[0] and deg > KNOCKED[1]


def tool_taken_off(
    cell_fit: CellFit,
    frame: str,
    edges: tuple[FloatArray, FloatArray],
    views: Sequence[int],
    otherwise: str,
) -> Remedy | None:
    """Advice to take a tool off some views' poses; None where another frame was another one.

    Args:
        cell_fit: The fit.
        frame: The frame that was another one in these views.
        edges: What it is in the other views, and in these.
        views: The views.
        otherwise: What to do where no tool was active.
    """
    tree = cell_fit.cell.tree
    robot = next(
        (name for name, at in tree.flanges.items() if tree.branches[frame].parent == at), None
    )
    # Joint angles that belong to the poses rule a tool out.
    is_ruled_out = robot is None or cell_fit.arms[robot].is_modelled
    if is_ruled_out or cell_fit.cell.mount == "instrument":
        return None
    return without_tool(edges[0] @ invert(edges[1]), views, otherwise)


def without_tool(tool: FloatArray, views: Sequence[int], otherwise: str) -> Remedy:
    """Advice to take a tool (4, 4) in the flange off some views' poses, if it was active there."""
    twist = *(1e3 * tool[:3, 3]), *np.rad2deg(log(tool)[:3])
    numbers = ",".join(f"{value:.4f}" for value in twist)
    option = Option("without-tool", numbers, tuple(views), tool)
    write = "Look whether a tool was active there. If so, write"
    return mending("it is taken off their poses", option, write, f". Else {otherwise}")


def turned_back(board: Target, views: Sequence[int]) -> Remedy:
    """Advice to turn a board back that some views number from the other end."""
    _, (x, y) = half_turn_of(board)
    option = Option("turned", f"180,{1e3 * x:.2f},{1e3 * y:.2f}", tuple(views))
    return mending("it is turned back", option)


def is_switched(step: FloatArray) -> bool:
    """Whether a frame of the controller is likelier another one than that something was knocked.

    A knock moves what is fastened by millimetres.
    """
    return bool(np.greater(pose_difference(np.eye(4), step), KNOCKED).any())


def _changed_words(cell_fit: CellFit, frame: str, step: FloatArray) -> tuple[str, str]:
    """The frame that moved from some view on, and by how much, in words."""
    if not frame:
        known = any(arm.is_modelled for arm in cell_fit.arms.values())
        joint = ", or the zero of a joint," if known else ""
        moved = mm_and_deg(*pose_difference(np.eye(4), step))
        how = f": by about {moved}" if np.any(step != np.eye(4)) else ""
        return f"the camera, the target or a frame of the controller{joint}", how
    thing, edge = ("camera" if frame.startswith("cam") else "target"), cell_fit.fit.frames[frame]
    on_flange = (cell_fit.cell.mount == "eye-in-hand") == (thing == "camera")
    if cell_fit.cell.mount == "instrument":
        on_flange = not frame.startswith("instrument")
        thing = "probe" if on_flange else "instrument"
    of_robot = f"controller's {'tool' if on_flange else 'base frame'}"
    mm, deg = pose_difference(np.eye(4), step)
    if _is_turned_in_place(frame, step):
        how = f": turned by {figure(deg)} deg in its own place, as a tracker reads a body "
        return f"the {thing}", f"{how}of which it takes markers for others"
    moved = mm_and_deg(mm, deg) if deg else f"{figure(mm)} mm"
    how = f": the {thing} by {moved}, or the {of_robot} by {other_frame(edge, edge @ step)}"
    return f"the {thing} or the {of_robot}", how


def other_frame(before: FloatArray, after: FloatArray) -> str:
    """Where poses of another tool, or in another frame, have it: an edge is another one by it."""
    other = before @ invert(after)
    x, y, z = (figure(1e3 * part) for part in other[:3, 3].tolist())
    return f"({x}, {y}, {z}) mm and {figure(pose_difference(np.eye(4), other)[1])} deg"


def _common_change(
    inliers: InlierFit, rows: IntArray, most: float, leaves: float = np.inf
) -> tuple[str, FloatArray] | None:
    """The frame whose step explains most of some outliers, and the step; None where none does.

    The step leaves a third of these; up to `most`, as a share, where that is as much as others
    scatter by; and no more than `leaves` [rad], or than others scatter by.

    The name is empty where another size of the target does, or steps of several frames alike. Rows
    with other poses, or of other images, have none in common.
    """
    some, state = np.isin(np.arange(len(inliers.problem)), rows), inliers.fit.state
    part, others = inliers.problem.subset(some), inliers.part
    are_places = not part.observations.has_rotation.all()
    if are_places and len(part) < FEWEST_STOPS:
        most = 1.0 / CLEAR_RATIO**2
    sides = part.measured(state), part.predicted(state)
    turned = float(np.median(rotation_angle(invert(sides[0]) @ sides[1])))
    measured, predicted = (poses[:, :3, 3] for poses in sides)
    sizes = np.sum(measured * (predicted - measured), axis=1) / np.sum(measured**2, axis=1)
    of_size = float(np.ptp(sizes) / max(abs(np.median(sizes)), np.finfo(float).tiny))
    found = list[tuple[float, str, FloatArray]]()
    for frame in filter(lambda name: part.observations.involves(name).all(), part.unknown):
        # Rigid motions explain much of a few places.
        if are_places and len(part) < FEWEST_STOPS and frame.startswith("instrument"):
            continue
        step, away = step_of(part, frame, state)
        usually = step_of(others, frame, state, np.eye(4))[1]
        size = np.linalg.norm(log(step) / TWIST_UNITS)
        left, usual = np.median(away), np.median(usually)
        # Poses that are wrong may have much in common, and differ by far more than noise.
        is_noise = CLEAR_RATIO * left < size or left < CLEAR_RATIO * usual
        is_noise &= bool(left < max(leaves, CLEAR_RATIO * usual))
        found.append((float(left / size) if is_noise else np.inf, frame, step))
    ratio, frame, step = min(found, default=(np.inf, "", np.eye(4)), key=lambda item: item[0])
    # A tool that is longer along the line of sight looks like another size, too.
    is_size = CLEAR_RATIO * of_size < min(1.0, CLEAR_RATIO**2 * ratio) and turned < _TURNED_RAD
    if not are_places and is_size:
        return "", np.eye(4)
    if ratio >= most:
        return None
    is_clear = all(CLEAR_RATIO * ratio < rival for rival, other, _ in found if other != frame)
    return (frame if is_clear else ""), step


def _alike(
    inliers: InlierFit, rows: IntArray, frame: str, step: FloatArray
) -> tuple[IntArray, tuple[str, FloatArray]]:
    """Outliers among (n,) that a step of a frame explains, and this step by them alone."""
    if not frame:
        return rows, (frame, step)
    every, state = np.arange(len(inliers.problem)), inliers.fit.state
    part = inliers.problem.subset(np.isin(every, rows))
    away = step_of(part, frame, state, step)[1]
    rows = rows[CLEAR_RATIO * away < np.linalg.norm(log(step) / TWIST_UNITS)]
    part = inliers.problem.subset(np.isin(every, rows))
    return rows, (frame, step_of(part, frame, state)[0])
