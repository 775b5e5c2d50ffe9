"""Sixty cells whose answers are kept, so that a change of the estimator shows what it changes.

What is compared: which views are used, what moved, which causes and refusals are named (exactly),
and every edge and noise level (in units of their sigmas). `tests/benchmarks/answers.py --write`
renews the kept answers, and also prints where today's differ from them.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from support.cells import calibrated

from visioncal.calibration.pipeline import calibrate
from visioncal.calibration.pipeline.result import result_of
from visioncal.core.codec import write
from visioncal.core.errors import VisioncalError
from visioncal.core.transforms import invert, log
from visioncal.results.sections import CalibrationSections
from visioncal.session import Session
from visioncal.simulation import (
    BOARDS,
    CellOptions,
    Second,
    SweepOptions,
    cell_session,
    fine_camera,
    instrument_session,
    simulate,
    sweep,
)
from visioncal.simulation.elasticity import Payload
from visioncal.simulation.layout import (
    CameraAt,
    InstrumentAt,
    Moved,
    NetworkOptions,
    PointAt,
    RobotAt,
)

KEPT = Path(__file__).parents[1] / "data" / "answers.json"

IN_HAND, TO_HAND = "eye-in-hand", "eye-to-hand"
_PLAIN = CellOptions()
_FINE = replace(_PLAIN, camera=fine_camera(), pixel_sigma_px=0.1)
_OPEN = replace(_PLAIN, state_intrinsics=False, pixel_sigma_px=0.1)
_HAND = replace(_FINE, mount=TO_HAND)
_COARSE = replace(_FINE, robot_sigma_m=3e-4, robot_sigma_rad=5e-4)
_WRONG_ARM = replace(_FINE, views=40, dh_sigma_m=3e-4, dh_sigma_rad=3e-4, branches=True)
_SPRINGS = (1e-4, 1e-4, 8e-5, 2e-5, 2e-5, 1e-5)
_LOADS = (Payload(0.0, (0.0, 0.0, 0.0)), Payload(8.0, (0.0, 0.0, 0.08)))
_SHELF = Second(target=replace(BOARDS["checkerboard"], columns=8, rows=5))


@dataclass(frozen=True)
class Answer:
    """What is kept of one cell.

    Attributes:
        words: Facts that have to stay exactly as they are.
        edges: Each edge as (4, 4) and its (6, 6) covariance.
        sigmas: Standard deviations of the noise, by name.
    """

    words: Mapping[str, Any]
    edges: Mapping[str, tuple[np.ndarray, np.ndarray]]
    sigmas: Mapping[str, float]

    def document(self) -> dict[str, Any]:
        """The answer as JSON has it."""
        return {
            "words": dict(self.words),
            "edges": {
                name: {"matrix": edge[:3].round(12).tolist(), "sigma": _sigma(covariance)}
                for name, (edge, covariance) in self.edges.items()
            },
            "sigmas": {name: float(f"{sigma:.6g}") for name, sigma in self.sigmas.items()},
        }


def _sigma(covariance: np.ndarray) -> list[float]:
    return [float(f"{value:.6g}") for value in np.sqrt(np.diag(covariance))]


def _flat(noise: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    found: dict[str, float] = {}
    for name, value in noise.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{name} ")
        elif isinstance(value, int | float):
            found[f"{prefix}{name}"] = float(value)
    return found


def _of_calibration(result) -> Answer:
    words = {
        "unused": [view.view for view in result.views if not view.used],
        "status": result.verdict.status,
        "findings": sorted(finding.kind for finding in result.verdict.findings),
        "level": "" if result.arm is None else result.arm.level,
        "stages": sorted(write(CalibrationSections, result)),
    }
    edges = {name: (edge.matrix, edge.covariance) for name, edge in result.edges.items()}
    return Answer(words, edges, _flat(result.noise))


def _of_cell(result) -> Answer:
    words = {
        "unused": [view.view for view in result.views if not view.used],
        "moved": [
            f"{value.frame} {value.last_stop} {value.first_stop}" for value in result.cell.moved
        ],
        "untied": sorted(value.frame for value in result.cell.untied),
        "status": result.verdict.status,
        "levels": {
            name: "" if robot.arm is None else robot.arm.level
            for name, robot in result.cell.robots.items()
        },
    }
    edges = {name: (edge.matrix, edge.covariance) for name, edge in result.edges.items()}
    return Answer(words, edges, _flat(result.cell.noise))


def answer_of(case: Callable[[], Answer]) -> Answer:
    """Runs a case; a refusal is an answer, too."""
    try:
        return case()
    except VisioncalError as error:
        words = {"refused": type(error).__name__, "first": error.message.split(":")[0]}
        return Answer(words, {}, {})


def answer_of_session(path: Path) -> Answer:
    """Calibrates or, where it is a whole cell, aligns a recorded session."""
    session = Session.load(path)
    if len(session.robots) > 1 or len(session.cameras) > 1:
        return _of_cell(calibrate(session))
    return _of_calibration(calibrate(session))


def _cell(options: CellOptions, **changes) -> Callable[[], Answer]:
    return lambda: _of_calibration(result_of(calibrated(simulate(options), **changes)))


def _tracked(options: instrument_session.InstrumentOptions, **document) -> Callable[[], Answer]:
    def case() -> Answer:
        session = instrument_session.session_of(instrument_session.tracked(options), **document)
        return _of_calibration(calibrate(session))

    return case


def _swept(options: CellOptions, how: SweepOptions) -> Callable[[], Answer]:
    return lambda: _of_calibration(
        calibrate(cell_session(sweep(options, how), "sweep", seen="poses"))
    )


def _network(level: str = "auto", **options) -> Callable[[], Answer]:
    def case() -> Answer:
        cell = simulate(NetworkOptions(**options))
        session: Session = cell_session(cell, "network", seen="names")
        corners = {view_corners.view: view_corners for view_corners in cell.corners}
        return _of_cell(calibrate(session, level=level, corners=corners))

    return case


def cases() -> dict[str, Callable[[], Answer]]:
    """The cells, by name."""
    found: dict[str, Callable[[], Answer]] = {}

    def add(name: str, options: CellOptions, *seeds: int, **changes) -> None:
        for seed in seeds or (0,):
            found[f"{name}, {seed}"] = _cell(replace(options, seed=seed), **changes)

    alone = {"joints": False}
    add("in hand, lens given", _FINE, 1, 2, **alone)
    add("in hand, lens estimated", _OPEN, 1, 2, **alone)
    add("to hand, lens given", _HAND, 1, 2, **alone)
    add("to hand, lens estimated", replace(_OPEN, mount=TO_HAND), 1, 2, **alone)
    add("coarse robot", _COARSE, 1, **alone)
    add("small tilts", replace(_FINE, tilt_rad=(0.0, 0.17)), 1, **alone)
    add("6 views", replace(_FINE, views=6), 1, **alone)
    add("2 views", replace(_FINE, views=2), 1, **alone)
    add("4 views, lens estimated", replace(_OPEN, views=4), 1, **alone)
    add("one axis", replace(_FINE, motion="one_axis"), 1, **alone)
    add("translation", replace(_HAND, motion="translation"), 1, **alone)
    add("closed form", _FINE, 1, solver="park", **alone)
    for count in (2, 4, 6):
        add(f"{count} wrong", replace(_FINE, wrong_views=count), 1, **alone)
        add(f"{count} wrong to hand", replace(_OPEN, mount=TO_HAND, wrong_views=count), 1, **alone)
    add("lens 1 px off", replace(_FINE, lens_mismatch_px=1.0), 1, **alone)
    add("lens 1 px off to hand", replace(_HAND, lens_mismatch_px=1.0), 1, **alone)
    add("bow", replace(_FINE, board_bow_m=5e-4), 1, **alone)
    add("size", replace(_FINE, board_scale=1.005), 1, **alone)
    add("two boards", replace(_FINE, views=24, second=_SHELF), 1, **alone)
    add("two boards to hand", replace(_HAND, views=24, second=_SHELF), 1, **alone)
    add("two boards, 3 wrong", replace(_FINE, views=24, second=_SHELF, wrong_views=3), 1, **alone)
    add("wrong arm, poses", _WRONG_ARM, 1, **alone)
    add("wrong arm, poses to hand", replace(_WRONG_ARM, mount=TO_HAND), 1, **alone)
    add("sound arm", replace(_FINE, views=40, branches=True), 1)
    add("wrong arm", _WRONG_ARM, 1, 2)
    add("wrong arm to hand", replace(_WRONG_ARM, mount=TO_HAND), 1)
    add("wrong arm, 3 wrong", replace(_WRONG_ARM, wrong_views=3), 1)
    add("offsets", replace(_FINE, views=30, offset_sigma_rad=1e-3, branches=True), 1)
    add("eccentricity", replace(_WRONG_ARM, views=60, eccentricity_sigma_rad=5e-4), 1)
    sagging = replace(_WRONG_ARM, views=60, compliance_rad_per_nm=_SPRINGS)
    add("springs", sagging, 1)
    add("springs, loads", replace(sagging, payloads=_LOADS), 1)
    add(
        "backlash",
        replace(_FINE, views=50, branches=True, backlash_rad=(0.0, 1e-3, *(0.0,) * 4)),
        1,
    )
    add("wrong arm, two boards", replace(_WRONG_ARM, second=_SHELF), 1)

    shop = instrument_session.InstrumentOptions(points=instrument_session.THREE)
    found["tracker, places"] = _tracked(shop)
    found["tracker, places, wrong arm"] = _tracked(
        replace(shop, dh_sigma_m=3e-4, dh_sigma_rad=3e-4, offset_sigma_rad=3e-4, stops=50)
    )
    found["tracker, poses"] = _tracked(replace(shop, points=shop.points[:1], poses=True))
    found["tracker, one place, poses alone"] = _tracked(
        replace(shop, points=shop.points[:1]), joints=False, poses=True
    )
    found["sweep"] = _swept(_FINE, SweepOptions())
    found["sweep to hand"] = _swept(replace(_HAND, seed=2), SweepOptions())

    half = {"stops": 24}
    found["cell"] = _network(**half, seed=1)
    found["cell, half seen"] = _network(**half, share_seen=0.6, seed=2)
    found["cell, board moved"] = _network(**half, moved=(Moved("target_floor", 12),), seed=3)
    found["cell, camera bumped"] = _network(**half, moved=(Moved("cam_left", 9),), seed=4)
    found["cell, both"] = _network(
        **half, moved=(Moved("target_plate_a", 8), Moved("cam_right", 16)), seed=5
    )
    found["cell, wrong rows"] = _network(**half, swapped_rows=1, stray_images=4, seed=6)
    open_left = (CameraAt("left", state_intrinsics=False), CameraAt("hand", "b"))
    found["cell, lens estimated, one in hand"] = _network(**half, cameras=open_left, seed=7)
    arms = (
        RobotAt("a", (-0.6, 0.0, 0.0), offset_sigma_rad=1e-3),
        RobotAt("b", (0.6, 0.05, 0.02), dh_sigma_m=3e-4, dh_sigma_rad=3e-4),
    )
    found["cell, wrong arms"] = _network(**half, robots=arms, seed=8)
    found["cell, wrong arms as reported"] = _network("hand-eye", **half, robots=arms, seed=8)
    found["cell, offsets"] = _network("offsets", **half, robots=arms, seed=8)
    found["cell, kinematics"] = _network("kinematics", **half, robots=arms, seed=8)
    points = (PointAt("ball_a", "a", (0.0, 0.05, 0.1)), PointAt("nest", "cell", (0.4, 0.4, 0.2)))
    trackers = (InstrumentAt("tracker", (1.8, -1.5, 0.5), 2.0),)
    found["cell, tracker"] = _network(**half, instruments=trackers, points=points, seed=9)
    return found


def kept() -> dict[str, Any]:
    """The answers that are kept, by name."""
    return json.loads(KEPT.read_text(encoding="utf-8"))


def away_in_sigmas(answer: Answer, before: Mapping[str, Any]) -> float:
    """By how many of the kept sigmas the farthest component of any edge differs from the kept."""
    worst = 0.0
    for name, (matrix, _) in answer.edges.items():
        then = before["edges"][name]
        base = np.vstack([then["matrix"], [0.0, 0.0, 0.0, 1.0]])
        sigma = np.array(then["sigma"])
        moved = np.abs(log(invert(base) @ matrix))
        asked = sigma > 0.0
        worst = max(worst, float((moved[asked] / sigma[asked]).max(initial=0.0)))
    return worst


def sigmas_apart(answer: Answer, before: Mapping[str, Any]) -> float:
    """By which share the sigma of an edge's component differs the most."""
    worst = 0.0
    for name, (_, covariance) in answer.edges.items():
        then = np.array(before["edges"][name]["sigma"])
        asked = then > 0.0
        now = np.sqrt(np.diag(covariance))[asked]
        worst = max(worst, float(np.abs(now / then[asked] - 1.0).max(initial=0.0)))
    return worst


def levels_apart(answer: Answer, before: Mapping[str, Any]) -> float:
    """By which share a noise level differs the most."""
    pairs = [(sigma, before["sigmas"][name]) for name, sigma in answer.sigmas.items()]
    return max((abs(now / then - 1.0) for now, then in pairs if then > 0.0), default=0.0)
