"""Facts and tables about a result, for pages and recordings."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from visioncal.core.number_format import decimals_for, matched, significant
from visioncal.core.transforms import pose_difference
from visioncal.core.types import Target
from visioncal.present.tables import Fact, Table, TableRow
from visioncal.results import Calibration, CellResult, Rms, ViewResult
from visioncal.results.depth import DepthResult
from visioncal.results.sections import BoardResult, UncertaintyResult
from visioncal.results.views import left_out_rms, rms_of

PLUS_MINUS, DEGREE = "\N{PLUS-MINUS SIGN}", "\N{DEGREE SIGN}"
# Suffixes of names on disk, and the units shown.
_UNITS = {"_px": "px", "_mm": "mm", "_deg": "deg", "level": "times what is said of it"}
# Sources of uncertainty, in words.
SOURCES = {
    "pixels": "noise of the corners",
    "instrument": "the instrument's readings",
    "robot": "the robot, from stop to stop",
    "poses": "noise of the poses",
    "intrinsics": "uncertainty of the lens",
    "board": "uncertainty of the board",
    "arm": "errors of the arm's links",
    "temperature": "uncertainty of the arm's drift with temperature",
    "priors": "what was measured by hand",
    "held_values": "values that are held",
    "noise_level": "how well the robot's noise is known",
    "lens_field": "the lens beyond its model",
}


def readable_time(created: str) -> str:
    """A time in ISO 8601, for display; other texts are returned as they are."""
    try:
        time = datetime.fromisoformat(created)
    except ValueError:
        return created
    return f"{time:%Y-%m-%d %H:%M %Z}".strip()


def of(name: str) -> str:
    """The suffix ` of <name>`; empty without a name."""
    return f" of {name}" if name else ""


def frame_words(frame: str) -> str:
    """A frame's name in words."""
    return {"cam": "the camera", "base": "the robot's base"}.get(frame, f"the {frame}")


def answering_solver(calibration: Calibration) -> str | None:
    """The solver whose transforms are the result; None if there is none."""
    for name, result in calibration.solvers.items():
        if all(
            edge in result.matrices and np.array_equal(result.matrices[edge], placed.matrix)
            for edge, placed in calibration.edges.items()
        ):
            return name
    return None


def solver_table(calibration: Calibration) -> Table | None:
    """Residuals of each solver, and the distances of its edges from the result's."""
    if not calibration.solvers:
        return None
    titles = ("solver", "rms, mm", "rms, deg", *(f"{edge} off by" for edge in calibration.edges))
    chosen, rows = answering_solver(calibration), []
    for name, result in calibration.solvers.items():
        distances = [
            f"{significant(mm)} mm, {significant(deg)}{DEGREE}"
            if name != chosen and edge_name in result.matrices
            else significant(None)
            for edge_name, edge in calibration.edges.items()
            for mm, deg in [
                pose_difference(edge.matrix, result.matrices.get(edge_name, edge.matrix))
            ]
        ]
        label = f"{name} (result)" if name == chosen else name
        rows.append((label, significant(result.rms_mm), significant(result.rms_deg), *distances))
    return Table.of(titles, rows)


def moved_table(cell: CellResult) -> Table:
    """Frames that moved during the session, and frames that no observation links."""
    rows = []
    for move in cell.moved:
        distance = f"{significant(move.shift_mm)} mm, {significant(move.turn_deg)}{DEGREE}"
        explanation = (
            f"Between stops {move.last_stop} and {move.first_stop}. {move.frame} is where it stood "
            f"last, {move.before} where it stood before."
        )
        rows.append(TableRow((move.frame, distance, explanation), "look"))
    rows += [
        TableRow((untied.frame, "not tied", untied.remedy), "left-out") for untied in cell.untied
    ]
    return Table(("", "", ""), tuple(rows), (0, 1, 2))


