"""The worlds of `compare.py`: each writes the session of a seed, and judges what came of it.

What a checkout is asked are commands, `visioncal.locate` and `Calibration.base_from_flange`; what
is read of its answers are the keys of calibration.json that are contracts.
"""

import csv
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import elsewhere
import numpy as np
import tomli_w
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2, norm
from support import kept_answers, later, touched, wrong_arms
from support.commands import visioncal, write_poses, write_table
from support.fuzz import mistakes, varied
from support.paired import Outcome

from visioncal.robot import load_robot
from visioncal.robot.workspace import postures
from visioncal.session.columns import POSE
from visioncal.simulation import (
    BOARDS,
    CAMERAS,
    CellOptions,
    SimulatedCell,
    WarmUpOptions,
    cell_session,
    simulate,
    simulate_warm_up,
)
from visioncal.simulation.heat import heated_poses
from visioncal.simulation.layout import BoardAt, CameraAt, Moved, NetworkOptions, RobotAt, Swept

REAL = Path(__file__).parents[3] / "shared" / "data" / "sessions"
MOUNTS = ("eye-in-hand", "eye-to-hand")
# Postures of the workspace at which an arm is judged, and moments of five hours of warming.
EVERY = 5
# What is as unlikely as three sigma of one number.
UNLIKELY = 2.0 * norm.sf(3.0)

Ask = Callable[..., Mapping[str, Any]]
Judge = Callable[[Mapping[str, Any], Path, Ask], Mapping[str, Any]]


@dataclass(frozen=True)
class Made:
    """A session on disk, and how what a checkout makes of it is judged."""

    session: Path  # What is calibrated.
    judge: Judge = lambda *_: {}  # What is measured of calibration.json, as fields of `Outcome`.
    cause: str = ""  # What the first cause is to look like, of a world that has a fault.

    def run(self, ask: Ask, out: Path) -> Outcome:
        """Has a checkout calibrate, and judges."""
        argv = ["calibrate", str(self.session), "-o", str(out), "--no-report", "--no-recording"]
        reply = ask(do="command", argv=[*argv, "--json"])
        if reply["status"] not in (0, 3):
            return ended(reply, self.cause)
        document = json.loads((out / "calibration.json").read_text("utf-8"))
        causes = [item["cause"] for item in document["verdict"].get("causes", ())]
        cause = (causes or [""])[0]
        right = bool(re.search(self.cause, cause)) if self.cause else None
        measured = self.judge(document, out, ask)
        return Outcome(document["verdict"]["status"], cause, reply["seconds"], is_right=right,
                       **measured)  # fmt: skip


@dataclass(frozen=True)
class Command:
    """As `Made`, of a command that prints its result; calibrates before it where it has to."""

    session: Path
    argv: Callable[[Path], Sequence[object]]
    judge: Callable[[Mapping[str, Any], Path], Mapping[str, Any]]
    calibrates: bool = False

    def run(self, ask: Ask, out: Path) -> Outcome:
        """As `Made.run`."""
        if self.calibrates:
            Made(self.session).run(ask, out)
        reply = ask(do="command", argv=[*map(str, self.argv(out)), "--json"])
        if reply["status"] not in (0, 3):
            return ended(reply, "")
        return Outcome(seconds=reply["seconds"], **self.judge(json.loads(reply["out"]), out))


def ended(reply: Mapping[str, Any], cause: str) -> Outcome:
    """The outcome without a result."""
    status = {2: "refused", -1: "late"}.get(reply["status"], "bug")
    error_class = json.loads(reply["out"])["error"]["class"] if status == "refused" else ""
    right = bool(re.search(cause, error_class)) if cause else None
    return Outcome(status, error_class, reply["seconds"], is_right=right)


