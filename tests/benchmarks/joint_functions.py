"""Arms whose joints err by functions of their angles: real ones from session to session, simulated.

    PYTHONPATH=tests python tests/benchmarks/joint_functions.py [WORLDS [WORLDS OF SIGMAS]]

An arm is calibrated on one recording and judged on another, whose frames (instrument and probe)
are fitted anew on twelve of its stops; the others are predicted. By stop, the squared error over
what is predicted of it: posterior of all errors of the arm, frames, noise, and the share of another
session. Simulated arms are judged with the frames of the calibration.
"""

import csv
import re
import resource
import tempfile
import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from results import QUICK, few, first, wished, write_section
from scipy.spatial.transform import Rotation
from support import thirdparty
from support.cells import arm_found
from support.tracked import known_of

from visioncal import correct
from visioncal.calibration.pipeline.result import result_of
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.kinematics import FUNCTIONS
from visioncal.core.transforms import adjoint, exp, invert, log
from visioncal.core.types import FloatArray
from visioncal.estimation import joint_functions
from visioncal.estimation.armmodel import HARMONICS
from visioncal.estimation.solve import Solution
from visioncal.interchange.exports import Selection, document
from visioncal.results.compensation.correction import predicted_sigma_mm
from visioncal.robot import Robot
from visioncal.robot.inverse import Inverse
from visioncal.session import Session
from visioncal.simulation.arms import forward
from visioncal.simulation.instrument_session import (
    InstrumentOptions,
    InstrumentRecord,
    random_postures,
    session_of,
    tracked,
)

WORLDS = 10
SESSIONS = Path(__file__).parents[3] / "shared" / "data" / "sessions"
# Stops on which the frames of another recording are fitted, and how often these are drawn.
ANCHORS, DRAWS = 12, 6
_STEPS = 40
SERIES = {name: f"ur10_tracker_series_{name}" for name in "ac"}
MECA = {name: f"meca500_tracker_{name}" for name in ("small", "large")}


@dataclass(frozen=True, eq=False)
class Recording:
    """Joints (m, n) [rad] and the probe's pose (m, 4, 4) in the instrument, or its place alone."""

    q: FloatArray
    read: FloatArray
    turned: bool


def recording(name: str) -> Recording:
    """Reads a recording; readings of one stop are averaged."""
    with (SESSIONS / name / "views.csv").open() as file:
        rows = list(csv.DictReader(file))
    joints = [key for key in rows[0] if key.startswith("q") and key.endswith("_rad")]
    q = np.array([[float(row[key]) for key in joints] for row in rows])
    read = np.tile(np.eye(4), (len(rows), 1, 1))
    read[:, :3, 3] = [[float(row[f"meas_{axis}_m"]) for axis in "xyz"] for row in rows]
    turned = "meas_qx" in rows[0]
    if turned:
        quaternions = [[float(row[f"meas_q{axis}"]) for axis in "xyzw"] for row in rows]
        read[:, :3, :3] = Rotation.from_quat(quaternions).as_matrix()
    stops = [row.get("stop", str(at)) for at, row in enumerate(rows)]
    firsts = [stops.index(stop) for stop in dict.fromkeys(stops)]
    for at in firsts:
        mine = [row for row, stop in enumerate(stops) if stop == stops[at]]
        read[at, :3, 3] = read[mine, :3, 3].mean(axis=0)
    return Recording(q[firsts], read[firsts], turned)


def part_of(name: str, count: int, seed: int, folder: Path) -> Session:
    """So many stops of a recording, drawn from those that its session does not hold back."""
    lines = (SESSIONS / name / "views.csv").read_text().splitlines()
    rows = [line for line in lines[1:] if "holdout" not in line]
    chosen = np.sort(np.random.default_rng(seed).choice(len(rows), count, replace=False))
    folder.mkdir(parents=True)
    (folder / "session.toml").write_text((SESSIONS / name / "session.toml").read_text())
    (folder / "views.csv").write_text("\n".join([lines[0], *(rows[index] for index in chosen), ""]))
    return Session.load(folder)


def slopes(flange: FloatArray, x: FloatArray, z: FloatArray) -> FloatArray:
    """(m, 6, 12) how the probe moves with the instrument's frame and the probe's."""
    by_x = -adjoint(invert(flange @ z) @ x)
    return np.concatenate([by_x, np.broadcast_to(np.eye(6), by_x.shape)], axis=2)


