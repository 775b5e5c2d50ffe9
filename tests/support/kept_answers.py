"""Cells and recordings whose answers are kept, so that a change of the estimator shows.

What is compared is what the contracts of calibration.json give: the verdict, the likeliest cause,
every edge in units of its sigma, sizes of noise, and messages by their kinds and figures.

    PYTHONPATH=tests python -m support.kept_answers [NAME ...]    keeps today's answers
"""

import json
import re
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform
from support.fuzz.broken_sessions import BROKEN, broken_session

import visioncal
from visioncal.session import Session
from visioncal.simulation import (
    BOARDS,
    CAMERAS,
    CellOptions,
    Second,
    SweepOptions,
    cell_session,
    instrument_session,
    simulate,
    sweep,
)
from visioncal.simulation.arms import Payload
from visioncal.simulation.layout import (
    CameraAt,
    InstrumentAt,
    Moved,
    NetworkOptions,
    PointAt,
    RobotAt,
)

DATA = Path(__file__).parents[1] / "data"
REAL = Path(__file__).parents[3] / "shared" / "data" / "sessions"

TO_HAND = "eye-to-hand"
_PLAIN = CellOptions()
_FINE = replace(_PLAIN, camera=CAMERAS["fine"], pixel_sigma_px=0.1)
_OPEN = replace(_PLAIN, state_intrinsics=False, pixel_sigma_px=0.1)
_HAND = replace(_FINE, mount=TO_HAND)
_COARSE = replace(_FINE, robot_sigma_m=3e-4, robot_sigma_rad=5e-4)
_WRONG_ARM = replace(_FINE, views=40, dh_sigma_m=3e-4, dh_sigma_rad=3e-4, branches=True)
_SPRINGS = (1e-4, 1e-4, 8e-5, 2e-5, 2e-5, 1e-5)
_LOADS = (Payload(0.0, (0.0, 0.0, 0.0)), Payload(8.0, (0.0, 0.0, 0.08)))
_SHELF = Second(target=replace(BOARDS["checkerboard"], columns=8, rows=5))


Message = tuple[str, list[float]]
_FIGURE = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?![\w.]*\w)")


@dataclass(frozen=True)
class Answer:
    """What is kept of one cell."""

    status: str  # The verdict, or "refused".
    # Kind and figures of the likeliest cause, or class and figures of a refusal; none of a result
    # without causes.
    message: Message | None
    # Of each edge the upper rows (3, 4) of its matrix, and its sigmas (6,).
    edges: Mapping[str, Mapping[str, list[Any]]]
    sizes: Mapping[str, float]  # Standard deviations of noise, by name.


def message(kind: str, words: str) -> Message:
    """A message by its kind and the figures in it."""
    return kind, [float(figure) for figure in _FIGURE.findall(words)]


def answer_of(session: Session | Path, **options: Any) -> Answer:
    """Calibrates; a refusal is an answer, too."""
    try:
        result = visioncal.calibrate(session, **options)
    except visioncal.VisioncalError as error:
        return Answer("refused", message(type(error).__name__, error.message), {}, {})
    with tempfile.TemporaryDirectory() as folder:
        result.save(Path(folder) / "calibration.json")
        document = json.loads((Path(folder) / "calibration.json").read_text("utf-8"))
    causes = document["verdict"].get("causes", ())
    edges = {
        name: {"matrix": np.array(edge["matrix"])[:3].round(12).tolist(),
               "sigma": [float(f"{value:.6g}") for value in np.sqrt(np.diag(edge["covariance"]))]}
        for name, edge in document["transforms"].items()
    }  # fmt: skip
    first = message(causes[0]["cause"], causes[0]["sentence"]) if causes else None
    return Answer(document["verdict"]["status"], first, edges, dict(_flat(document["noise"])))


def _flat(noise: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    for name, value in noise.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name} ")
        elif isinstance(value, int | float):
            yield f"{prefix}{name}", float(f"{value:.6g}")


def _cell(
    options: CellOptions, *, joints: bool = True, solver: str = "joint"
) -> Callable[[], Answer]:
    def case() -> Answer:
        session = cell_session(simulate(options), "cell", seen="corners")
        return answer_of(session if joints else without_joints(session), solver=solver)

    return case


def without_joints(session: Session) -> Session:
    """The session of a robot of which poses are all that is said."""
    document = {name: value for name, value in session.document.items() if name != "robot"}
    columns = [name for name in session.columns if not re.fullmatch(r"q\d+_rad", name)]
    rows = [[view.cell(column) for column in columns] for view in session.views]
    return Session.assemble(
        document, columns, rows, session.images, target_document=session.target_document,
        corners=session.corner_table,
    )  # fmt: skip


def _tracked(options: instrument_session.InstrumentOptions, **document) -> Callable[[], Answer]:
    return lambda: answer_of(
        instrument_session.session_of(instrument_session.tracked(options), **document)
    )


def _swept(options: CellOptions, how: SweepOptions) -> Callable[[], Answer]:
    return lambda: answer_of(cell_session(sweep(options, how), "sweep", seen="poses"))


def _network(level: str = "auto", **options) -> Callable[[], Answer]:
    return lambda: answer_of(
        cell_session(simulate(NetworkOptions(**options)), "network", seen="corners"), level=level
    )


