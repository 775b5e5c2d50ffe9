"""Planned stops against random ones from the same candidates.

Every candidate is feasible: what random stops lack is the choice alone. Errors are those of
calibrations of simulated views at the stops, from their corners on, against the truth.

    PYTHONPATH=tests python tests/benchmarks/planning.py [WORLDS]
"""

import time
from dataclasses import replace
from functools import partial
from multiprocessing import Pool

import numpy as np
from results import few, first, wished, write_section
from support.cells import calibrated, error_of
from support.planned import cell_of, next_best, plan_cell, so_far_of, true_cell, whole
from support.wrong_arms import WRONG_LINKS, error_m

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp
from visioncal.core.types import FloatArray
from visioncal.live.planning.candidates import candidates
from visioncal.live.planning.design import choose_stops
from visioncal.live.planning.information import WORLDS as SAMPLE
from visioncal.live.planning.information import World, predict_worlds
from visioncal.live.planning.purposes import PURPOSES
from visioncal.live.planning.recorded import SessionStart, start_from_session
from visioncal.simulation import CellOptions, SimulatedCell, simulate

WORLDS = 20
MOUNTS = ("eye-in-hand", "eye-to-hand")
CANDIDATES = few(1500, 200)
# Real arms and noises that each world's stops are tried with: one alone says little.
DRAWS = few(3, 1)
# How well the guesses are known from which is planned, and how far off bad ones are.
GUESS_RAD, GUESS_M = 0.03, 0.01
BAD_RAD, BAD_M = np.deg2rad(10.0), 0.05
ARMS = ("ur3e", "ur5e", "ur10e")
SURE = replace(WRONG_LINKS.target, square_sigma_m=1e-5 * WRONG_LINKS.target.square_m)
ARM = replace(WRONG_LINKS, target=SURE)
HAND_EYE = CellOptions(robot="ur5e", target=SURE)
STOPS = {"kinematics": 30, "hand-eye": 10}


def duel(name: str, options: CellOptions) -> tuple[FloatArray, FloatArray]:
    """Errors of planned and random stops (2, draws, e), and what was expected (2,) [mm]."""
    purpose, count = PURPOSES[name], STOPS[name]
    error = arm_error if name == "kinematics" else edge_error
    cell = plan_cell(options, GUESS_RAD, GUESS_M)
    q = candidates(cell, CANDIDATES, seed=options.seed).q
    worlds = predict_worlds((cell, *cell.guesses(SAMPLE - 1, options.seed)), purpose, q)
    planned = choose_stops(worlds, count).rows
    random = np.random.default_rng(options.seed).choice(len(q), count, replace=False)
    truth = predict_worlds([true_cell(options)], purpose, q)[0]
    errors, expected = [], []
    for rows in (planned, random):
        real = [simulate(replace(options, draw=index), q[rows]) for index in range(DRAWS)]
        errors.append([error(cell, calibrated(cell)) for cell in real])
        expected.append(expected_mm(truth, rows))
    return np.array(errors), np.array(expected)


def expected_mm(truth: World, rows: FloatArray) -> float:
    """The sigma of the place that counts, in the true cell [mm]."""
    return 1e3 * float(np.sqrt(np.trace(truth.position @ truth.covariance(rows))))


def arm_error(cell: SimulatedCell, known: RunState) -> FloatArray:
    """Error all over the workspace [mm]."""
    model = known.robot_arm.model
    return 1e3 * np.array([error_m(cell, known, known.robot if model is None else model.robot)])


def edge_error(cell: SimulatedCell, known: RunState) -> FloatArray:
    """Errors of x: offset [mm] and rotation [deg]."""
    away = error_of(cell, known)
    return np.array([1e3 * np.linalg.norm(away[3:6]), np.rad2deg(np.linalg.norm(away[:3]))])


def duels_row(name: str, options: CellOptions, found: list[tuple[FloatArray, FloatArray]]) -> str:
    """One line of the first table."""
    errors, expected = (np.array(pair) for pair in zip(*found, strict=True))
    # Worlds and draws alike.
    errors = np.concatenate(np.moveaxis(errors, 2, 1))
    rms, ratios = np.sqrt(np.mean(errors**2, axis=0)), expected[:, 1] / expected[:, 0]
    means = np.mean(errors[:, 1, 0]) / np.mean(errors[:, 0, 0])
    rotation = "" if rms.shape[1] == 1 else f" {rms[1, 1] / rms[0, 1]:.2f}"
    return (
        f"| {name} | {options.mount} | {STOPS[name]} "
        f"| {rms[0, 0]:.3g} | {rms[1, 0]:.3g} | {rms[1, 0] / rms[0, 0]:.2f} | {means:.2f} "
        f"|{rotation} | {expected[:, 0].mean():.3g} | {expected[:, 1].mean():.3g} "
        f"| {np.median(ratios):.2f} | {ratios.min():.2f} |"
    )