def predicted_covariance(known: RunState, q: FloatArray, z: FloatArray) -> FloatArray:
    """(6 m, 6 m) of the probe at (m, n) joints by what is open about the arm, and its noise."""
    answer, arm = known.assessment, known.robot_arm
    fit = Solution(answer.state, answer.noise)
    data, model = arm.data(answer.problem, fit, answer.covariance, {}), arm.model
    carried = adjoint(invert(z))
    basis = (carried @ model.basis(q)).reshape(6 * len(q), -1)
    found = basis @ data.arm_covariance @ basis.T
    if HARMONICS in model.weights:
        orders = len(model.harmonic_sizes) // (2 * model.nominal.joint_count)
        moved = carried @ model.robot.harmonic_jacobian(q, orders)
        moved = data.error_rad * model.weights[HARMONICS] * moved.reshape(6 * len(q), -1)
        whole, told = moved * model.harmonic_sizes, moved @ model.harmonic_directions
        found += whole @ whole.T - told @ told.T
    noise = carried @ np.diag(np.repeat(answer.noise.robots[0], 3) ** 2) @ carried.T
    return found + np.kron(np.eye(len(q)), noise)


def placed(
    flange: FloatArray, other: Recording, rows: FloatArray, start: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Fits the frames on some rows.

    Returns:
        The instrument's frame and the probe's, and (6 m, 6 r) how residuals of all follow those of
        the rows.
    """
    x, z = start
    # A mrad weighs as much as half a millimetre; of places alone rotation does not count.
    weights = np.tile(np.repeat([0.5 if other.turned else 0.0, 1.0], 3), len(rows))
    for _ in range(_STEPS):
        slope = slopes(flange, x, z)
        away = residuals(flange, other, x, z)
        inverse = np.linalg.pinv(weights[:, None] * slope[rows].reshape(-1, 12), rcond=1e-10)
        step = inverse @ (weights * away[rows].ravel())
        x, z = x @ exp(step[None, :6])[0], z @ exp(step[None, 6:])[0]
        if np.abs(step).max() < 1e-10:
            break
    return x, z, slope.reshape(-1, 12) @ inverse * weights


def residuals(flange: FloatArray, other: Recording, x: FloatArray, z: FloatArray) -> FloatArray:
    """(m, 6) of the probe, or of its place alone."""
    error = invert(invert(x) @ flange @ z) @ other.read
    found = log(error)
    if not other.turned:
        found = np.concatenate([np.zeros_like(found[:, :3]), error[:, :3, 3]], axis=1)
    return found


@dataclass(frozen=True)
class Carried:
    """Errors of places [mm] by the arm as stated and as calibrated, and over what is predicted.

    The last is by the arm as calibrated with frames fitted on all stops: what frames of few stops
    add is not in it.
    """

    nominal_mm: float
    mm: float
    ratio: float
    predicted_mm: float
    framed_mm: float


def carried_over(known: RunState, other: Recording) -> Carried:
    """How an arm predicts another recording, its frames fitted on a few of the stops."""
    arm, edges = known.robot_arm, known.assessment.state.edges
    stated = arm.matched.arm.base_from_flange(other.q)
    calibrated = stated if arm.model is None else arm.model.base_from_flange(other.q)
    squares, predicted, session = {"stated": [], "calibrated": []}, [], 0.0
    among = None
    if arm.model is not None:
        among = predicted_covariance(known, other.q, edges[1])
        session = (1e-3 * arm_found(known).carries_over.session_mm) ** 2
    for draw in range(few(DRAWS, 1)):
        rows = np.random.default_rng(draw).choice(len(other.q), ANCHORS, replace=False)
        rest = np.setdiff1d(np.arange(len(other.q)), rows)
        for name, flange in (("stated", stated), ("calibrated", calibrated)):
            x, z, followed = placed(flange, other, rows, (edges[0], edges[1]))
            away = residuals(flange, other, x, z)[rest, 3:]
            squares[name].append(np.sum(away**2, axis=1))
        if among is None:
            continue
        shares = -followed
        mine = (6 * rows[:, None] + np.arange(6)).ravel()
        places = (6 * rest[:, None] + np.arange(3, 6)).ravel()
        taken = shares[np.ix_(places, np.arange(len(mine)))]
        cross = np.sum(taken * among[np.ix_(places, mine)], axis=1)
        own = np.sum((taken @ among[np.ix_(mine, mine)]) * taken, axis=1)
        variances = np.diag(among)[places] + 2.0 * cross + own
        predicted.append(variances.reshape(-1, 3).sum(axis=1) + session)
    found = {name: np.concatenate(square) for name, square in squares.items()}
    rms = {name: 1e3 * float(np.sqrt(array.mean())) for name, array in found.items()}
    every = np.arange(len(other.q))
    x, z, _ = placed(calibrated, other, every, (edges[0], edges[1]))
    left = residuals(calibrated, other, x, z)[:, 3:]
    framed_mm = 1e3 * float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
    if not predicted:
        return Carried(rms["stated"], rms["calibrated"], np.nan, np.nan, framed_mm)
    variance = np.concatenate(predicted)
    ratio = float(found["calibrated"].mean() / variance.mean())
    predicted_mm = 1e3 * float(np.sqrt(variance.mean()))
    return Carried(rms["stated"], rms["calibrated"], ratio, predicted_mm, framed_mm)


def without_functions(session: Session) -> RunState:
    """The calibration with the levels that are no functions of the joints."""
    usual, joint_functions.SIGNIFICANT = joint_functions.SIGNIFICANT, np.inf
    known = known_of(session)
    joint_functions.SIGNIFICANT = usual
    return known


def cross_row(words: str, session: Session, other: Recording) -> str:
    """One line of the first table."""
    begun = time.process_time()
    ours = known_of(session)
    seconds = time.process_time() - begun
    before = without_functions(session)
    found, was = carried_over(ours, other), carried_over(before, other)
    levels = [run_state.robot_arm.kinematics for run_state in (before, ours)]
    return (
        f"| {words} | {levels[1].level} "
        f"| {levels[0].result.chosen.held_out_mm:.3f}, {levels[1].result.chosen.held_out_mm:.3f} "
        f"| {found.nominal_mm:.2f} | {was.mm:.3f} | {was.ratio:.1f} | {found.mm:.3f} "
        f"| {found.ratio:.2f} | {found.framed_mm:.3f} | {seconds:.0f} |"
    )


def crossings(folder: Path) -> list[str]:
    """The first table: one recording by another."""
    pairs = [
        ("UR10, c by a", "c", "a"),
        ("UR10, a by c", "a", "c"),
    ]
    rows = []
    for words, of, by in first(pairs):
        session = Session.load(SESSIONS / SERIES[of])
        if QUICK:
            session = part_of(SERIES[of], 24, 0, folder / "quick")
        rows.append(cross_row(words, session, recording(SERIES[by])))
    for draw in range(few(2, 0)):
        for of, by in (("c", "a"), ("a", "c")):
            session = part_of(SERIES[of], 60, draw, folder / f"{of}{draw}")
            words = f"UR10, 60 stops of {of} by {by}, {draw + 1}"
            rows.append(cross_row(words, session, recording(SERIES[by])))
    for of, by in (("small", "large"), ("large", "small"))[: few(2, 0)]:
        session = Session.load(SESSIONS / MECA[of])
        rows.append(cross_row(f"Meca500, {of} by {by}", session, recording(MECA[by])))
    return rows


def within(words: str, session: Session) -> str:
    """One line of the second table: stops left out, before and now."""
    before, ours = without_functions(session), known_of(session)
    was, now = (run_state.robot_arm.kinematics.result for run_state in (before, ours))
    return (
        f"| {words} | {was.nominal.held_out_mm:.3f} | {was.level}, {was.chosen.held_out_mm:.3f} "
        f"| {now.level}, {now.chosen.held_out_mm:.3f} | {ours.verdict.status} |"
    )


def others() -> list[str]:
    """The second table: other arms."""
    data = SESSIONS.parent
    real: list[tuple[str, Callable[[], Session]]] = [
        ("ROKAE, 30 poses by a laser", lambda: thirdparty.rokae(data)),
        ("IRB 120, 36 places", lambda: thirdparty.irb120(data)),
        ("Positioner of two axes, 205 poses", lambda: thirdparty.positioner(data)),
        ("TALOS, 61 contacts", lambda: thirdparty.talos(data)),
        ("figaroh's UR10, 23 poses", lambda: thirdparty.figaroh_ur10(data)),
    ]
    return [within(words, session()) for words, session in first(real)]


@dataclass(frozen=True)
class World:
    """Simulated stops: how many, over which range of the joints, and the functions of these."""

    stops: int
    range_rad: float
    function_rad: float
    length_rad: float

    def drawn(self, seed: int) -> tuple[InstrumentRecord, FloatArray, FloatArray]:
        """What was read, and (m, 6) postures in the range and all over."""
        options = InstrumentOptions(
            stops=self.stops,
            poses=True,
            dh_sigma_m=5e-4,
            dh_sigma_rad=7e-4,
            offset_sigma_rad=7e-4,
            function_sigma_rad=self.function_rad,
            function_length_rad=self.length_rad,
            seed=seed,
        )
        rng = np.random.default_rng([seed, 5])
        anywhere = random_postures(tracked(options, np.zeros((1, 6))).arm, self.stops + 400, rng)
        middle = np.array([0.3, -1.2, 1.4, -0.4, 1.2, 0.1])
        boxed = middle + rng.uniform(-1, 1, (self.stops + 100, 6)) * self.range_rad
        near = boxed if self.range_rad < 2.5 else anywhere
        shop = tracked(options, near[: self.stops])
        return shop, near[self.stops : self.stops + 100], anywhere[-200:]

    def tried(self, seed: int) -> tuple[bool, float, float, float, float, float, float]:
        """Whether functions were taken; errors inside and outside [mm]; over predicted; seconds."""
        shop, inside, outside = self.drawn(seed)
        session, begun = session_of(shop), time.process_time()
        ours = known_of(session)
        seconds = time.process_time() - begun
        before = without_functions(session)

        def away(known: RunState, q: FloatArray) -> FloatArray:
            x, z = known.assessment.state.edges[:2]
            arm = known.robot_arm
            flange = (arm.model or arm.matched.arm).base_from_flange(q)
            true = forward(shop.true_arm, q) @ shop.flange_from_probe
            error = invert(invert(x) @ flange @ z) @ invert(shop.base_from_instrument) @ true
            return np.sum(error[:, :3, 3] ** 2, axis=1)

        ratios, answer = [], ours.assessment
        data = ours.robot_arm.data(
            answer.problem, Solution(answer.state, answer.noise), answer.covariance, {}
        )
        for q in (inside, outside):
            variances = data.place_sigmas_m(q) ** 2 if data else np.array([np.nan])
            ratios.append(away(ours, q).mean() / variances.mean())
        errors = [away(run_state, outside).mean() for run_state in (before, ours)]
        return (
            ours.robot_arm.kinematics.level == FUNCTIONS,
            1e3 * float(np.sqrt(away(ours, inside).mean())),
            1e3 * float(np.sqrt(errors[1])),
            float(np.sqrt(errors[1] / errors[0])),
            float(ratios[0]),
            float(ratios[1]),
            seconds,
        )

    def used(self, seed: int) -> list[list[float]]:
        """How far ways to use the arm that was found are off, in the range and all over [mm]."""
        shop, *regions = self.drawn(seed)
        known = known_of(session_of(shop))
        result, arm = result_of(known), known.robot_arm
        edges = known.assessment.state.edges
        stated = arm.kinematics.nominal.fit.state.edges
        written = document(result, "robot-dh")
        beside = document(result, "robot-dh", Selection(with_corrections=True))
        alone, plain = (Robot.from_document(tomllib.loads(item.text)) for item in (written, beside))
        text = document(result, "joint-corrections").text
        lines = [line.split(",") for line in text.splitlines() if not line.startswith("#")][1:]
        joints = result.robot.joint_names
        tables = [
            np.array([line[1:3] for line in lines if line[0] == joint], dtype=float).T
            for joint in joints
        ]
        inverse = Inverse(plain)

        def away(robot: Robot, q: FloatArray, sent: FloatArray, frames: FloatArray) -> float:
            wanted = invert(frames[0]) @ robot.base_from_flange(q) @ frames[1]
            true = forward(shop.true_arm, sent) @ shop.flange_from_probe
            error = invert(wanted) @ invert(shop.base_from_instrument) @ true
            return 1e3 * float(np.sqrt(np.mean(np.sum(error[:, :3, 3] ** 2, axis=1))))

        rows = []
        for q in regions:
            nominal = arm.matched.arm
            wanted = nominal.base_from_flange(q)
            sent = correct(result, wanted, q).q
            angles = np.array(
                [inverse.solve(*pair).positions for pair in zip(wanted, q, strict=True)]
            )
            by_table = np.column_stack(
                [
                    column + np.deg2rad(np.interp(np.rad2deg(column), *table))
                    for column, table in zip(angles.T, tables, strict=True)
                ]
            )
            apart = result.standing(sent) - result.standing(by_table)
            rows.append(
                [
                    away(nominal, q, q, stated),
                    away(plain, q, q, edges),
                    away(alone, q, q, edges),
                    away(nominal, q, sent, edges),
                    away(nominal, q, by_table, edges),
                    1e6 * float(np.linalg.norm(apart[:, :3, 3], axis=1).max()),
                ]
            )
        said = [warning for warning in written.warnings if "leave the least" in warning]
        figures = re.findall(r"([\d.]+) mm rms", said[0]) if said else ["0", "0"]
        return [[*row, float(figure)] for row, figure in zip(rows, figures, strict=True)]

    def uses(self, worlds: int) -> list[str]:
        """Lines of the fourth table."""
        found = np.array([self.used(seed) for seed in range(worlds)])
        return [
            f"| {self.range_rad:.1f} | {1e3 * self.function_rad:.1f}, {self.length_rad:.2f} "
            f"| {where} | {stated:.2f} | {cut:.3f} | {alone:.3f} | {said:.3f} "
            f"| {corrected:.3f} | {table:.3f} | {apart:.2f} |"
            for where, (stated, cut, alone, corrected, table, apart, said) in zip(
                ("in it", "all over"), np.median(found, axis=0), strict=True
            )
        ]

    def stated(self, seed: int) -> list[list[float]]:
        """Errors [mm], and squared over predicted by posture, and by the maps of the result."""
        shop, *regions = self.drawn(seed)
        known = known_of(session_of(shop))
        answer, arm = known.assessment, known.robot_arm
        x, z = answer.state.edges[:2]
        data = arm.data(answer.problem, Solution(answer.state, answer.noise), answer.covariance, {})
        rows = []
        for q in regions:
            flange = arm.model.base_from_flange(q)
            true = forward(shop.true_arm, q) @ shop.flange_from_probe
            error = invert(invert(x) @ flange @ z) @ invert(shop.base_from_instrument) @ true
            squared = 1e6 * np.mean(np.sum(error[:, :3, 3] ** 2, axis=1))
            by_posture = 1e6 * np.mean(data.place_sigmas_m(q) ** 2)
            mapped = predicted_sigma_mm(result_of(known), flange[:, :3, 3], q)
            by_map = np.mean(mapped**2)
            rows.append([np.sqrt(squared), squared / by_posture, squared / by_map])
        return rows

    def sigmas(self, worlds: int) -> str:
        """One line of the fifth table."""
        found = np.array([self.stated(seed) for seed in range(100, 100 + worlds)])
        near, far = found[:, 0].T, found[:, 1].T
        functions = f"{1e3 * self.function_rad:.1f}, {self.length_rad:.2f}"
        return (
            f"| {self.stops} | {self.range_rad:.1f} | {functions if self.function_rad else 'none'} "
            f"| {np.median(near[0]):.3f} | {near[1].mean():.2f} | {near[2].mean():.2f} "
            f"| {np.median(far[0]):.3f} | {far[1].mean():.2f} | {far[2].mean():.2f} |"
        )

    def row(self, worlds: int) -> str:
        """One line of the third table."""
        found = np.array([self.tried(seed) for seed in range(worlds)], dtype=float)
        taken, inside, outside, share, ratio, ratio_out, seconds = found.T
        functions = f"{1e3 * self.function_rad:.1f}, {self.length_rad:.2f}"
        return (
            f"| {self.stops} | {self.range_rad:.1f} | {functions if self.function_rad else 'none'} "
            f"| {int(taken.sum())} of {worlds} "
            f"| {np.median(inside):.3f} | {np.median(outside):.3f} "
            f"| {np.median(share):.2f} | {ratio.mean():.2f} | {ratio_out.mean():.2f} "
            f"| {np.median(seconds):.0f} |"
        )


USED_ROWS = (
    World(60, 0.4, 3e-4, 0.06),
    World(60, 0.4, 3e-4, 0.25),
    World(60, 2.5, 3e-4, 0.06),
    World(60, 2.5, 3e-4, 0.25),
)
SIGMA_ROWS = (
    *USED_ROWS,
    World(30, 0.4, 3e-4, 0.06),
    World(60, 0.4, 0.0, 0.06),
    World(60, 2.5, 0.0, 0.06),
    World(30, 2.5, 0.0, 0.06),
)
WORLD_ROWS = (
    World(30, 0.4, 3e-4, 0.06),
    World(30, 2.5, 3e-4, 0.06),
    World(60, 0.4, 3e-4, 0.06),
    World(60, 2.5, 3e-4, 0.06),
    World(60, 2.5, 1e-4, 0.25),
    World(120, 2.5, 3e-4, 0.06),
    World(60, 0.4, 0.0, 0.06),
    World(60, 2.5, 0.0, 0.06),
)


# How many stops the costs are of.
COSTS = (60, 300, 1000)


def cost(stops: int) -> str:
    """A row: processor time with and without functions of the joints, and memory."""
    session = session_of(World(stops, 2.5, 3e-4, 0.06).drawn(0)[0])
    without_functions(session)
    begun = time.process_time()
    without_functions(session)
    plain_s, begun = time.process_time() - begun, time.process_time()
    known_of(session)
    whole_s = time.process_time() - begun
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return f"| {stops} | {plain_s:.1f} | {whole_s:.1f} | {most:.0f} |"


def main(worlds: int) -> None:
    """Prints the tables and keeps them."""
    with tempfile.TemporaryDirectory() as folder:
        crossed = crossings(Path(folder))
    real = others()
    rows = first(WORLD_ROWS)
    if QUICK:
        rows = [replace(rows[0], length_rad=0.25)]
    simulated = [row.row(worlds) for row in rows]
    surely = [world.sigmas(wished(20, place=1)) for world in first(SIGMA_ROWS)]
    uses = [line for world in first(USED_ROWS) for line in world.uses(worlds)]
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        costs = pool.map(cost, few(COSTS, (30,)), chunksize=1)
    text = "\n".join(
        [
            "One recording predicted from another: RMS position error [mm], with the frames",
            "fitted on 12 stops. Left out: at stops left out of the fit, with the best",
            "earlier level and with the chosen one. Over predicted: mean squared error",
            "over the predicted one. Framed: with the frames fitted on all stops of the",
            "other recording.",
            "",
            "| recordings | taken | left out | as stated | levels before | over predicted "
            "| now | over predicted | framed | s |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
            *crossed,
            "",
            "Other arms: RMS at stops left out of the fit [mm].",
            "",
            "| arm | as stated | levels before | now | verdict |",
            "| --- | --- | --- | --- | --- |",
            *real,
            "",
            f"Simulated arms ({worlds} worlds a row; 0.5 mm, 0.7 mrad; poses by a tracker): ranges",
            "of the joints [rad], size [mrad] and length [rad] of the functions, how often they",
            "were chosen, RMS errors [mm] in that range and all over, the latter over that",
            "of the earlier levels, and squared error over the predicted one in the range",
            "and all over.",
            "",
            "| stops | range | functions | taken | in it | all over | share "
            "| over predicted | all over | s |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
            *simulated,
            "",
            "The same arms with 60 stops in use (medians, RMS [mm]): nominal; a file with links",
            "only, the functions cut off or the links fitted to them, and its stated",
            "difference from the identified arm; targets from `correct`, from a table of",
            "joint corrections, and the greatest difference of these two [um].",
            "",
            "| range | functions | where | as stated | cut off | fitted | said | corrected "
            "| by the table | apart |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
            *uses,
            "",
            "Errors of places [mm] (median), and mean squared error over what is predicted, by",
            "posture and by the maps of a result (as `correct` has it), in the range and all over.",
            "",
            "| stops | range | functions | in it | posture | map | all over | posture | map |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
            *surely,
            "",
            "Processor time of a whole calibration [s], without and with the level functions,",
            "and the peak memory of the process [MB].",
            "",
            "| stops | without | with functions | MB |",
            "| ---: | ---: | ---: | ---: |",
            *costs,
        ]
    )
    command = f"PYTHONPATH=tests python tests/benchmarks/joint_functions.py {worlds}"
    write_section("Functions of the joints", command, text)


if __name__ == "__main__":
    main(wished(WORLDS))
