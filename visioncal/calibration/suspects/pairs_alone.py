"""Causes that show where each robot, camera and target of a whole cell is calibrated alone.

A cell takes the pictures of another lens, or a tool that was switched, for views that are wrong or
frames that moved. Where pairs agree by themselves, and not with each other, that is named.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.calibration.guess.recording import FEWEST_ROWS
from visioncal.calibration.pipeline.guess_inputs import of_pair
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import rows_of_robot, stop_of, stops_by_view
from visioncal.calibration.stages.robots import CameraTargetPair, pairs_of
from visioncal.calibration.suspects.moved_views import (
    IN_MOTION,
    KNOCKED,
    other_frame,
    turned_back,
    without_tool,
)
from visioncal.calibration.suspects.suspect import LIKE_KNOCKS, SOURCES, UNEXPLAINED, Suspect
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import mm_and_deg, robot_words, some_of, view_words
from visioncal.core.transforms import invert, log, pose_difference
from visioncal.core.types import Corners, FloatArray, Target
from visioncal.core.verdict import Finding, Remedy, or_alone
from visioncal.estimation.unknowns import EDGE
from visioncal.session import Session
from visioncal.vision.targets import half_turn_of

PairRun = Callable[[Session, Mapping[int, Corners]], RunState]

# Of a cell of many, the pairs of most views are calibrated.
_MOST_PAIRS = 8
# Kinds of a cell's first cause behind which a pair may show more: no cause, or effects of one.
_OPEN = ("", UNEXPLAINED, "wrong_views", "lost_views", "moved_frame")
# Kinds of causes that a cell's own fit does not find. Those of a robot are in all of its pairs.
_OF_ROBOT = ("something_moved", "late_poses")
_OF_CAMERA = ("other_lens", "image_sizes", "lens", "exchanged_views")
# Causes of a pair whose views agree.
_SIZES = (*SOURCES, "few_stops", "too_few_stops", "place", "weak_motion")
# Frames by two pairs that are further apart than so many sigmas, and than an arm errs, are others.
_SIGMAS = 6.0


@dataclass(frozen=True, eq=False)
class PairAlone:
    """A robot, a camera and a target of a cell, calibrated by themselves."""

    robot: str  # Name of the robot in the session.
    pair: CameraTargetPair  # The camera, the target and their views.
    answer: RunState  # The finished run.

    @property
    def words(self) -> str:
        """Camera and target in a sentence."""
        return f"{self.pair.camera} and {self.pair.target}"

    @property
    def frames(self) -> dict[str, FloatArray]:
        """(4, 4) camera and target in what carries them, by the cell's names."""
        camera, target = [*self.answer.assessment.fit.frames.values()][:2]
        return {self.pair.camera: camera, self.pair.target: target}

    def covariance(self, frame: str) -> FloatArray:
        """(6, 6) covariance of the camera's or the target's frame."""
        names = [*self.answer.assessment.fit.frames][:2]
        return self.answer.assessment.fit.covariance((EDGE, names[frame == self.pair.target]))


def is_open(run: RunState) -> bool:
    """Whether a cell's verdict leaves open what a pair of it may show alone."""
    verdict = run.verdict
    if verdict is None or verdict.status == "good":
        return False
    kind = next((cause.kind for cause in verdict.causes), "")
    knocked = _knocked(run) if kind == "moved_frame" else ()
    return kind in _OPEN and (not knocked or any(frame.startswith("cam") for frame in knocked))


def _knocked(run: RunState) -> tuple[str, ...]:
    """The frames that moved, where they did so by no more than what is knocked does."""
    moves = () if run.assessment_or_none is None else run.assessment_or_none.moved
    is_far = any(np.greater((move.shift_mm, move.turn_deg), KNOCKED).any() for move in moves)
    return () if is_far else tuple(move.frame for move in moves)


def pairs_alone(run: RunState, calibrated: PairRun) -> list[PairAlone]:
    """The pairs of a cell that give a result by themselves, those of most views first."""
    every = [
        (robot, pair)
        for robot in (() if run.session.has_one_pair else run.session.robots)
        for pair in pairs_of(run, robot)
        if len(pair.poses) >= FEWEST_ROWS
    ]
    every.sort(key=lambda item: -len(item[1].poses))
    found = list[PairAlone]()
    for at, (robot, pair) in enumerate(every[:_MOST_PAIRS] if len(every) > 1 else ()):
        if run.progress is not None:
            run.progress("pairs", at, min(len(every), _MOST_PAIRS))
        pair_run = of_pair(run, robot, pair)
        corners = {
            view: seen for look in pair_run.cameras.values() for view, seen in look.corners.items()
        }
        try:
            answer = calibrated(pair_run.session, corners)
        except (VisioncalError, ValueError, ArithmeticError):
            # Another pair may show why, and the cell's own answer stands; singular matrices, too.
            continue
        found.append(PairAlone(robot, pair, answer))
    return found


