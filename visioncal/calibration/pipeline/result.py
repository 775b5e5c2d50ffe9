"""What is known when all steps have run, put together as a Calibration."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from visioncal.calibration.pipeline.fit import conditions_of, joint_fit_of
from visioncal.calibration.pipeline.holdout import held_by_both_arms
from visioncal.calibration.pipeline.lens_documents import boards_of, cameras_of, rigs_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.whole import alignment_of, arm_sections, pair_of
from visioncal.calibration.stages.handeye import compare_solvers
from visioncal.calibration.stages.need import need_met
from visioncal.calibration.stages.readings import Readings
from visioncal.estimation.chain import edge_names
from visioncal.results import HELD_BACK, Calibration, SolverResult, Validation, ViewResult
from visioncal.results.arm import ArmSections
from visioncal.results.sections import (
    CalibrationSections,
    InstrumentResult,
    PointResult,
    UncertaintyResult,
)
from visioncal.results.whole import holdout_rms, view_results
from visioncal.session import View
from visioncal.session.frames import thing_name

_OF_LENS = "it serves the camera's lens alone (role = intrinsics)"
_NO_POSE = (
    "no pose of the target: it has neither image nor rows in corners.csv nor cft_ nor meas_ columns"
)


def result_of(known: RunState) -> Calibration:
    """Puts together what is known when all steps have run.

    Raises:
        RuntimeError: One has not.
    """
    findings, verdict = known.findings, known.verdict
    if known.mount is None:
        return Calibration.whole(alignment_of(known))
    if findings is None or verdict is None:
        raise RuntimeError("a step is missing")
    session, answer, names = known.session, known.solved, _edge_names(known)
    edges = [answer.edges[frame] for frame in names]
    size = 6 * len(names)
    return Calibration(
        session_name=session.name,
        session_sha256=session.digest(),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        mount=known.mount,
        edges=dict(zip(names.values(), edges, strict=True)),
        joint_covariance=answer.covariance[:size, :size],
        solvers=_solvers(known, names),
        noise=_noise(known),
        views=_views(known),
        rms=findings.rms,
        validation=Validation(
            answer.held_out.method, findings.held_out, holdout_rms(answer.sights)
        ),
        verdict=verdict,
        camera=next(iter(cameras_of(known).values()), None),
        robot=known.robot,
        need=need_met(findings.need, findings.picks),
        **vars(_sections(known)),
    )


def _edge_names(known: RunState) -> dict[str, str]:
    """The names of the edges by the frames that they place, the camera's first."""
    # Of points that an instrument read, the first is the probe.
    frames, first = known.solved.problem.unknown, edge_names(known.session.mount)
    parents = [it.partition("_from_")[0] for it in first]
    names = {it: f"{parents[min(at, 1)]}_from_{it}" for at, it in enumerate(frames)}
    if known.mount == "instrument":
        names = dict(zip(frames, first, strict=False))
    return names


def _solvers(known: RunState, names: Mapping[str, str]) -> dict[str, SolverResult]:
    answer, mount = known.solved, known.session.mount
    found = compare_solvers(answer.problem, answer.state, mount, known.solver)
    return {
        name: SolverResult(
            dict(zip(names.values(), it.edges, strict=False)),
            1e3 * it.rms_m,
            None if it.rms_rad is None else float(np.rad2deg(it.rms_rad)),
        )
        for name, it in found.items()
    }


def _views(known: RunState) -> tuple[ViewResult, ...]:
    """What became of each view of the session, in its order."""
    seen = {it.view: it for it in view_results(known.solved.sights)}
    return tuple(
        seen.get(it.number) or ViewResult(it.number, used=False, reason=_reason(known, it))
        for it in known.session.views
    )


def _reason(known: RunState, row: View) -> str:
    """Why a row is of no chain."""
    if row.is_of_lens:
        return _OF_LENS
    return known.reasons.get(row.number) or (HELD_BACK if row.holdout else _NO_POSE)


def _sections(known: RunState) -> CalibrationSections:
    """What was refined beside the edges, and where the uncertainty comes from."""
    boards, rigs = boards_of(known), rigs_of(known)
    # Of one target without a name there is one section.
    alone = not known.session.targets
    return CalibrationSections(
        **vars(_arm(known)),
        clock=next((it.clock.result() for it in known.clocks.values()), None),
        instrument=None if known.readings is None else _instrument(known.readings),
        points=tuple(_points(known)),
        board=next(iter(boards.values()), None) if alone else None,
        boards={} if alone else boards,
        rig=next(iter(rigs.values()), None) if alone else None,
        rigs={} if alone else rigs,
        uncertainty=_uncertainty(known),
        conditions=conditions_of(known),
        joint_fit=joint_fit_of(known),
    )


def _arm(known: RunState) -> ArmSections:
    """What was found of the arm."""
    arm = known.robot_arm
    sections = arm_sections(known, arm.robot)
    if sections.arm is None or arm.model is None:
        return sections
    held = held_by_both_arms(known.fitted, known, arm.robot)
    return replace(sections, arm=replace(sections.arm, holdout=held))


def _instrument(readings: Readings) -> InstrumentResult:
    """The instrument as it was taken."""
    instrument = readings.instrument
    return InstrumentResult(
        words=instrument.words,
        reads="poses" if readings.are_poses else "places",
        sigma_m=instrument.sigma_m,
        sigma_per_m=instrument.sigma_per_m,
        sigma_rad=instrument.sigma_rad if readings.are_poses else None,
    )


def _points(known: RunState) -> Iterator[PointResult]:
    """The places of the points that an instrument read on the flange."""
    if known.readings is not None and not known.readings.are_poses:
        for frame, edge in known.solved.edges.items():
            if frame.startswith("point"):
                x_m, y_m, z_m = edge.matrix[:3, 3].tolist()
                name = thing_name(frame, "probe")
                yield PointResult(point=name, x_m=x_m, y_m=y_m, z_m=z_m, sigma_mm=edge.sigma_mm)


def _uncertainty(known: RunState) -> UncertaintyResult:
    work, answer = known.work, known.solved
    of = "combined" if answer.problem.is_combined else "robot"
    (turn_rad, shift_m) = answer.intervals[0]
    tests = (it.alike for it in answer.misfits.values())
    alike = [it.factor for it in tests if it is not None and it.is_significant]
    return UncertaintyResult(
        point_cam_m=work.point_cam,
        budget_mm=work.budget_mm,
        radius95_mm=work.radius95_mm,
        noise_95={
            f"{of}_translation_mm": pair_of(1e3 * shift_m),
            f"{of}_rotation_deg": pair_of(np.rad2deg(turn_rad)),
        },
        spectrum=work.spectrum,
        inflation=max(alike, default=1.0),
    )


def _noise(known: RunState) -> dict[str, float]:
    """Standard deviations per axis: of corners and flange, or of both as one without corners."""
    sigma_rad, sigma_m = known.solved.noise.robots[0].tolist()
    of = "combined" if known.solved.problem.is_combined else "robot"
    found = {
        name: it
        for of_frame in known.solved.sigmas.values()
        for name, it in of_frame.items()
        if name == "pixel_px"
    }
    if not found and known.pixel_px is not None:
        found["pixel_px"] = known.pixel_px
    if known.readings is not None:
        found["instrument_mm"] = 1e3 * known.readings.sigma_m
        if known.readings.are_poses:
            found["instrument_deg"] = float(np.rad2deg(known.readings.instrument.sigma_rad or 0.0))
    return found | {
        f"{of}_translation_mm": 1e3 * sigma_m,
        f"{of}_rotation_deg": float(np.rad2deg(sigma_rad)),
    }