def errors(document: Mapping[str, Any], truth: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Errors of all transforms together, over their joint covariance."""
    joint, found = document["joint_covariance"], document["transforms"]
    names = [name for name in joint["order"] if name in truth]
    rows = np.repeat(np.isin(joint["order"], names), 6)
    away = RigidTransform.from_matrix(
        np.array([np.linalg.inv(truth[name]) @ found[name]["matrix"] for name in names])
    ).as_exp_coords()
    covariance = np.array(joint["matrix"])[np.ix_(rows, rows)]
    size = {"mm": 1e3 * rms(away[:, 3:]), "deg": float(np.rad2deg(rms(away[:, :3])))}
    return {"errors": size} | over(away.ravel(), covariance)


def over(away: np.ndarray, covariance: np.ndarray) -> dict[str, Any]:
    """An error over its covariance."""
    square = float(away @ np.linalg.solve(covariance, away))
    return {"nees": square / len(away), "beyond": bool(chi2.sf(square, len(away)) < UNLIKELY)}


def rms(rows: np.ndarray) -> float:
    """Root mean square length."""
    return float(np.sqrt(np.mean(np.sum(np.atleast_2d(rows) ** 2, axis=1))))


def simple(options: CellOptions, cause: str = "", *, workspace: bool = False):
    """A simulated cell of one robot and one camera, as corners; mounts and lenses by turns."""

    def write(seed: int, folder: Path) -> Made:
        changes = {"mount": MOUNTS[seed % 2], "state_intrinsics": seed // 2 % 2 == 0}
        if workspace or options.lens_mismatch_px:
            del changes["state_intrinsics"]
        cell = simulate(replace(options, seed=seed, **changes))
        cell_session(cell, "cell", seen="corners").save(folder / "session")

        def judge(document, out, ask):
            found = errors(document, cell.transforms)
            return found | {"errors": carried(cell, document, out, ask)} if workspace else found

        return Made(folder / "session", judge, cause)

    return write


def carried(cell: SimulatedCell, document, out: Path, ask: Ask) -> dict[str, float]:
    """How far off what the arm carries is, all over the workspace."""
    edges = [np.array(document["transforms"][name]["matrix"]) for name in cell.transforms]
    q = postures(load_robot(cell.options.robot))
    reply = ask(do="arm", calibration=str(out / "calibration.json"), q=q.tolist())
    return {"mm": 1e3 * wrong_arms.away_m(cell, edges, q, np.array(reply["out"]))}


def foreign(name: str):
    """A cell of the independent generator; judged by picks and by the ray of the image's centre."""
    world = elsewhere.WORLDS[name]

    def write(seed: int, folder: Path) -> Made:
        given = seed // 2 % 2 == 0 or world.off_px > 0.0
        case = elsewhere.cell(world, MOUNTS[seed % 2], given, seed, folder / "session")
        looks = elsewhere.looks_of(case, seed)
        ray = elsewhere.centre_ray(case.shift)
        true_ray = case.reported_x[:3, :3] @ Rotation.from_rotvec(ray).apply([0.0, 0.0, 1.0])

        def judge(document, out, ask):
            rows = [{"px": look.px.tolist(), "point": look.point.tolist(),
                     "normal": look.normal.tolist(),
                     "pose": look.reported.tolist() if case.mount == MOUNTS[0] else None}
                    for look in looks]  # fmt: skip
            places = ask(do="located", calibration=str(out / "calibration.json"), looks=rows)["out"]
            away, squares = [], []
            for look, (place, covariance) in zip(looks, places, strict=True):
                axes = np.linalg.svd(look.normal[None])[2][1:]
                away.append(axes @ (np.array(place) - look.point))
                squares.append(over(away[-1], axes @ np.array(covariance) @ axes.T)["nees"])
            x = next(iter(document["transforms"].values()))["matrix"]
            fx, fy, cx, cy = document["camera"]["matrix"]
            matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
            middle = (np.array(elsewhere.SIZE) - 1.0) / 2.0
            distortion = np.array(document["camera"]["distortion"])
            seen = cv2.undistortPoints(middle.reshape(1, 1, 2), matrix, distortion).ravel()
            found_ray = np.array(x)[:3, :3] @ [*seen, 1.0]
            turned = np.linalg.norm(np.cross(found_ray, true_ray)) / np.linalg.norm(found_ray)
            # The picks of one cell share its error: as one number of two degrees of freedom.
            nees = float(np.mean(squares))
            return {"errors": {"mm": 1e3 * rms(np.array(away)), "deg": np.rad2deg(turned)},
                    "nees": nees, "beyond": bool(chi2.sf(2.0 * nees, 2) < UNLIKELY)}  # fmt: skip

        return Made(folder / "session", judge, world.causes)

    return write


def network(cause: str = "", gauge_m: float = 0.0, **options):
    """A cell of two arms, cameras and boards; a gauge may tell the height of the second base."""
    pushed = {move.frame for move in options.get("moved", ())}

    def write(seed: int, folder: Path) -> Made:
        cell = simulate(NetworkOptions(**{"stops": 24, "seed": seed} | options))
        cell_session(cell, "network", seen="corners").save(folder / "session")
        if gauge_m:
            noise_m = gauge_m * float(np.random.default_rng([seed, 77]).standard_normal())
            height_m = cell.between("base_a", "base_b")[2, 3] + noise_m
            with (folder / "session" / "session.toml").open("a") as file:
                prior = {"z_m": float(height_m), "sigma_m": gauge_m}
                file.write("\n" + tomli_w.dumps({"prior": {"base_a_from_base_b": prior}}))

        def judge(document, *_):
            reference, truth = np.linalg.inv(cell.mountings[document["reference"]]), {}
            for name in document["transforms"]:
                # What was pushed has two places, and names of its own in the result.
                frame = name.partition("_from_")[2]
                if frame in cell.mountings and frame not in pushed:
                    is_fixed = cell.parents[frame] == "cell"
                    truth[name] = (reference if is_fixed else np.eye(4)) @ cell.mountings[frame]
            return errors(document, truth)

        return Made(folder / "session", judge, cause)

    return write


# Two arms with errors of their zeros, two fixed cameras and one in hand, a board 0.2 % too large, a
# gauge, and a sweep by a clock of its own.
EVERYTHING = {
    "stops": 40,
    "gauge_m": 5e-4,
    "robots": tuple(
        RobotAt(name, place_m, offset_sigma_rad=1e-3)
        for name, place_m in (("a", (-0.6, 0.0, 0.0)), ("b", (0.6, 0.05, 0.02)))
    ),
    "cameras": (
        CameraAt("left", place_m=(0.0, -1.0, 1.1), camera=CAMERAS["fine"]),
        CameraAt("right", place_m=(0.15, 0.95, 1.25), camera=CAMERAS["fine"]),
        CameraAt("hand", "b"),
    ),
    "boards": (
        BoardAt("floor", place_m=(0.0, 0.0, 0.05), scale=1.002),
        BoardAt("plate_a", "a", target=BOARDS["checkerboard"]),
        BoardAt("plate_b", "b"),
    ),
    "sweeps": (Swept("left", "a", "plate_a", camera_minus_robot_s=0.0437),),
}


def various(seed: int, folder: Path) -> Made:
    """A rendered cell that nobody chose."""
    cell = varied.cell(seed)
    return Made(varied.write(cell, folder), lambda document, *_: errors(document, cell.truth))


def posed(folder: Path, mount: str, robot: np.ndarray, camera: np.ndarray, **more: object) -> Path:
    """Writes a session of pose pairs."""
    folder.mkdir(parents=True)
    document = {"schema": 1, "name": "poses", "mount": mount, **more}
    (folder / "session.toml").write_text(tomli_w.dumps(document), encoding="utf-8")
    rows = [
        [repr(float(value)) for pose in pair for value in
         (*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat())]
        for pair in zip(robot, camera, strict=True)
    ]  # fmt: skip
    names = [*POSE, *(f"cft_{name}" for name in POSE)]
    write_table(folder / "views.csv", names, rows, {"view": range(len(rows))})
    return folder


def some_cell(seed: int) -> SimulatedCell:
    """A cell of pose pairs, with a robot that repeats to 0.03 to 0.3 mm."""
    rng = np.random.default_rng([seed, 7])
    noise_m = float(np.exp(rng.uniform(*np.log([3e-5, 3e-4]))))
    return simulate(CellOptions(mount=MOUNTS[seed % 2], views=int(rng.integers(8, 26)), seed=seed,
                                robot_sigma_m=noise_m, robot_sigma_rad=1.5 * noise_m))  # fmt: skip


def misread(kind: str):
    """Poses with a mistake that people make."""

    def write(seed: int, folder: Path) -> Made:
        cell, rng = some_cell(seed), np.random.default_rng(seed)
        seen = mistakes.sound(cell.robot.base_from_flange, cell.cam_from_target, cell.options.mount)
        mistaken = mistakes.MISTAKES[kind](seen, rng)
        robot, camera = mistaken.robot.poses(), mistaken.camera.poses()
        return Made(posed(folder / "session", mistaken.mount, robot, camera),
                    cause="misread|exchanged|swapped|unit|DataError")  # fmt: skip

    return write


def needed(seed: int, folder: Path) -> Made:
    """Pose pairs with a need, and how often picks land within it."""
    cell, rng = some_cell(seed), np.random.default_rng([seed, 8])
    options, camera = cell.options, cell.cam_from_target
    # From a third to three times what noise alone makes of a pick.
    mm = 1e3 * options.robot_sigma_m * float(np.exp(rng.uniform(np.log(0.8), np.log(7.0))))
    session = posed(folder / "session", options.mount, cell.robot.base_from_flange, camera,
                    need={"mm": mm})  # fmt: skip

    def judge(document, *_):
        truth, name = cell.transforms, next(iter(cell.transforms))
        found, draws = np.array(document["transforms"][name]["matrix"]), 4000
        drawn, at = np.random.default_rng(seed), np.arange(draws) % len(camera)
        sigmas = np.repeat([options.robot_sigma_rad, options.robot_sigma_m], 3)
        look, noise = (RigidTransform.from_exp_coords(sigmas * drawn.normal(size=(draws, 6)))
                       .as_matrix() for _ in range(2))  # fmt: skip
        if options.mount == MOUNTS[0]:
            robot = cell.robot.true_base_from_flange[at]
            meant, went = robot @ truth[name] @ camera[at], robot @ look @ found @ camera[at]
        else:
            meant, went = truth[name] @ camera[at], found @ camera[at]
        away = 1e3 * np.linalg.norm((went @ noise - meant)[:, :3, 3], axis=1)
        off = document["need"]["probability"] - float(np.mean(away < mm))
        return errors(document, truth) | {"off": off**2}

    return Made(session, judge)


def verified(seed: int, folder: Path) -> Command:
    """Later stops of a cell whose camera was knocked, every other time."""
    options, knocked = CellOptions(seed=seed, mount=MOUNTS[seed // 2 % 2]), bool(seed % 2)
    moved = replace(options, views=5, recording=1, camera_moved_m=5e-4 * knocked)
    for name, each in (("session", options), ("later", moved)):
        cell_session(simulate(each), name, seen="corners").save(folder / name)
    return _later_of(folder, knocked=knocked)


def _later_of(folder: Path, *, knocked: bool) -> Command:
    """Verifies the session `later` against what is calibrated of `session`."""

    def judge(document, _):
        causes = [change["cause"] for change in document["changes"]]
        return {"status": "pass" if document["passed"] else "fail", "cause": (causes or [""])[0],
                "is_right": causes[:1] == (["camera"] if knocked else [])}  # fmt: skip

    def argv(out):
        return ["verify", folder / "later", "--against", out]

    return Command(folder / "session", argv, judge, calibrates=True)


def repeated(seed: int, folder: Path) -> Command:
    """Five stops of an arm without joints, off by its posture, stood at again; half are knocked."""
    wrong = {"dh_sigma_m": 6e-5, "dh_sigma_rad": 6e-5, "branches": True, "roll_rad": np.pi}
    options = CellOptions(seed=seed, mount=MOUNTS[seed // 2 % 2], views=25, **wrong)
    cell, rng, knocked = simulate(options), np.random.default_rng(seed), bool(seed % 2)
    knock = later.knock(rng, 0.3 * knocked, 0.0)
    again = later.again(cell, rng, later.Change(camera=knock), repeated=25)
    for name, each in (("session", cell), ("later", again)):
        cell_session(each, name, seen="corners").save(folder / name)
        views = folder / name / "views.csv"
        columns, *rows = csv.reader(views.read_text().splitlines())
        kept = [at for at, column in enumerate(columns) if not re.match(r"q\d", column)]
        table = [[row[at] for at in kept] for row in rows]
        write_table(views, [columns[at] for at in kept], table)
    return _later_of(folder, knocked=knocked)


def tool(*, slips: bool):
    """Touches of a tool."""

    def write(seed: int, folder: Path) -> Command:
        folder.mkdir(parents=True)
        made = touched.touched(touched.Job(axes=2, noise=touched.Noise.of_robot(5e-5, 3e-5)), seed)
        touches = made.touches
        if slips:
            touches = touched.slipped(touches, 3, np.array([0.0, 1e-3, 1e-3]))
        rows = {"kind": touches.kinds, "point": [touches.names[at] for at in touches.points]}
        table = write_poses(folder / "touches.csv", touches.base_from_flange, rows)

        def judge(document, _):
            found = document["flange_from_tool"]
            away = touched.error_of(np.array(found["matrix"]))
            size = {"mm": 1e3 * rms(away[3:]), "deg": float(np.rad2deg(rms(away[:3])))}
            return {"status": found["verdict"]["status"], "errors": size} | over(
                away, np.array(found["covariance"])
            )

        return Command(folder, lambda _: ["tcp", table], judge)

    return write


def warming(*, temperatures: bool, dh_sigma_m: float = 0.0):
    """An arm that warms up for 100 minutes; what is left of its drift up to the fifth hour."""

    def write(seed: int, folder: Path) -> Made:
        options = CellOptions(seed=seed, branches=True, roll_rad=np.pi, dh_sigma_m=dh_sigma_m,
                              dh_sigma_rad=1.7 * dh_sigma_m)  # fmt: skip
        how = WarmUpOptions(options, temperatures=temperatures)
        cell, heat = simulate_warm_up(how), how.heats
        cell_session(cell, "warm-up", seen="poses").save(folder / "session")
        q = postures(load_robot(cell.options.robot))[::EVERY]
        hot = how.warming().at(np.linspace(6000.0, 18000.0, len(q)))
        still = np.full_like(hot, heat.ambient_c)
        arm = cell.robot.true_arm
        drift = np.subtract(*(heated_poses(arm, heat, q, at)[:, :3, 3] for at in (hot, still)))

        def judge(document, out, ask):
            job = {"do": "arm", "calibration": str(out / "calibration.json"), "q": q.tolist()}
            replies = [ask(**job, temperatures_c=at.tolist())["out"] for at in (hot, still)]
            if any(isinstance(reply, str) for reply in replies):  # No drift was found.
                return errors(document, cell.transforms)
            ours = np.subtract(*(np.array(reply)[:, :3, 3] for reply in replies))
            found = errors(document, cell.transforms)
            return found | {"errors": found["errors"] | {"drift mm": 1e3 * rms(ours - drift)}}

        return Made(folder / "session", judge)

    return write


def driven(seed: int, folder: Path) -> Command:
    """Torques of a moving arm: how near those of the last motion are predicted."""
    visioncal("simulate", folder / "session", "--torques", "--seed", seed)

    def judge(_, out):
        known = json.loads((out / "dynamics.json").read_text("utf-8"))
        left = np.divide(known["validation"]["rms_nm"], known["validation"]["torque_nm"])
        return {"status": known["verdict"]["status"], "errors": {"% of torque": 100.0 * rms(left)}}

    def argv(out):
        return ["dynamics", "identify", folder / "session", "-o", out]

    return Command(folder / "session", argv, judge)


def real(seed: int, _: Path) -> Made | None:
    """A recorded session: its left-out views, for want of a truth."""
    sessions = sorted(path.parent for path in REAL.glob("*/views.csv"))

    def judge(document, *_):
        left_out = document.get("validation", {}).get("held_out", {})
        return {"errors": {f"left out {unit}": value for unit, value in left_out.items()}}

    return Made(sessions[seed], judge) if seed < len(sessions) else None


_FINE, _ARM = kept_answers._FINE, kept_answers._WRONG_ARM
_OFF = (RobotAt("a", (-0.6, 0.0, 0.0), offset_sigma_rad=1e-3), RobotAt("b", (0.6, 0.05, 0.02)))
WORLDS: Mapping[str, Callable[[int, Path], Made | Command | None]] = {
    "real": real,
    "own: good robot": simple(_FINE),
    "own: coarse robot": simple(replace(_FINE, robot_sigma_m=3e-4, robot_sigma_rad=5e-4)),
    "own: 6 views": simple(replace(_FINE, views=6)),
    "own: two boards": simple(replace(_FINE, views=24, second=kept_answers._SHELF)),
    "own: 3 wrong views": simple(replace(_FINE, wrong_views=3), "wrong_views|exchanged|misread"),
    "own: lens 1 px off": simple(replace(_FINE, lens_mismatch_px=1.0), "lens|camera|intrinsics"),
    "own: board 0.5 % larger": simple(replace(_FINE, board_scale=1.005), "board|size|scale"),
    "arms: 0.3 mm, 0.3 mrad": simple(_ARM, workspace=True),
    "arms: zeros 1 mrad": simple(replace(_FINE, views=30, offset_sigma_rad=1e-3, branches=True),
                              workspace=True),
    "arms: springs": simple(replace(_ARM, views=60, compliance_rad_per_nm=kept_answers._SPRINGS),
                         workspace=True),
    **{f"elsewhere: {name}": foreign(name) for name in elsewhere.WORLDS},
    "cells: sound": network(),
    "cells: zeros 1 mrad": network(robots=_OFF),
    "cells: board moved": network("moved", moved=(Moved("target_floor", 12),)),
    "cells: wrong rows": network("wrong|exchanged|stray", swapped_rows=1, stray_images=4),
    "cells: everything": network(**EVERYTHING),
    "variety": various,
    **{f"guess: {kind}": misread(kind) for kind in mistakes.MISTAKES
       if kind != "base_link for base"},
    "need": needed,
    "verify": verified,
    "verify: stops repeated": repeated,
    "tcp: touches": tool(slips=False),
    "tcp: a slip of 1.4 mm": tool(slips=True),
    "thermal: by temperatures": warming(temperatures=True),
    "thermal: by currents": warming(temperatures=False),
    "thermal: arm off by 0.3 mm": warming(temperatures=True, dh_sigma_m=3e-4),
    "dynamics": driven,
}  # fmt: skip