def residual_table(calibration: Calibration) -> Table:
    """Residuals of the fit, of cross-validation, and of the declared hold-out set."""
    validation = calibration.validation
    left_out = validation.held_out if validation.is_of_unseen else None
    sets = (
        ("used views, as fitted", calibration.rms),
        (f"left out in turn ({validation.method})", left_out),
        ("declared hold-out views", validation.holdout),
    )
    return Table.of(
        ("views", "mm", "deg", "px"),
        [(label, *_rms_cells(rms)) for label, rms in sets if rms is not None],
    )


def _rms_cells(rms: Rms) -> Iterator[str]:
    return map(significant, (rms.mm, rms.deg, rms.px))


@dataclass(frozen=True)
class SeenPair:
    """All observations of one frame by another."""

    seer: str  # Observing frame.
    seen: str  # Observed frame.
    used: int  # Number of observations that the fit used.
    left_out: int  # Number of observations that it did not use.
    rms: Rms | None  # Residuals of the used ones; None if there are none.
    # Their residuals by fits without their stops (cross-validation); None where unknown.
    unseen: Rms | None


def pairs(views: Iterable[ViewResult]) -> tuple[SeenPair, ...]:
    """Observations grouped by observing and observed frame, with their residuals."""
    rows: dict[tuple[str, str], list[ViewResult]] = {}
    for view in views:
        rows.setdefault((view.seer, view.seen), []).append(view)
    summaries = []
    for (seer, seen), group in rows.items():
        used = sum(view.used for view in group)
        unseen = any(view.used and view.left_out_mm is not None for view in group)
        rms = (rms_of(group) if used else None, left_out_rms(group) if unseen else None)
        summaries.append(SeenPair(seer, seen, used, len(group) - used, *rms))
    return tuple(summaries)


def pair_table(calibration: Calibration) -> Table | None:
    """Residuals by camera and target; None for one camera and one robot."""
    if calibration.cell is None:
        return None
    with_unseen = calibration.validation.is_of_unseen
    titles = ["who", "saw", "used", "left out", "rms, mm", "rms, deg", "rms, px"]
    if with_unseen:
        titles += ["unseen, mm", "unseen, deg", "unseen, px"]
    rows = []
    for pair in pairs(calibration.views):
        figures = [*_rms_cells(pair.rms)] if pair.rms else [significant(None)] * 3
        if with_unseen:
            figures += [*_rms_cells(pair.unseen)] if pair.unseen else [significant(None)] * 3
        rows.append((pair.seer, pair.seen, str(pair.used), str(pair.left_out), *figures))
    return Table.of(titles, rows, (0, 1))


def source_table(calibration: Calibration) -> Table | None:
    """Uncertainty budget of a point, or of each frame of a cell [mm]; None where unknown.

    For a cell, a source below a hundredth of every frame's variance is left out.
    """
    point_budget, cell_uncertainty = calibration.budget, calibration.by_name.uncertainty
    if point_budget is not None:
        budget_rows = [
            (SOURCES.get(name, name), significant(value), point_budget.percent(name))
            for name, value in point_budget.parts_mm.items()
        ]
        total = ("total", significant(point_budget.total_mm), "")
        return Table.of(("source", "sigma, mm", "of the variance"), [*budget_rows, total])
    budgets = {} if cell_uncertainty is None else cell_uncertainty.budget_mm
    if not budgets:
        return None
    names = dict.fromkeys(name for budget in budgets.values() for name in budget)
    # A hundredth of the variance.
    shown = [
        name
        for name in names
        if any(budget.get(name, 0.0) > 0.1 * budget["total"] for budget in budgets.values())
    ]
    edge_rows = [
        (edge, *(significant(budget.get(name)) for name in shown))
        for edge, budget in budgets.items()
    ]
    return Table.of(("", *(SOURCES.get(name, name) for name in shown)), edge_rows)


def spectrum_facts(uncertainty: UncertaintyResult) -> tuple[Fact, ...]:
    """Sigmas of the least and the best known direction, as shares of the largest accepted."""
    shares = uncertainty.spectrum[uncertainty.spectrum > 0.0]
    if not len(shares):
        return ()
    worst, best = (f"{significant(100.0 * float(end))} %" for end in (shares.max(), shares.min()))
    note = f"of the largest accepted sigma, 5 mm or 0.5 deg; the best known: {best}"
    return (Fact("least known direction", worst, note),)


