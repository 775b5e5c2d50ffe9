"""Texts of the report, made from a calibration for the templates."""

from collections.abc import Collection, Iterator, Sequence

import numpy as np

from visioncal.core.number_format import (
    decimals_for,
    fixed,
    matched,
    percent,
    rounded_up,
    significant,
)
from visioncal.core.types import FloatArray
from visioncal.present import result_parts
from visioncal.present.facts import DEGREE, PLUS_MINUS, answering_solver, frame_words, of
from visioncal.present.tables import Fact, Table, TableRow
from visioncal.results import Calibration, CameraResult, Edge, NeedMet, Verdict
from visioncal.results.compare import intrinsics_names
from visioncal.results.evidence import ViewEvidence
from visioncal.results.sections import ClockResult
from visioncal.session import Session
from visioncal.vision.camera import intrinsics

_MOUNTS = {
    "eye-in-hand": "the camera rides on the robot",
    "eye-to-hand": "the camera stands still and the robot carries the target",
    "instrument": "a measuring instrument stands still and reads what the robot carries",
}


def edge_facts(calibration: Calibration, name: str, edge: Edge) -> list[Fact]:
    """Components of a transform with standard deviations, where these are known, and units."""
    controller = calibration.controller(*name.split("_from_"))
    has_accuracy = calibration.verdict.has_accuracy
    # The perturbation is in the child's frame; the components are along the parent's axes.
    parent_from_child = edge.matrix[:3, :3]
    covariance_m2 = parent_from_child @ edge.covariance[3:, 3:] @ parent_from_child.T
    sigmas_mm = 1e3 * np.sqrt(np.clip(np.diag(covariance_m2), 0.0, None))
    translation_mm = 1e3 * edge.transform.translation
    rows = [
        Fact(
            axis,
            matched(value, sigma),
            f"{PLUS_MINUS} {significant(sigma)} mm" if has_accuracy else "mm",
        )
        for axis, value, sigma in zip("xyz", translation_mm, sigmas_mm, strict=True)
    ]
    if edge.oriented:
        axis_deg, rotation = edge.sigma_deg / np.sqrt(3.0), edge.transform.rotation
        decimals = decimals_for(0.5 * np.deg2rad(axis_deg))
        vector = ", ".join(matched(value, axis_deg) for value in rotation.as_rotvec(degrees=True))
        quaternion = ", ".join(fixed(value, decimals) for value in rotation.as_quat())
        rows.append(Fact("rotation vector", f"[{vector}]", "deg"))
        rows.append(Fact("quaternion x, y, z, w", f"[{quaternion}]"))
        _, *of_maker = edge.rotations(controller)
        rows += [Fact(form, f"[{numbers}]", unit) for form, numbers, unit in of_maker]
    else:
        parent = frame_words(name.partition("_from_")[0])
        rows.append(Fact("rotation", "not measured", f"taken as that of {parent}"))
    rotation_sigma = f", {significant(edge.sigma_deg)} deg" if edge.oriented else ""
    sigma = Fact("sigma", f"{significant(edge.sigma_mm)} mm{rotation_sigma}")
    return [*rows, sigma if has_accuracy else Fact("sigma", "unknown")]


def key_figures(calibration: Calibration) -> tuple[Fact, ...]:
    """The three figures that most readers look for, where they are known."""
    facts, validation = [*need_facts(calibration.need, calibration.verdict)], calibration.validation
    if validation.is_of_unseen:
        rotation_deg = validation.held_out.deg
        note = "" if rotation_deg is None else f"{significant(rotation_deg)}{DEGREE}"
        size = f"{significant(validation.held_out.mm)} mm"
        facts.append(Fact("views not used in the fit agree to", size, note))
    return (*facts, views_used(calibration))


def views_used(calibration: Calibration) -> Fact:
    """Number of views in the fit."""
    used = sum(view.used for view in calibration.views)
    return Fact("views used", f"{used} of {len(calibration.views)}")


def stops_m(calibration: Calibration, evidence: Sequence[ViewEvidence]) -> FloatArray:
    """(m, 3) flange positions of the used views [m]."""
    used = {view.view for view in calibration.views if view.used}
    poses = [view.base_from_flange for view in evidence if view.view in used]
    return np.reshape([pose[:3, 3] for pose in poses if pose is not None], (-1, 3))


def need_facts(need: NeedMet | None, verdict: Verdict) -> Iterator[Fact]:
    """Probability that the task's need is met, or else the tolerance that the result suits."""
    good, sent = "", ""
    if not verdict.has_accuracy:
        return
    if verdict.good_for_mm is not None:
        good, sent = f"{significant(rounded_up(verdict.good_for_mm))} mm", "and more"
        if verdict.good_for_mm_uncorrected is not None:
            of = significant(rounded_up(verdict.good_for_mm_uncorrected))
            sent += f", with corrected targets; by the controller's own poses {of} mm"
    if need is not None:
        tolerances = ((need.need.mm, " mm"), (need.need.deg, DEGREE))
        words = " and ".join(f"{value:g}{unit}" for value, unit in tolerances if value is not None)
        note = f"good for tasks of {good} {sent}" if good else ""
        yield Fact(f"picks within {words}", percent(need.probability), note)
    elif good:
        yield Fact("good for tasks of", good, sent)


