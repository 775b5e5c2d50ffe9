"""Whether the alignment of a cell can be trusted, and which link of it is the weakest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.alignment.cell import Cell
from visioncal.alignment.faults import moved_words
from visioncal.alignment.solving import Solved
from visioncal.calibration import Edge, Moved, Untied, Verdict, VerdictStatus
from visioncal.errors import DegenerateError
from visioncal.estimation.observability import (
    SIGMA_LIMIT_M,
    SIGMA_LIMIT_RAD,
    Direction,
    axis_words,
)
from visioncal.figures import figure
from visioncal.files import some_of
from visioncal.stages.found import noise_words
from visioncal.types import FloatArray

# A board whose size is off by more of its own sigmas than this is another than was stated.
_SIZE_SIGMAS = 3.0


@dataclass(frozen=True)
class Limits:
    """Where doubt begins and where trust ends: (check, bad) limits.

    Attributes:
        sigma_mm: Sigma of a frame's place [mm].
        sigma_deg: The same in rotation [deg].
        pixel_px: Noise of a corner's coordinate [px].
        robot_mm: Error of a flange from stop to stop [mm].
        level: How much more a camera's poses scatter than its corners say.
        stops: Stops in the fit; fewer leave too little to check the result with.
        left_out: Share of observations that disagree.
    """

    sigma_mm: tuple[float, float] = (1.0, 3.0)
    sigma_deg: tuple[float, float] = (0.1, 0.3)
    pixel_px: tuple[float, float] = (0.7, 3.0)
    robot_mm: float = 0.2
    level: float = 2.0
    stops: tuple[int, int] = (10, 5)
    left_out: tuple[float, float] = (0.25, 0.6)


def check_determined(cell: Cell, edges: Mapping[str, Edge]) -> None:
    """Refuses a cell in which a frame is not determined well enough for anybody.

    Args:
        cell: The cell.
        edges: The transforms that are to be known: of frames where they stood last.

    Raises:
        DegenerateError: A direction's sigma is over the limit, or it is not determined at all.
    """
    for name, edge in edges.items():
        worst = worst_direction(edge)
        if worst.sigma > worst.limit:
            raise DegenerateError(
                f"align: {name}: {worst.words} has a predicted sigma of {worst.figure}.",
                culprits=[name],
                next_step=_more(cell, name),
            )


def worst_direction(edge: Edge) -> Direction:
    """Finds it, in the axes of the frame that the transform hangs on."""
    found = []
    for is_rotation in (False, True):
        at = slice(0, 3) if is_rotation else slice(3, 6)
        values, vectors = np.linalg.eigh(edge.covariance[at, at])
        axis = axis_words(edge.matrix[:3, :3] @ vectors[:, -1])
        words = f"its rotation about {axis}" if is_rotation else f"its offset along {axis}"
        limit = float(SIGMA_LIMIT_RAD if is_rotation else SIGMA_LIMIT_M)
        found.append(Direction(words, float(np.sqrt(max(values[-1], 0.0))), limit, is_rotation))
    return max(found, key=lambda it: it.sigma / it.limit)


def _more(cell: Cell, frame: str) -> str:
    """What would determine a frame better."""
    rows = [it for it in cell.rows if frame in (it.seer, it.seen)]
    others = sorted({it.seen if it.seer == frame else it.seer for it in rows})
    if not others:
        return "Add stops at which its robot turns about two axes or more."
    if frame.startswith("target") and len(others) == 1 and frame not in _carried(cell):
        return (
            f"Let another camera than {others[0]} see {frame}, too, or measure its squares and "
            "state square_sigma_m."
        )
    return (
        f"Add stops with {some_of(others)} and {frame}, turned by 30 degrees or more about two "
        "axes."
    )


def _carried(cell: Cell) -> set[str]:
    """The frames that robots carry."""
    return {it for it in cell.tree.branches if cell.tree.body(it) != cell.tree.root}


def weakest_link(cell: Cell, edges: Mapping[str, Edge]) -> str:
    """Names the link of the cell that is known worst, and what it rests on."""
    if not edges:
        return ""
    name, edge = max(edges.items(), key=lambda it: it[1].sigma_mm)
    worst = worst_direction(edge)
    return (
        f"The weakest link is {name}: sigma {figure(edge.sigma_mm)} mm and "
        f"{figure(edge.sigma_deg)} deg, most of it in {worst.words} of "
        f"{cell.tree.branches[name].parent if name in cell.tree.branches else 'its parent'}. "
        f"{_resting(cell, name)}"
    )


def _resting(cell: Cell, frame: str) -> str:
    rows = [it for it in cell.rows if frame in cell.tree.above(it.seer)]
    rows += [it for it in cell.rows if frame in cell.tree.above(it.seen)]
    pairs: dict[str, int] = {}
    for it in rows:
        key = f"{it.seer} of {it.seen}"
        pairs[key] = pairs.get(key, 0) + 1
    least = sorted(pairs.items(), key=lambda it: it[1])
    return f"It rests on {some_of([f'{count} views by {key}' for key, count in least], 4)}."


def judge(
    solved: Solved,
    edges: Mapping[str, Edge],
    noise: Mapping[str, Mapping[str, float]],
    moved: Sequence[Moved],
    untied: Sequence[Untied],
    warnings: Sequence[str],
    notes: Sequence[str] = (),
    limits: Limits | None = None,
) -> Verdict:
    """Judges an alignment.

    Args:
        solved: The fit.
        edges: The transforms by the frames that they place.
        noise: Estimated standard deviations.
        moved: What moved.
        untied: What nothing ties.
        warnings: Reasons for doubt that were found before.
        notes: What is good to know.
        limits: Where doubt begins.
    """
    limits = limits or Limits()
    doubts: list[tuple[VerdictStatus, str]] = [("check", it) for it in warnings]
    doubts += [("good", it) for it in notes]
    doubts += [("check", moved_words(it)) for it in moved]
    doubts += [("check", f"{it.frame} is tied to nothing. {it.remedy}") for it in untied]
    doubts += _weak(solved.cell, edges, limits)
    doubts += _noisy(noise, limits)
    stops = len(np.unique(solved.agreed.problem.observations.stops[solved.agreed.used]))
    if stops < limits.stops[0]:
        words = f"{stops} stops leave little to check the result with: record {limits.stops[0]}."
        doubts.append(("bad" if stops < limits.stops[1] else "check", words))
    out = int(np.sum(~solved.agreed.used))
    if out:
        status = _beyond(out / len(solved.agreed.used), limits.left_out) or "good"
        doubts.append(
            (
                status,
                f"{out} of {len(solved.agreed.used)} observations disagree with the rest and are "
                "left out: see what is said of each.",
            )
        )
    grades: tuple[VerdictStatus, ...] = ("bad", "check")
    for grade in grades:
        if any(it == grade for it, _ in doubts):
            return Verdict(grade, tuple(words for _, words in doubts))
    agreed = (
        f"All {len(edges)} frames are tied, and {int(solved.agreed.used.sum())} observations agree."
    )
    return Verdict("good", (agreed, *(words for _, words in doubts)))


def _weak(cell: Cell, edges: Mapping[str, Edge], limits: Limits) -> list[tuple[VerdictStatus, str]]:
    found: list[tuple[VerdictStatus, str]] = []
    for name, edge in edges.items():
        status = _beyond(edge.sigma_mm, limits.sigma_mm) or _beyond(
            edge.sigma_deg, limits.sigma_deg
        )
        if status:
            words = (
                f"{name} is known to {figure(edge.sigma_mm)} mm and {figure(edge.sigma_deg)} deg "
                f"only. {_more(cell, name)}"
            )
            found.append((status, words))
    return found


def _beyond(value: float, limits: tuple[float, float]) -> VerdictStatus | None:
    if value > limits[1]:
        return "bad"
    return "check" if value > limits[0] else None


def _noisy(
    noise: Mapping[str, Mapping[str, float]], limits: Limits
) -> list[tuple[VerdictStatus, str]]:
    found: list[tuple[VerdictStatus, str]] = []
    for name, levels in noise.items():
        pixel, robot = levels.get("pixel_px", 0.0), levels.get("translation_mm", 0.0)
        status = _beyond(pixel, limits.pixel_px)
        if status:
            found.append(
                (status, f"{name}: corners scatter by {figure(pixel)} px; 0.05 to 0.3 are usual.")
            )
        level = levels.get("level", 1.0)
        if "pixel_px" in levels and level > limits.level:
            found.append(
                (
                    "check",
                    f"{name}: its poses scatter {figure(level)} times as much as its corners say: "
                    "squares of few pixels, blur, or a lens that is not as stated. Go nearer, or "
                    "show it larger squares.",
                )
            )
        if robot > limits.robot_mm and not name.startswith("cam"):
            found.append(
                (
                    "check",
                    f"Robot {name} errs by {figure(robot)} mm from stop to stop; arms repeat to "
                    "0.1 mm or better. Its kinematics may be behind it, or poses that belong to "
                    "other images: calibrate it by itself.",
                )
            )
    return found


def noise_warnings(solved: Solved) -> list[str]:
    """Words cameras whose corners scatter more than corners.csv states."""
    if (seen := solved.seen) is None:
        return []
    found = []
    for (name, problem), it in zip(seen.looks.problems.items(), seen.compressed, strict=True):
        free = np.flatnonzero(np.isin(seen.looks.places(name), seen.free))
        words, is_doubt = noise_words(problem.stack, it.residuals, problem.unknowns(it, free))
        if is_doubt:
            found.append(f"{name}: {words}")
    return found


def size_warnings(solved: Solved, spread: FloatArray) -> list[str]:
    """Words boards whose size is another than was stated, by more than noise says."""
    looks, names = solved.looks, list(solved.cell.session.boards)
    if looks is None:
        return []
    found = []
    for board in looks.printed:
        (place,) = looks.scale_of(board)
        (at,) = solved.columns_of(np.array([place]))
        scale, prior = float(looks.values[place]), float(looks.prior_sigma[place])
        sigma = float(np.hypot(np.sqrt(spread[at, at]), prior))
        if abs(scale) > _SIZE_SIGMAS * sigma:
            name = f"target_{names[board]}" if names[board] else "target"
            larger = "larger" if scale > 0 else "smaller"
            found.append(
                f"{name} is {figure(100 * abs(scale))} % {larger} than is stated, by the robots' "
                f"motion; it was stated to {figure(100 * prior)} %. Measure its squares again."
            )
    return found