def noise_facts(calibration: Calibration) -> tuple[Fact, ...]:
    """Noise levels of each sensor and each robot, with their 95 % intervals where known."""
    named, facts = calibration.by_name, []
    intervals = {} if named.uncertainty is None else named.uncertainty.noise_95
    for of, levels in named.noise.items():
        who = f"robot {of}" if of in named.flanges.values() else of
        for name, value in levels.items():
            suffix = next((unit for unit in _UNITS if name.endswith(unit)), "")
            label = f"{who} {name.removesuffix(suffix).replace('_', ' ')}".strip()
            interval = " to ".join(map(significant, intervals.get(of, {}).get(name, ())))
            size = f"{significant(value)} {_UNITS.get(suffix, '')}".strip()
            facts.append(Fact(label, size, f"95 %: {interval}" if interval else ""))
    return tuple(facts)


def board_facts(
    calibration: Calibration, board: BoardResult, target: Target | None
) -> tuple[Fact, ...]:
    """The board's size and shape, stated and estimated; empty if nothing was estimated."""
    if not board.sigma:
        return ()
    if answering_solver(calibration) not in (None, "joint"):
        return (Fact("size and shape", "as stated", "a closed form takes them as they are"),)
    facts = [] if target is None else list(_size_facts(board, target))
    is_bent, depth = board.is_bent, f"{significant(board.bend_mm)} mm"
    flat = Fact("bend", "none", "flat within what is seen")
    facts.append(Fact("bend", depth, "of depth over its corners") if is_bent else flat)
    if "shear" in board.estimated:
        angle, sigma = np.rad2deg([board.shape["shear"], board.sigma["shear"]])
        tolerance = f"{PLUS_MINUS} {significant(sigma)}"
        angle_deg = f"{90 - angle:.{decimals_for(sigma)}f} deg"
        facts.append(Fact("angle of rows and columns", angle_deg, tolerance))
    return tuple(facts)


def _size_facts(board: BoardResult, target: Target) -> tuple[Fact, ...]:
    sigma_mm = 1e3 * target.square_sigma_m
    stated = Fact(
        "squares, stated",
        f"{matched(1e3 * target.square_m, sigma_mm)} mm",
        f"{PLUS_MINUS} {significant(sigma_mm)}",
    )
    adjusted = {"scale", "aspect"} & set(board.estimated)
    if not adjusted:
        return (stated, Fact("squares, found", "as stated", "nothing speaks against it"))
    posterior_mm = 1e3 * target.square_m * board.sigma.get("scale", target.square_sigma_m)
    decimals = decimals_for(posterior_mm)
    scale, half = 1.0 + board.shape["scale"], 0.5 * board.shape["aspect"]
    sides_m = target.square_m * (scale - half), target.square_m * (scale + half)
    x_mm, y_mm = (f"{1e3 * side:.{decimals}f}" for side in sides_m)
    note = f"{PLUS_MINUS} {significant(posterior_mm)}"
    if "scale" in adjusted:
        note += ", between what is stated and what the robot's motion measures"
    size = f"{x_mm} \N{MULTIPLICATION SIGN} {y_mm} mm"
    return (stated, Fact("squares, found", size, note))


def depth_table(depth: DepthResult) -> Table:
    """How a camera's depth deviates from the true one."""
    names = ("scale [%]", "offset [mm]", "tilt in u [mm]", "tilt in v [mm]", "bowl [mm]")
    units = np.array([100.0, 1e3, 1e3, 1e3, 1e3])
    values = zip(
        names, depth.values * units, np.sqrt(np.diag(depth.covariance)) * units, strict=True
    )
    rows = [
        (name, f"{matched(value, sigma)} {PLUS_MINUS} {significant(sigma)}")
        for name, value, sigma in values
    ]
    return Table.of(("", ""), [*rows, ("black against white [mm]", significant(1e3 * depth.ink_m))])