def method_facts(calibration: Calibration, session: Session | None = None) -> tuple[Fact, ...]:
    """Method: views, solver, models, boards of the session, and clocks."""
    facts = [views_used(calibration)]
    if calibration.cell is None:
        facts.insert(0, Fact("mount", calibration.mount, _MOUNTS[calibration.mount]))
    solver = answering_solver(calibration)
    if solver is not None:
        note = (
            "fit of both transforms, weighted by the noise"
            if solver == "joint"
            else "a closed form"
        )
        facts.append(Fact("solver", solver, note))
    for name, robot in result_parts.robots(calibration).items():
        model = str(robot.document.get("name", "given"))
        facts.append(Fact(f"robot model{of(name)}", model))
    for name, camera in result_parts.cameras(calibration).items():
        width, height = camera.camera.resolution
        size = f"{camera.camera.model}, {width} \N{MULTIPLICATION SIGN} {height} px"
        called = session.camera_name if session is not None and not name else ""
        facts.append(Fact(name or "camera", size, called))
    for name, board in ({} if session is None else session.boards).items():
        squares = f"{board.columns} x {board.rows}, {1e3 * board.square_m:g} mm"
        facts.append(Fact(f"board{of(name)}", board.name, squares if board.columns else ""))
    if calibration.instrument is not None:
        read = f"it read {calibration.instrument.reads}"
        facts.append(Fact("instrument", calibration.instrument.words, read))
        for point in calibration.points:
            xyz_mm = (1e3 * value for value in (point.x_m, point.y_m, point.z_m))
            place = ", ".join(matched(value, point.sigma_mm / np.sqrt(3.0)) for value in xyz_mm)
            note = f"{PLUS_MINUS} {significant(point.sigma_mm)}, on the flange"
            facts.append(Fact(f"point {point.point}", f"[{place}] mm", note))
    for name, clock in calibration.by_name.details.clocks.items():
        facts += _clock_facts(clock, f"clock{of(name)}" if name else "camera's clock")
    return tuple(facts)


def _clock_facts(clock: ClockResult, label: str) -> Iterator[Fact]:
    """Offset of a camera's clock from its robot's, and the shutter's readout time."""
    ahead_ms = 1e3 * clock.camera_minus_robot_s
    if clock.sigma_s is None:
        yield Fact(label, f"{ahead_ms:+.4g} ms", "taken so: views at rest")
    else:
        sigma_ms = 1e3 * clock.sigma_s
        note = f"{PLUS_MINUS} {significant(sigma_ms)}, ahead of the robot's, by {clock.method}"
        yield Fact(label, f"{matched(ahead_ms, sigma_ms)} ms", note)
    shutter = clock.shutter
    if shutter is not None:
        sigma_ms = 1e3 * shutter.readout_sigma_s
        readout = f"{matched(1e3 * shutter.readout_s, sigma_ms)} ms"
        note = f"{PLUS_MINUS} {significant(sigma_ms)}, from an image's first row to its last"
        yield Fact(f"{shutter.kind} shutter", readout, note)


def lens_facts(result: CameraResult) -> tuple[Fact, ...]:
    """Intrinsics, with standard deviations where estimated."""
    values, count = intrinsics(result.camera), len(result.camera.matrix)
    sigmas = np.zeros(len(values))
    if result.covariance is not None and len(result.covariance) == len(values):
        sigmas = np.sqrt(np.clip(np.diag(result.covariance), 0.0, None))
    facts = []
    for index, (name, value, sigma) in enumerate(
        zip(intrinsics_names(result.camera), values, sigmas, strict=True)
    ):
        unit, stated = ("px", f"{value:.2f}") if index < count else ("", f"{value:.5g}")
        tolerance = f"{PLUS_MINUS} {matched(sigma, sigma)} {unit}".strip()
        cells = (matched(value, sigma), tolerance) if sigma else (stated, unit)
        facts.append(Fact(name, *cells))
    return tuple(facts)


def view_table(calibration: Calibration, outlying: Collection[int]) -> Table:
    """Status and residuals of each view; the recording's notes link to the rows."""
    rows, words = [], {"used": "yes", "look": "look", "left-out": "left out", "rejected": "no"}
    for view in calibration.views:
        figures = (view.rms_px, view.residual_mm, view.residual_deg)
        corners = significant(None) if view.corners is None else str(view.corners)
        mark = "left-out" if view.contradicts else "rejected"
        mark = ("look" if view.view in outlying else "used") if view.used else mark
        names = (str(view.view), view.seer, view.seen)
        cells = (*names, corners, *map(significant, figures), words[mark])
        rows.append(TableRow(cells, mark, f"view-{view.view}"))
    return Table.of(("view", "who", "saw", "corners", "px", "mm", "deg", "used"), rows, (1, 2, 7))