def speed(options: CellOptions) -> str:
    """CPU seconds for 1500 candidates and 60 stops, and those of a plain peer."""
    cell = plan_cell(options, GUESS_RAD, GUESS_M)
    begun = time.process_time()
    q = candidates(cell, CANDIDATES).q
    found = time.process_time()
    worlds = predict_worlds((cell, *cell.guesses(SAMPLE - 1, 0)), PURPOSES["kinematics"], q)
    told = time.process_time()
    choose_stops(worlds, 60)
    done = time.process_time()
    steps = 3
    peer(worlds[0], steps)
    plain = 60 / steps * (time.process_time() - done)
    return (
        f"{len(q)} candidates, 60 stops for an arm's kinematics, over {SAMPLE} worlds: information "
        f"{told - found:.2f} s, choice with exchange {done - told:.2f} s of CPU time (to find the "
        f"candidates took {found - begun:.1f} s). Recomputing each candidate's covariance, greedy "
        f"only and in one world: {plain:.0f} s; all {SAMPLE} worlds would take "
        f"{SAMPLE * plain / (done - told):.0f} times as long as the choice."
    )


def search_row(robot: str) -> str:
    """CPU seconds to find the candidates of one arm, from fair and from bad guesses."""
    cells = []
    for mount in MOUNTS:
        for sigmas in ((GUESS_RAD, GUESS_M), (BAD_RAD / np.sqrt(3.0), BAD_M / np.sqrt(3.0))):
            cell = plan_cell(replace(HAND_EYE, robot=robot, mount=mount), *sigmas)
            if mount == "eye-in-hand":
                cell = replace(cell, limits=replace(cell.limits, floor_m=-0.3))
            begun = time.process_time()
            found = len(candidates(cell, CANDIDATES))
            cells.append(f"{time.process_time() - begun:.1f} ({found})")
    return f"| {robot} | {' | '.join(cells)} |"