def found_alone(run: RunState, every: Sequence[PairAlone]) -> Iterator[Finding]:
    """Causes that pairs show by themselves, and where two of them contradict each other."""
    knocked = _knocked(run)
    for robot in run.session.robots:
        of_robot = [one for one in every if one.robot == robot]
        causes = defaultdict[str, list[tuple[PairAlone, Finding]]](list)
        for one in of_robot:
            verdict = one.answer.verdict
            for cause in () if verdict is None else verdict.causes[:2]:
                causes[cause.kind].append((one, cause))
        yield from _of_cameras(run, causes, knocked)
        if not knocked:
            # Of one camera alone, the camera itself was moved, as the cell's own fit says.
            shared = [kind for kind in _OF_ROBOT if len(causes[kind]) == len(of_robot) > 0]
            yield from (each for kind in shared for each in _of_robot(run, robot, causes[kind]))
            yield from () if shared else _contradictions(run, of_robot)


def _of_cameras(
    run: RunState,
    causes: Mapping[str, Sequence[tuple[PairAlone, Finding]]],
    knocked: Sequence[str],
) -> Iterator[Finding]:
    """Causes of single cameras; where frames seem to have been knocked, those that look like it."""
    for kind in LIKE_KNOCKS if knocked else (*LIKE_KNOCKS, *_OF_CAMERA):
        for one, cause in causes[kind]:
            if knocked and {*knocked} != {one.pair.camera}:
                continue
            found = cause.of("" if len(run.session.cameras) < 2 else one.pair.camera)
            if kind in LIKE_KNOCKS and cause.do is not None:
                # The pair's later views are not all that could be calibrated alone.
                do = Remedy(cause.do.plain or cause.do.words)
                moved = "The result treats the camera as moved." if knocked else ""
                found = replace(found, consequence=moved, rivals=(), do=do)
            yield found


def _of_robot(
    run: RunState, robot: str, shown: Sequence[tuple[PairAlone, Finding]]
) -> Iterator[Finding]:
    """The cause of one kind that all pairs of a robot show."""
    first = shown[0][1]
    if first.kind == "something_moved" and any(cause.do != IN_MOTION for _, cause in shown):
        tool = _tool_switched(run, robot, shown)
        yield from () if tool is None else (tool,)
        return
    views = sorted({view for _, cause in shown for view in cause.views})
    yield replace(first.of(robot_words(robot)), views=tuple(views))


def _tool_switched(
    run: RunState, robot: str, found: Sequence[tuple[PairAlone, Finding]]
) -> Finding | None:
    """The finding that a tool was active at some stops of a robot, which all of its pairs show.

    Each pair leaves out the views with the tool, or those without it: then its tool is the inverse.
    """
    tools = [None if cause.do is None else cause.do.option.tool for _, cause in found]
    stops = stops_by_view(run.session)
    active, idle = set[int](), set[int]()
    for (one, cause), tool in zip(found, tools, strict=True):
        if tool is None or tools[0] is None:
            return None
        left_out, used = ({stops[at] for at in some} for some in (cause.views, one.answer.used))
        if _is_same(tools[0], tool):
            active, idle = active | left_out, idle | used
        elif _is_same(tools[0], invert(tool)):
            active, idle = active | used, idle | left_out
        else:
            return None
    if active & idle or tools[0] is None:
        return None
    first, last = min(active), max(active)
    # Before or after a switch it was active at all stops.
    first = first if min(idle) < first else min(stops.values())
    last = last if max(idle) > last else max(stops.values())
    is_switched = not any(first <= stop <= last for stop in idle)
    views = [
        view.number
        for view in rows_of_robot(run.session, robot)
        if (first <= stop_of(view) <= last if is_switched else stop_of(view) in active)
    ]
    shown, *others = (pair.words for pair, _ in found)
    alike = f", and alike of {some_of(others)}," if others else ""
    words = (
        f"{robot_words(robot)}: in {view_words(views)}, the controller's tool was another one, by "
        f"{other_frame(tools[0], np.eye(4))}, as its rows of {shown}{alike} show."
    )
    do = without_tool(tools[0], views, "fasten what the flange carries, and record again.")
    return Finding("something_moved", f"{words[0].upper()}{words[1:]}", do, tuple(views))