def cases() -> dict[str, Callable[[], Answer]]:
    """The cells, by name."""
    found: dict[str, Callable[[], Answer]] = {}

    def add(name: str, options: CellOptions, *seeds: int, **changes) -> None:
        for seed in seeds or (0,):
            found[f"{name}, {seed}"] = _cell(replace(options, seed=seed), **changes)

    poses_only = {"joints": False}
    add("in hand, lens given", _FINE, 1, 2, **poses_only)
    add("in hand, lens estimated", _OPEN, 1, 2, **poses_only)
    add("to hand, lens given", _HAND, 1, 2, **poses_only)
    add("to hand, lens estimated", replace(_OPEN, mount=TO_HAND), 1, 2, **poses_only)
    add("coarse robot", _COARSE, 1, **poses_only)
    add("small tilts", replace(_FINE, tilt_rad=(0.0, 0.17)), 1, **poses_only)
    add("6 views", replace(_FINE, views=6), 1, **poses_only)
    add("2 views", replace(_FINE, views=2), 1, **poses_only)
    add("4 views, lens estimated", replace(_OPEN, views=4), 1, **poses_only)
    add("one axis", replace(_FINE, motion="one_axis"), 1, **poses_only)
    add("translation", replace(_HAND, motion="translation"), 1, **poses_only)
    add("closed form", _FINE, 1, solver="park", **poses_only)
    for count in (2, 4, 6):
        add(f"{count} wrong", replace(_FINE, wrong_views=count), 1, **poses_only)
        add(
            f"{count} wrong to hand",
            replace(_OPEN, mount=TO_HAND, wrong_views=count),
            1,
            **poses_only,
        )
    add("lens 1 px off", replace(_FINE, lens_mismatch_px=1.0), 1, **poses_only)
    add("lens 1 px off to hand", replace(_HAND, lens_mismatch_px=1.0), 1, **poses_only)
    add("bow", replace(_FINE, board_bow_m=5e-4), 1, **poses_only)
    add("size", replace(_FINE, board_scale=1.005), 1, **poses_only)
    add("two boards", replace(_FINE, views=24, second=_SHELF), 1, **poses_only)
    add("two boards to hand", replace(_HAND, views=24, second=_SHELF), 1, **poses_only)
    add(
        "two boards, 3 wrong",
        replace(_FINE, views=24, second=_SHELF, wrong_views=3),
        1,
        **poses_only,
    )
    add("wrong arm, poses", _WRONG_ARM, 1, **poses_only)
    add("wrong arm, poses to hand", replace(_WRONG_ARM, mount=TO_HAND), 1, **poses_only)
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
    recorded = sorted(REAL.glob("*/views.csv"))
    return found | {
        f"real, {path.parent.name}": partial(answer_of, path.parent) for path in recorded
    }


def kept(name: str = "answers") -> dict[str, Any]:
    """The answers that are kept, by name; or the messages."""
    return json.loads((DATA / f"{name}.json").read_text("utf-8"))


def away_in_sigmas(answer: Answer, before: Mapping[str, Any]) -> float:
    """By how many of the kept sigmas the farthest component of any edge differs from the kept."""
    return max((_away(edge, before["edges"][name]) for name, edge in answer.edges.items()),
               default=0.0)  # fmt: skip


def _away(edge: Mapping[str, Any], then: Mapping[str, Any]) -> float:
    now, base = (RigidTransform.from_matrix(np.vstack([at["matrix"], [0.0, 0.0, 0.0, 1.0]]))
                 for at in (edge, then))  # fmt: skip
    moved, sigma = np.abs((base.inv() * now).as_exp_coords()), np.array(then["sigma"])
    is_uncertain = sigma > 0.0
    return float((moved[is_uncertain] / sigma[is_uncertain]).max(initial=0.0))


def sizes_apart(answer: Answer, before: Mapping[str, Any]) -> float:
    """By which share a noise's size, or the sigma of an edge (mm or deg), differs the most."""
    pairs = [(size, before["sizes"].get(name, 0.0)) for name, size in answer.sizes.items()]
    for name, edge in answer.edges.items():
        now, then = (np.reshape(at["sigma"], (2, 3)) for at in (edge, before["edges"][name]))
        pairs += zip(np.linalg.norm(now, axis=1), np.linalg.norm(then, axis=1), strict=True)
    return float(max((abs(now / then - 1.0) for now, then in pairs if then > 0.0), default=0.0))


def checkup_of(mistake: str) -> list[Message]:
    """What the doctor says of a broken session: each finding, or why it cannot be read."""
    with tempfile.TemporaryDirectory() as folder:
        session = broken_session(Path(folder) / "session", BROKEN[mistake])
        try:
            found = visioncal.doctor(session).findings
        except visioncal.VisioncalError as error:
            return [message(type(error).__name__, error.message.replace(folder, ""))]
    return [message(finding.kind, finding.words.replace(folder, "")) for finding in found]


def keep(names: Iterable[str]) -> None:
    """Writes the answers of some cases, or of all, into the files in tests/data."""
    answers, messages = (kept(name) if (DATA / f"{name}.json").exists() else {}
                         for name in ("answers", "messages"))  # fmt: skip
    every = cases()
    for name in names or [*every, *BROKEN]:
        if name in BROKEN:
            messages[name] = checkup_of(name)
        else:
            answer = every[name]()
            messages[name] = [] if answer.message is None else [answer.message]
            answers[name] = {"status": answer.status, "edges": answer.edges, "sizes": answer.sizes}
        print(name, messages[name], flush=True)
        for file, of in (("answers", answers), ("messages", messages)):
            rows = (f"{json.dumps(key)}: {json.dumps(of[key])}" for key in sorted(of))
            (DATA / f"{file}.json").write_text("{\n" + ",\n".join(rows) + "\n}\n", "utf-8")


if __name__ == "__main__":
    keep(sys.argv[1:])
