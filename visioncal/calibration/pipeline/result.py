"""What is known when all steps have run, put together as a Calibration."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import numpy as np

from visioncal.calibration.pipeline.fit import conditions_document, fit_document
from visioncal.calibration.pipeline.holdout import held_by_both_arms
from visioncal.calibration.pipeline.lens_documents import cameras_of, shape_sections
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.pipeline.whole import alignment_of, arm_documents
from visioncal.calibration.stages.handeye import compare_solvers
from visioncal.calibration.stages.need import need_met
from visioncal.calibration.stages.readings import Readings
from visioncal.estimation.chain import edge_names
from visioncal.results import HELD_BACK, Calibration, SolverResult, Validation, ViewResult
from visioncal.results.whole import holdout_rms, view_results
from visioncal.session import View
from visioncal.session.frames import thing_name

_OF_LENS = "it tells of the camera's lens alone (role = intrinsics)"
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
        stages=_further(known),
        need=need_met(findings.need, findings.picks),
    )


def _edge_names(known: RunState) -> dict[str, str]:
    """The names of the edges by the frames that they place, the camera's first.

    Of points that an instrument read, the first is the probe.
    """
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
    """Why a row tells of no chain."""
    if row.is_of_lens:
        return _OF_LENS
    return known.reasons.get(row.number) or (HELD_BACK if row.holdout else _NO_POSE)


def _further(known: RunState) -> dict[str, Any]:
    """What was refined beside the edges, and where the uncertainty comes from."""
    documents: dict[str, Any] = {}
    for it in known.clocks.values():
        documents["clock"] = it.clock.document()
    if known.readings is not None:
        documents |= _instrument(known, known.readings)
    documents |= shape_sections(known) | _arm(known)
    documents["uncertainty"] = _uncertainty(known)
    conditions, fit = conditions_document(known), fit_document(known)
    if conditions:
        documents["conditions"] = conditions
    if fit is not None:
        documents["joint_fit"] = fit
    return documents


def _arm(known: RunState) -> dict[str, Any]:
    """What was found of the arm."""
    arm = known.robot_arm
    documents = arm_documents(known, arm.robot)
    if "kinematics" in documents and arm.model is not None:
        rows = held_by_both_arms(known.fitted, known, arm.robot)
        if rows:
            documents["kinematics"]["holdout"] = rows
    return documents


def _instrument(known: RunState, readings: Readings) -> dict[str, Any]:
    """The instrument as it was taken, and the places of the points that it read on the flange."""
    instrument = readings.instrument
    stated = {
        "words": instrument.words,
        "reads": "poses" if readings.are_poses else "places",
        "sigma_m": instrument.sigma_m,
        "sigma_per_m": instrument.sigma_per_m,
        "sigma_rad": instrument.sigma_rad if readings.are_poses else None,
    }
    document: dict[str, Any] = {"instrument": {k: v for k, v in stated.items() if v is not None}}
    if not readings.are_poses:
        places = {it: at for it, at in known.solved.edges.items() if it.startswith("point")}
        document["points"] = [
            {
                "point": thing_name(frame, "probe"),
                **dict(zip(("x_m", "y_m", "z_m"), edge.matrix[:3, 3].tolist(), strict=True)),
                "sigma_mm": edge.sigma_mm,
            }
            for frame, edge in places.items()
        ]
    return document


def _uncertainty(known: RunState) -> dict[str, Any]:
    work, answer = known.work, known.solved
    of = "combined" if answer.problem.is_combined else "robot"
    (turn_rad, shift_m) = answer.intervals[0]
    alike = [it.alike.factor for it in answer.misfits.values() if it.alike.is_significant]
    return {
        "point_cam_m": work.point_cam.tolist(),
        "budget_mm": dict(work.budget_mm),
        "radius95_mm": work.radius95_mm,
        "noise_95": {
            f"{of}_translation_mm": (1e3 * shift_m).tolist(),
            f"{of}_rotation_deg": np.rad2deg(turn_rad).tolist(),
        },
        "spectrum": work.spectrum.tolist(),
        "inflation": max(alike, default=1.0),
    }


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