def bad_guess(mount: str, robot: str, seed: int) -> float:
    """Share of planned stops that see the whole board where both guesses are badly off.

    NaN where planning is refused.
    """
    true = cell_of(CellOptions(robot=robot, mount=mount, seed=seed))
    turn, shift = np.random.default_rng([seed, 5]).standard_normal((2, 2, 3))
    turn *= BAD_RAD / np.linalg.norm(turn, axis=1, keepdims=True)
    shift *= BAD_M / np.linalg.norm(shift, axis=1, keepdims=True)
    off = exp(np.concatenate([turn, shift], axis=1))
    guess = replace(
        true,
        x=true.x @ off[0],
        z=true.z @ off[1],
        sigma_rad=BAD_RAD / np.sqrt(3.0),
        sigma_m=BAD_M / np.sqrt(3.0),
        # The board may be lower than it seems.
        limits=replace(true.limits, floor_m=true.limits.floor_m and true.limits.floor_m - 0.2),
    )
    try:
        q = candidates(guess, CANDIDATES // 5, seed=seed).q
    except DataError:
        return np.nan
    worlds = predict_worlds((guess, *guess.guesses(SAMPLE - 1, seed)), PURPOSES["hand-eye"], q)
    return float(whole(true, q[choose_stops(worlds, 20).rows], 0.0).mean())


def bad_guess_row(robot: str, found: dict[str, list[float]]) -> str:
    """One line of the table of bad guesses."""
    cells = []
    for shares in found.values():
        refused = int(np.isnan(shares).sum())
        worst = f"{100 * np.nanmin(shares):.0f}" + (f" ({refused} refused)" if refused else "")
        cells.append(f"{100 * np.nanmean(shares):.1f} | {worst}")
    return f"| {robot} | {' | '.join(cells)} |"


def peer(world: World, count: int) -> list[int]:
    """Greedy I-optimal stops the plain way: each candidate's covariance by an inversion."""
    information, rows = world.prior + world.recorded, []
    gains = np.swapaxes(world.factors, 1, 2) @ world.factors
    for _ in range(count):
        spreads = np.linalg.inv(information + gains)
        values = np.einsum("ij,kji->k", world.objective, spreads)
        values[rows] = np.inf
        rows.append(int(np.argmin(values)))
        information = information + gains[rows[-1]]
    return rows


def one_axis(mount: str, seed: int) -> tuple[float, ...]:
    """Sigmas of x: predicted and obtained, at the noise of each; error over the obtained one."""
    options = replace(HAND_EYE, mount=mount, motion="one_axis", views=8, seed=seed)
    cell = simulate(options)
    begun = start_from_session(so_far_of(cell))
    q = candidates(begun.cell, 400, seed=seed).q
    added = next_best(begun, PURPOSES["hand-eye"], q, 5, seed=seed)
    whole = simulate(
        replace(options, motion="free"), np.concatenate([cell.robot.joints, q[added.design.rows]])
    )
    known = calibrated(whole, level="hand-eye")
    obtained = sigmas(known.assessment.covariance)
    predicted = added.design.predicted
    equal = at_noise(begun, q[added.design.rows], known)
    error = edge_error(whole, known)
    return predicted.mm, predicted.deg, *equal, *obtained, *error


def sigmas(covariance: FloatArray) -> tuple[float, float]:
    """Of x: offset [mm] and rotation [deg]."""
    return (
        1e3 * float(np.sqrt(np.trace(covariance[3:6, 3:6]))),
        float(np.rad2deg(np.sqrt(np.trace(covariance[:3, :3])))),
    )


def at_noise(begun: SessionStart, added: FloatArray, known: RunState) -> tuple[float, float]:
    """The prediction at the noise that the whole session shows."""
    noise = known.assessment.noise
    scale = (known.pixel_px / begun.cell.pixel_px) ** 2
    problem = begun.recorded.problem
    seen = replace(problem.observations, covariance=scale * problem.observations.covariance)
    cell = replace(begun.cell, noise=noise, pixel_px=known.pixel_px)
    recorded = replace(begun.recorded, problem=replace(problem, observations=seen), noise=noise)
    world = predict_worlds([cell], PURPOSES["hand-eye"], added, recorded=recorded)[0]
    return sigmas(world.covariance(range(len(added))))


def one_axis_row(mount: str, found: FloatArray) -> str:
    """One line of the last table."""
    predicted, equal, obtained, error = (found[:, index : index + 2] for index in range(0, 8, 2))
    ratios, first = obtained / equal, obtained / predicted
    honest = np.sqrt(np.mean((error / obtained) ** 2, axis=0))
    return (
        f"| {mount} | {predicted[:, 0].mean():.3f}, {predicted[:, 1].mean():.4f} "
        f"| {obtained[:, 0].mean():.3f}, {obtained[:, 1].mean():.4f} "
        f"| {first[:, 0].mean():.2f}, {first[:, 1].mean():.2f} "
        f"| {ratios[:, 0].mean():.2f}, {ratios[:, 1].mean():.2f} "
        f"| {ratios.min():.2f} to {ratios.max():.2f} | {honest[0]:.2f}, {honest[1]:.2f} |"
    )


def main(worlds: int) -> None:
    """Prints the tables and keeps them."""
    rows = [("kinematics", replace(ARM, mount=mount)) for mount in MOUNTS]
    rows += [("hand-eye", replace(HAND_EYE, mount=mount)) for mount in MOUNTS]
    with Pool() as pool:

        def run(function: partial, options: CellOptions | None = None) -> list:
            if options is None:
                return pool.map(function, range(worlds), 1)
            return pool.map(function, [replace(options, seed=index) for index in range(worlds)], 1)

        duels = [
            duels_row(name, cell_options, run(partial(duel, name), cell_options))
            for name, cell_options in first(rows)
        ]
        axes = [
            one_axis_row(name, np.array(run(partial(one_axis, name)))) for name in first(MOUNTS)
        ]
        seen = [
            bad_guess_row(arm, {mount: run(partial(bad_guess, mount, arm)) for mount in MOUNTS})
            for arm in first(ARMS)
        ]
    text = "\n".join(
        (
            f"Stops of a UR5e chosen from {CANDIDATES} feasible ones, and the same number drawn "
            "at random;",
            f"one board, {worlds} worlds a row, each with {DRAWS} draws of arm and noise. Planned",
            f"over {SAMPLE} cells, from guesses with errors of {1e2 * GUESS_M:.0f} cm and",
            f"{np.rad2deg(GUESS_RAD):.1f} deg (one sigma per axis).",
            "Kinematics: an arm with link errors of 0.5 mm and 1 mrad, a camera of 5 MP; errors",
            "of the carried frame all over the workspace. Hand-eye: an exact arm, 1 MP;",
            "errors of the camera's transform. Errors are root mean squares over the",
            "worlds; expected is the sigma in the true cell: a least ratio over 1 means",
            "that random stops were never expected to be better.\n",
            "| purpose | camera | stops | planned [mm] | random [mm] | ratio | ratio of means "
            "| ratio of rotations | planned, expected [mm] | random | ratio | least ratio |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
            *duels,
            f"\n{speed(ARM)}",
            f"\nCPU seconds to find {CANDIDATES} possible stops (how many there were):\n",
            "| arm | eye-in-hand, fair guess | bad guess | eye-to-hand, fair guess | bad guess |",
            "| --- | --- | --- | --- | --- |",
            *(search_row(name) for name in first(ARMS)),
            "\nOf 20 planned stops, those that see the whole board [%] if both guesses have",
            f"errors of {1e2 * BAD_M:.0f} cm and {np.rad2deg(BAD_RAD):.0f} deg, as stated:\n",
            "| arm | eye-in-hand, mean | worst world | eye-to-hand, mean | worst world |",
            "| --- | --- | --- | --- | --- |",
            *seen,
            "\nEight views that turn about one axis give no result. With five planned stops more,",
            "sigmas of the camera's edge [mm, deg]:\n",
            "| camera | predicted | obtained | obtained / predicted | at equal noise "
            "| least to most | error / obtained |",
            "| --- | --- | --- | --- | --- | --- | --- |",
            *axes,
        )
    )
    print(text)
    command = "PYTHONPATH=tests python tests/benchmarks/planning.py"
    write_section("Planning by information", command, text)


if __name__ == "__main__":
    main(wished(WORLDS))