def _is_same(tool: FloatArray, other: FloatArray) -> bool:
    """Whether two tools or turns are one, but for what an arm errs by."""
    return bool(np.less(_apart(invert(tool) @ other), CalibrationLimits.arm_errors).all())


def of_all_rows(
    found: Finding,
    run: RunState,
    robot: str,
    pair: CameraTargetPair | None = None,
    *,
    of_images: bool = False,
) -> Remedy | None:
    """A finding's remedy whose command changes all rows of a robot at the stops of its views.

    Between two rows that are shifted all are, whether or not they are of the same pair; beyond the
    first or the last one that a pair has, too. Where the images of its camera are, and not the
    poses, these are the camera's rows.
    """
    do, rows = found.do, run.session.views
    if do is None or do.option.name not in ("shift", "positions"):
        return do
    stops = {stop_of(at) for at in rows if not found.views or at.number in found.views}
    of_robot = rows_of_robot(run.session, robot)
    ends = [at for at, view in enumerate(of_robot) if stop_of(view) in stops]
    if not ends:
        return Remedy(do.words)
    if do.option.name == "shift":
        shown = {*found.views} if pair is None else {*pair.poses}
        first = 0 if pair is not None and min(shown) in found.views else ends[0]
        end = None if pair is not None and max(shown) in found.views else ends[-1] + 1
        stops = {stop_of(at) for at in of_robot[first:end]}
    if of_images and pair is not None:
        seers = {row.view.number: row.seer for row in run.session.observations}
        of_robot = [view for view in rows if seers.get(view.number) == pair.camera]
    every = tuple(at.number for at in of_robot if stop_of(at) in stops)
    value = f"{do.option.value}{':images' * of_images}"
    return do.by(replace(do.option, value=value, views=every))


def _contradictions(run: RunState, every: Sequence[PairAlone]) -> Iterator[Finding]:
    """Frames that two pairs of one robot place otherwise, each pair's with its nearest rival's."""
    sound = [one for one in every if _agrees(one)]
    for at, other in enumerate(sound):
        for one in sound[:at]:
            for frame in one.frames.keys() & other.frames.keys():
                step = invert(one.frames[frame]) @ other.frames[frame]
                covariance = one.covariance(frame) + other.covariance(frame)
                twist = log(step)
                is_clear = twist @ np.linalg.pinv(covariance, hermitian=True) @ twist > _SIGMAS**2
                if is_clear and np.greater(_apart(step), CalibrationLimits.arm_errors).any():
                    yield _contradiction(run, one, other, frame, step)
                    return


def _apart(step: FloatArray) -> tuple[float, float]:
    mm, deg = pose_difference(np.eye(4), step)
    return float(mm), float(deg)


def _agrees(one: PairAlone) -> bool:
    """Whether the views of a pair agree by themselves, with no cause but sources of its sigmas."""
    verdict = one.answer.verdict
    if verdict is None or verdict.status == "bad":
        return False
    return all(cause.kind in _SIZES for cause in verdict.causes)


def _contradiction(
    run: RunState, one: PairAlone, other: PairAlone, frame: str, step: FloatArray
) -> Finding:
    """The finding that two pairs agree by themselves, and place a frame otherwise."""
    views = tuple(sorted(other.pair.poses))
    agreement = f"{one.words} agree by themselves, and so do {other.words}"
    boards = {at: run.session.boards[name] for name, at in run.session.board_frames.items()}
    board = boards.get(frame)
    if board is not None and _is_half_turn(board, step):
        words = (
            f"{other.pair.camera} numbers the corners of {frame} from the other end, turned by 180 "
            f"deg in its plane, than {one.pair.camera}: {agreement}."
        )
        return Finding(PAIRS_APART.kind, words, turned_back(board, views), views)
    others = [view.number for view in run.session.views if view.number not in other.pair.poses]
    moved = "it was moved" if board is not None else "the board was another one"
    words = (
        f"{agreement}, but place {frame} {mm_and_deg(*_apart(step))} apart: between their views, "
        f"{moved}, or the rows of one have another lens, board or robot than is stated."
    )
    do = or_alone(
        "Look at one picture of each, and record both with one setup; or calibrate without the "
        f"views of {other.words}.",
        others,
    )
    return Finding(PAIRS_APART.kind, words, do, views)


def _is_half_turn(board: Target, step: FloatArray) -> bool:
    """Whether a step turns a board by 180 deg in its plane, but for what an arm errs by."""
    return _is_same(half_turn_of(board)[0], step)


PAIRS_APART = Suspect("pairs_apart", None, 1e-6, of_chain=True, hides=("wrong_views", UNEXPLAINED))
