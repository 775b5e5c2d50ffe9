"""Aligning a whole cell: the way from a session to its frames, each with respect to all others."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from visioncal.calibration import Alignment, CameraResult, Edge, RobotResult, Sight, Untied
from visioncal.errors import DataError
from visioncal.estimation.arm import stops_of
from visioncal.estimation.intervals import freedom_of, noise_intervals
from visioncal.estimation.problem import Problem
from visioncal.estimation.solve import covariance_of
from visioncal.pipeline.budget import budget_mm, columns_of_boards, left_out
from visioncal.pipeline.faults import (
    PoseFault,
    Version,
    moved_words,
    movements,
    pose_faults,
    reasons,
    residuals,
    versions,
)
from visioncal.pipeline.held import held_sights
from visioncal.pipeline.judging import (
    check_cell,
    findings_of,
    weakest_link,
)
from visioncal.pipeline.robots import (
    covariance_beside_noise,
    doubts_of_arms,
    notes_on_arms,
)
from visioncal.pipeline.solving import Solved, sensors_of, solve
from visioncal.pipeline.ties import untied_words
from visioncal.pipeline.written import fit_sections
from visioncal.robot import CONVENTIONS, Convention, Robot
from visioncal.session import Session, frame_name
from visioncal.stages.arms import ArmFound
from visioncal.stages.cameras import detect_targets, estimate_lenses, locate_targets
from visioncal.stages.cell import Cell, read_cell, robot_key
from visioncal.stages.clock import Pair
from visioncal.stages.clocks import set_clocks
from visioncal.stages.delays import FoundDelay
from visioncal.stages.diagnose import misfits
from visioncal.stages.judge import judge
from visioncal.stages.kinematics import check_level
from visioncal.stages.need import Fitted, need_met, picks_of
from visioncal.stages.observed import Observed
from visioncal.stages.offset import Clock
from visioncal.stages.priors import prior_words
from visioncal.stages.readings import read_instruments
from visioncal.stages.robots import check_joints, read_robots
from visioncal.stages.validate import HeldOut
from visioncal.targets import corner_positions, target_document
from visioncal.threads import one_blas_thread
from visioncal.types import Corners, FloatArray, Progress


def align(
    session: Session | Path | str,
    *,
    level: str = "auto",
    convention: Convention | None = None,
    need_mm: float | None = None,
    need_deg: float | None = None,
    corners: Mapping[int, Corners] | None = None,
    progress: Progress | None = None,
) -> Alignment:
    """Aligns a cell of any number of robots, cameras and boards, in one joint adjustment.

    Several threads may do so at once, as with `calibrate`.

    Args:
        session: A session, or the path of its folder or recording.
        level: How far each arm is calibrated, as `calibrate` has it; beyond `hand-eye` it takes
            joint angles and a model.
        convention: Of the joint table in which calibrated arms' numbers are told.
        need_mm: How near picks have to come [mm], in the place of what `[need]` declares.
        need_deg: The same in rotation [deg].
        corners: What was found in its images before, by view; None to look.
        progress: Told of long work.

    Returns:
        All frames with their joint covariance, and the verdict.

    Raises:
        DataError: The input is wrong or shows no target.
        DegenerateError: A robot is tied to nothing, or the observations leave a frame open.
    """
    check_level(level)
    if convention is not None and convention not in CONVENTIONS:
        raise DataError(f"convention {convention!r} is not one of {', '.join(CONVENTIONS)}.")
    loaded = session if isinstance(session, Session) else Session.load(session)
    loaded = loaded.needing(need_mm, need_deg)
    looked = Observed(loaded, progress, poses=read_instruments(loaded))
    looked = locate_targets(estimate_lenses(detect_targets(looked, corners)))
    if progress is not None:
        progress("align", 0, 1)
    with one_blas_thread():
        calibrates = level != "hand-eye"
        looked = read_robots(set_clocks(looked))
        looked = check_joints(looked, drops=calibrates, takes=calibrates)
        cell = read_cell(looked)
        solved = solve(cell, looked, level)
        return alignment_of(cell, looked, solved, convention)


def alignment_of(
    cell: Cell,
    looked: Observed,
    solved: Solved,
    convention: Convention | None = None,
) -> Alignment:
    """Puts the result together.

    Args:
        cell: The whole cell as it was read.
        looked: What was observed in it.
        solved: The fit of what of it is tied.
        convention: Of the joint table in which calibrated arms' numbers are told.

    Raises:
        DegenerateError: The observations leave a frame open.
    """
    session, agreed = looked.session, solved.agreed
    problem, part = agreed.problem, agreed.problem.subset(agreed.used)
    found = misfits(part, agreed.fit)
    parts = covariance_beside_noise(part, agreed.fit, solved.arms, found)
    spread = sum(parts.values(), covariance_of(part, agreed.fit))
    named = versions(solved)
    edges = _edges(solved, named, spread)
    last = {it.frame: edges[it.frame] for it in named.values() if it.name == it.frame}
    check_cell(solved, looks=any(it.estimated for it in looked.scenes.values()))
    parents = {name: problem.tree.branches[it.key].parent for name, it in _by_name(named).items()}
    kept = {
        name: it.parent
        for name, it in cell.tree.branches.items()
        if name in solved.cell.tree.branches
    }
    told = _found_of_arms(solved, spread, convention)
    untied = tuple(Untied(it, untied_words(cell, it)) for it in solved.untied)
    moved, noise, faults = movements(solved), _noise(solved), pose_faults(solved)
    held_out = left_out(solved)
    sights = _sights(looked, cell, solved, held_out, faults)
    budget = {named[key].name: mm for key, mm in budget_mm(solved, parts).items()}
    of_rest = [
        *prior_words(part, agreed.fit.state, spread, solved.cell.priors),
        *solved.found_of_looks(),
    ]
    findings = findings_of(
        solved,
        sights,
        faults,
        last,
        budget,
        noise,
        workspace_mm={
            robot: 1e3 * float(np.median(it.telling.sigmas_m))
            for robot, it in told.items()
            if it.telling is not None
        },
        spared=looked.spared.keys() | looked.held_back,
        warnings=[
            *doubts_of_arms(solved.arms, found, solved.asked),
            *solved.cell.session.warnings,
            *looked.warnings,
            *(f"Robot {name}: {words}" for name, it in told.items() for words in it.doubts()),
            *(words for words, is_doubt in of_rest if is_doubt),
            *(moved_words(it) for it in moved),
            *(f"{it.frame} is tied to nothing. {it.remedy}" for it in untied),
        ],
        notes=(
            *looked.notes,
            *_clock_words(looked, solved, spread),
            *notes_on_arms(solved.arms, told),
            *(words for words, is_doubt in of_rest if not is_doubt),
        ),
        picks=picks_of(_fitted(solved, part, spread, held_out), session.need),
    )
    return Alignment(
        session_name=session.name,
        session_sha256=session.digest(),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        reference=cell.reference,
        frames=kept | parents,
        robots={name: it.robot for name, it in solved.cell.tree.branches.items() if it.robot},
        edges={f"{parents[name]}_from_{name}": edge for name, edge in edges.items()},
        joint_covariance=spread[: 6 * len(edges), : 6 * len(edges)],
        cameras=_cameras(solved, looked, spread, len(edges)),
        noise=noise,
        sights=sights,
        left_out=held_out.method if np.isfinite(held_out.away_m).any() else "",
        moved=moved,
        untied=untied,
        weakest=weakest_link(solved.cell, last),
        verdict=judge(findings),
        details=_details(looked, solved, spread),
        arms=_arms(session, solved, told),
        targets={name or "target": target_document(it) for name, it in session.plates.items()},
        stages={
            **fit_sections(session, solved, spread, len(edges)),
            "uncertainty": {
                "budget_mm": {f"{parents[it]}_from_{it}": mm for it, mm in budget.items()},
                "noise_95": _intervals(solved),
            },
        },
        need=need_met(findings.need, findings.picks, whole=True),
    )


def _fitted(solved: Solved, part: Problem, spread: FloatArray, held_out: HeldOut) -> Fitted:
    """What picks are predicted from."""
    fit = solved.agreed.fit
    intervals = noise_intervals(part, fit.state, fit.noise)
    freedom = [freedom_of(it.tolist()) for it in intervals]
    return Fitted(
        part,
        fit.state,
        fit.noise,
        spread,
        held_out,
        _middles(solved.cell.session),
        dict(zip(part.robots, freedom, strict=True)),
        solved.arms,
        columns_of_boards(solved),
        part,
    )


def _middles(session: Session) -> dict[str, FloatArray]:
    """(3,) the middle of each target by its frame, in that [m]."""
    return {
        frame_name("target", name): corner_positions(it).mean(axis=0)
        for name, it in session.plates.items()
    }


def _found_of_arms(
    solved: Solved, spread: FloatArray, convention: Convention | None
) -> dict[str, ArmFound]:
    """What the stops tell of the arms, by robot."""
    agreed, middles = solved.agreed, _middles(solved.cell.session)
    part = agreed.problem.subset(agreed.used)
    return {
        name: arm.found(part, agreed.fit, spread, middles, convention)
        for name, arm in solved.arms.items()
    }


def _arms(session: Session, solved: Solved, told: Mapping[str, ArmFound]) -> dict[str, RobotResult]:
    models = session.robot_documents
    found = {
        robot_key(name): RobotResult(Robot.from_document(models[name]) if name in models else None)
        for name in session.robots
    }
    first: dict[int, int] = {}
    for row in solved.cell.rows:
        first.setdefault(row.station, row.view)
    part = solved.agreed.problem.subset(solved.agreed.used)
    for name, arm in solved.arms.items():
        stops = stops_of(part, name)
        stages = arm.at(stops).documents(told[name], [first[it] for it in stops.tolist()])
        found[name] = replace(found[name], stages=stages)
    return found


def _details(looked: Observed, solved: Solved, spread: FloatArray) -> dict[str, Any]:
    """What was found of clocks."""
    if not looked.clocks:
        return {}
    return {
        "clocks": {
            it.words: _fitted_clock(it, at.clock, solved, spread).document()
            for it, at in looked.clocks.items()
        }
    }


def _fitted_clock(pair: Pair, clock: Clock, solved: Solved, spread: FloatArray) -> Clock:
    """A clock as the fit of the whole cell has it, where that estimates it."""
    problem = solved.agreed.problem
    columns = problem.effect_columns.get(pair.effect)
    if columns is None:
        return clock
    (late_s,) = problem.values_of(pair.effect, solved.agreed.fit.state)
    return replace(
        clock,
        camera_minus_robot_s=clock.camera_minus_robot_s + float(late_s),
        sigma_s=float(np.sqrt(spread[columns.start, columns.start])),
        delays=tuple(_fitted_delay(pair, it, solved, spread) for it in clock.delays),
    )


def _fitted_delay(pair: Pair, delay: FoundDelay, solved: Solved, spread: FloatArray) -> FoundDelay:
    """A time within images as the fit of the whole cell has it, where that estimates it."""
    problem, name = solved.agreed.problem, pair.delay(delay.of)
    columns = problem.effect_columns.get(name)
    if columns is None:
        return delay
    (late_s,) = problem.values_of(name, solved.agreed.fit.state)
    sigma_s = float(np.sqrt(spread[columns.start, columns.start]))
    return replace(delay, time_s=delay.time_s + float(late_s), sigma_s=sigma_s)


def _clock_words(looked: Observed, solved: Solved, spread: FloatArray) -> Iterator[str]:
    """Says what the fit of the whole cell makes of clocks that the motion told."""
    for pair, it in looked.clocks.items():
        clock = _fitted_clock(pair, it.clock, solved, spread)
        if clock is not it.clock:
            yield (
                f"{pair.words}: the fit of the whole cell has the camera's clock "
                f"{1e3 * clock.camera_minus_robot_s:+.2f} ms ahead (sigma "
                f"{1e3 * clock.sigma_s:.2g} ms)."
            )


def _by_name(named: Mapping[str, Version]) -> dict[str, Version]:
    return {it.name: it for it in named.values()}


def _edges(solved: Solved, named: Mapping[str, Version], spread: FloatArray) -> dict[str, Edge]:
    """The estimated transforms by the frames that they place."""
    problem, found = solved.agreed.problem, {}
    for key, at in problem.unknown.items():
        block = spread[6 * at : 6 * at + 6, 6 * at : 6 * at + 6]
        found[named[key].name] = Edge(solved.agreed.fit.state.edges[at], block)
    return found


def _noise(solved: Solved) -> dict[str, dict[str, float]]:
    """Estimated standard deviations: of robots by name, of cameras and instruments by frame."""
    fit, problem = solved.agreed.fit, solved.agreed.problem
    found = {
        robot: {
            "translation_mm": 1e3 * float(sigma_m),
            "rotation_deg": float(np.rad2deg(sigma_rad)),
        }
        for robot, (sigma_rad, sigma_m) in zip(problem.robots, fit.noise.robots, strict=True)
    }
    if solved.seen is not None:
        pairs = zip(solved.seen.looks.problems, solved.seen.sigmas_px, strict=True)
        found |= {frame: {"pixel_px": sigma} for frame, sigma in pairs}
    sensors = dict.fromkeys(
        (*sensors_of(solved.cell, solved.poses), *(it.seer for it in solved.cell.rows))
    )
    for frame, level in zip(sensors, fit.noise.sensors.tolist(), strict=True):
        found[frame] = {**found.get(frame, {}), "level": level}
    return found


def _intervals(solved: Solved) -> dict[str, dict[str, list[float]]]:
    """95 % intervals of the levels of robots, as `_noise` names them."""
    agreed = solved.agreed
    part = agreed.problem.subset(agreed.used)
    found = noise_intervals(part, agreed.fit.state, agreed.fit.noise)
    return {
        robot: {
            "translation_mm": (1e3 * shift_m).tolist(),
            "rotation_deg": np.rad2deg(turn_rad).tolist(),
        }
        for robot, (turn_rad, shift_m) in zip(part.robots, found, strict=True)
    }


def _cameras(
    solved: Solved, looked: Observed, spread: FloatArray, edges: int
) -> dict[str, CameraResult]:
    seen, looks = solved.seen, solved.looks
    # Measured poses do without a camera; whoever looks through it later does not.
    found = {
        frame: CameraResult(camera, estimated=False)
        for name, table in solved.cell.session.cameras.items()
        if (frame := frame_name("camera", name)) in solved.cell.tree.branches
        and (camera := table.stated) is not None
    }
    if seen is None or looks is None:
        return found
    for name, scene in looked.scenes.items():
        lens = np.arange(looks.lenses[name].start, looks.lenses[name].stop)
        if not np.isin(lens, seen.free).all():
            found[name] = CameraResult(looks.camera(name), scene.estimated)
            continue
        at = solved.columns_of(lens)
        found[name] = CameraResult(
            looks.camera(name),
            scene.estimated,
            spread[np.ix_(at, at)],
            spread[at, : 6 * edges],
        )
    return found


def _sights(
    looked: Observed, cell: Cell, solved: Solved, held_out: HeldOut, faults: Sequence[PoseFault]
) -> tuple[Sight, ...]:
    """What became of each observation, in the order of the session's rows."""
    rows, used = solved.cell.rows, solved.agreed.used
    away, why = residuals(solved), reasons(solved, faults)
    rms_px = solved.chain_px(np.arange(len(rows)), solved.agreed.fit.state)
    unseen = np.full((len(rows), 3), np.nan)
    unseen[used] = np.stack(
        [1e3 * held_out.away_m, np.rad2deg(held_out.away_rad), held_out.rms_px], axis=1
    )
    found = {}
    for at, row in enumerate(rows):
        mm, deg, px = _known(np.append(away[at], rms_px[at]))
        corners = solved.poses[at].corners
        found[row.view] = Sight(
            row.view,
            solved.cell.stops[row.station],
            row.seer,
            row.seen,
            bool(used[at]),
            why.get(row.view, ""),
            mm,
            deg,
            None if corners is None else len(corners.ids),
            px,
            *_known(unseen[at]),
        )
    found |= held_sights(solved, looked)
    lost = solved.cell.reasons
    for it in cell.session.observations:
        number = it.view.number
        if number not in found and not it.view.is_of_lens:
            stop = cell.stops[it.station] if it.station < len(cell.stops) else number
            found[number] = Sight(number, stop, it.seer, it.seen, False, lost.get(number, ""))
    return tuple(found[it] for it in (view.number for view in cell.session.views) if it in found)


def _known(figures: FloatArray) -> list[float | None]:
    """Figures, None in the place of those that are not known."""
    return [it if np.isfinite(it) else None for it in figures.tolist()]
