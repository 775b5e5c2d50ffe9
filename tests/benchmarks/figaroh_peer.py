"""Arms calibrated from poses by figaroh 1.0.2 and by visioncal, and by visioncal from corners.

The same simulated arms, postures and measured poses for both. figaroh is no part of the development
environment: `pip install -e .[bench]`.

    PYTHONPATH=tests python tests/benchmarks/figaroh_peer.py [WORLDS]
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from multiprocessing import Pool
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import TypeAlias

import numpy as np
from results import few, first, need, wished, write_section
from support.cells import calibrated
from support.wrong_arms import WRONG_LINKS, target_in_camera

import visioncal
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import ArmErrors
from visioncal.estimation.armmodel import ArmModel
from visioncal.estimation.chain import chain, robot_part
from visioncal.estimation.closed_form import SOLVERS
from visioncal.estimation.kinematics import LEVELS, ArmTrials, fit_level
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import ROBOT, Noise, State
from visioncal.estimation.solve import solve_problem
from visioncal.estimation.workspace import postures
from visioncal.robot import load_robot
from visioncal.simulation import (
    CellOptions,
    SimulatedCell,
    forward,
    measured_poses,
    simulate,
    write_session,
)

WORLDS, REPEATS = 10, few(3, 1)
# The arm's true departures, of which the ways that are `told` know.
SIZE_M, SIZE_RAD = 5e-4, 1e-3
# Half a micrometre on half a metre.
AT_REST_RAD = 1e-6
PLAIN = "figaroh, `structural`"
TOLD = ("figaroh, `map`", "visioncal's fit")
UNTOLD = ("figaroh, `map_cv`", "visioncal's fit with noise and sizes estimated")
WHOLE = "`visioncal calibrate`, poses"
CORNERS = "`visioncal calibrate`, corners"
ROWS = (PLAIN, *TOLD, *UNTOLD, WHOLE, CORNERS)

Predict: TypeAlias = Callable[[FloatArray], FloatArray]
Found: TypeAlias = tuple[Predict, float]


@dataclass(frozen=True, eq=False)
class World:
    """A cell with the poses of its target that both are given."""

    cell: SimulatedCell  # The cell.
    poses: FloatArray  # (m, 4, 4) `cam_from_target` as measured.

    @property
    def in_hand(self) -> bool:
        """Whether the camera is on the flange."""
        return self.cell.options.mount == "eye-in-hand"

    @property
    def world_from_marker(self) -> FloatArray:
        """(m, 4, 4) what is on the flange in what stands still, as figaroh takes it."""
        return invert(self.poses) if self.in_hand else self.poses

    def at(self, edges: FloatArray, flange: FloatArray) -> FloatArray:
        """(k, 4, 4) `cam_from_target` with (k, 4, 4) poses of the flange."""
        return target_in_camera(self.cell.options.mount, *edges, flange)

    def truly(self, q: FloatArray) -> FloatArray:
        """(k, 4, 4) the true `cam_from_target` at (k, n) joint angles."""
        edges = np.array([*self.cell.transforms.values()])
        return self.at(edges, forward(self.cell.robot.true_arm, q))

    def error_mm(self, predict: Predict) -> float:
        """Root mean square error of the camera's place in the target over the workspace."""
        q = postures(load_robot(self.cell.options.robot))
        away = (invert(self.truly(q)) - invert(predict(q)))[:, :3, 3]
        return 1e3 * float(np.sqrt(np.mean(np.sum(away**2, axis=1))))

    def noise(self, *, inverted: bool) -> Noise:
        """The poses' true noise per axis, of `cam_from_target` or of its inverse."""
        true, poses = self.truly(self.cell.robot.joints), self.poses
        away = log(true @ invert(poses)) if inverted else log(invert(true) @ poses)
        square = np.mean(away**2, axis=0)
        return Noise(np.sqrt(square.reshape(1, 2, 3).mean(axis=2)), np.zeros(0))


def of_figaroh(world: World) -> dict[str, Found]:
    """Its three methods: as in its UR10 example, told noise and sizes, and finding sizes itself."""
    from figaroh_fit import Settings, calibrate

    noise = world.noise(inverted=world.in_hand)
    told = {"translation": SIZE_M, "rotation": SIZE_RAD, "joint_offset": SIZE_RAD}
    of_example = (1.0, 0.5)
    settings = {
        PLAIN: Settings(of_example, {"method": "structural"}),
        TOLD[0]: Settings(
            tuple(1.0 / noise.robots[0, ::-1]),
            {"method": "map", "priors": told, "noise_std": 1.0},
        ),
        UNTOLD[0]: Settings(of_example, {"method": "map_cv"}),
    }
    robot, found = load_robot(world.cell.options.robot), {}
    for name, chosen in settings.items():
        runs = [
            calibrate(robot, world.cell.robot.joints, world.world_from_marker, chosen)
            for _ in range(1 if name == UNTOLD[0] else REPEATS)
        ]
        found[name] = world_view(world, runs[0].predict), min(run.seconds for run in runs)
    return found


def world_view(world: World, predict: Predict) -> Predict:
    """Figaroh's prediction as `cam_from_target`."""
    return (lambda q: invert(predict(q))) if world.in_hand else predict


def of_our_fit(world: World, *, told: bool) -> Found:
    """The estimator from the poses on, from a closed-form start; repeated for its time."""
    noise = world.noise(inverted=False)
    seconds = []
    for _ in range(REPEATS):
        begun = process_time()
        with one_blas_thread():
            edges, model = fitted(world, noise if told else None)
        seconds.append(process_time() - begun)
    return lambda q: world.at(edges, model.robot.base_from_flange(q)), min(seconds)


def fitted(world: World, noise: Noise | None) -> tuple[FloatArray, ArmModel]:
    """Both edges and the arm; noise and sizes are estimated where the noise is not told."""
    cell, q = world.cell, world.cell.robot.joints
    model = ArmModel.of(load_robot(cell.options.robot), q, cell.robot.base_from_flange)
    basis = model.columns("links", q)
    start = SOLVERS["shah"](
        robot_part(cell.robot.base_from_flange, cell.options.mount), world.poses
    )
    edges = np.stack([start.x, start.z])
    errors = {"links": ArmErrors(basis, SIZE_RAD, 0.0, of_links=True)}
    if noise is None:
        state = State(edges, np.zeros(0))
        trials = ArmTrials(
            _chain(world, cell.robot.base_from_flange), state, ROBOT, {"links": basis}
        )
        level = fit_level(trials, LEVELS["geometry"])
        if level is None:
            raise RuntimeError("the arm's errors do not show")
        errors, noise, edges = dict(level.errors), level.fit.noise, level.fit.state.edges
    model = model.with_errors(errors)
    while True:
        arm = replace(errors["links"], basis=model.basis(q)).effect(ROBOT, values=model.values)
        still = np.zeros_like(model.values)
        problem = _chain(world, model.robot.base_from_flange(q))
        problem = problem.with_effects([replace(arm, values=still)])
        state, _ = solve_problem(problem, State(edges, still), noise)
        edges, model = state.edges, model.moved(state.values)
        if np.abs(state.values).max() < AT_REST_RAD:
            return edges, model


def _chain(world: World, flange: FloatArray) -> Problem:
    return chain(world.cell.options.mount, flange, world.poses)


def from_poses(world: World) -> Found:
    """All that `visioncal calibrate` does, with a session of the same poses."""
    with TemporaryDirectory() as name:
        session = visioncal.Session.load(write_session(world.cell, Path(name) / "s", images=False))
    begun = process_time()
    result = visioncal.calibrate(session)
    seconds = process_time() - begun
    edges = np.array([result.edges[name].matrix for name in world.cell.transforms])
    return lambda q: world.at(edges, result.base_from_flange(q).as_matrix()), seconds


def from_corners(world: World) -> Found:
    """The same from the corners on."""
    begun = process_time()
    known = calibrated(world.cell)
    seconds = process_time() - begun
    if known.robot_arm.model is None:
        raise RuntimeError("the arm stayed nominal")
    edges, robot = known.assessment.state.edges, known.robot_arm.model.robot
    return lambda q: world.at(edges, robot.base_from_flange(q)), seconds


def measured(options: CellOptions) -> dict[str, tuple[float, float]]:
    """Each way's held-out error [mm] and processor time [s] in one world."""
    cell = simulate(options)
    world = World(cell, measured_poses(cell))
    ways = {
        **of_figaroh(world),
        TOLD[1]: of_our_fit(world, told=True),
        UNTOLD[1]: of_our_fit(world, told=False),
        WHOLE: from_poses(world),
        CORNERS: from_corners(world),
    }
    return {name: (world.error_mm(predict), seconds) for name, (predict, seconds) in ways.items()}


def table(found: dict[str, list[dict[str, tuple[float, float]]]]) -> str:
    """The rows of both mounts, and how often visioncal's fits are as good and how much faster."""
    lines, said = [], []
    for mount, worlds in found.items():
        errors, seconds = (
            {name: np.array([world[name][which] for world in worlds]) for name in ROWS}
            for which in (0, 1)
        )
        lines += [
            f"| {mount} | {name} | {np.median(errors[name]):.3f} | "
            f"{np.quantile(errors[name], 0.9):.3f} | {1e3 * np.median(seconds[name]):.0f} |"
            for name in ROWS
        ]
        for theirs, ours in ((PLAIN, TOLD[1]), TOLD, UNTOLD, (PLAIN, WHOLE), (PLAIN, CORNERS)):
            error = np.median(errors[ours] / errors[theirs])
            faster = np.median(seconds[theirs] / seconds[ours])
            said.append(f"| {mount} | {ours} | {theirs} | {error:.2f} | {faster:.2g} |")
    return "\n".join(
        (
            "| camera | way | held-out error [mm] | 90 % of worlds under [mm] | processor [ms] |",
            "| --- | --- | --- | --- | --- |",
            *lines,
            "",
            "| camera | ours | theirs | error, ours over theirs | times faster |",
            "| --- | --- | --- | --- | --- |",
            *said,
        )
    )


def main(worlds: int) -> None:
    """Prints the table and keeps it."""
    found = {}
    with Pool() as pool:
        for mount in first(("eye-in-hand", "eye-to-hand")):
            row = replace(WRONG_LINKS, robot="ur10e", mount=mount, views=60)
            found[mount] = pool.map(measured, [replace(row, seed=index) for index in range(worlds)])
    text = TEXT.format(worlds=worlds) + table(found)
    print(text)
    command = "PYTHONPATH=tests python tests/benchmarks/figaroh_peer.py"
    write_section("An arm calibrated from poses, against figaroh", command, text)


TEXT = """{worlds} worlds each: a UR10e with errors of 0.5 mm and 1 mrad in every parameter, 60
views, 5 MP, 0.1 px, a robot that repeats to 0.03 mm and 0.05 mrad. Both get the same joint angles
and the same measured poses of the board, whose lens and size are exact. The error is that of the
camera's position in the target's frame at postures all over the workspace. Times are processor
times of one thread, the least of three runs (one of `map_cv` and of `visioncal calibrate`).

figaroh 1.0.2: a `BaseCalibration` whose `cost_function` is `calc_updated_fkm`,
`_compute_logmap_residuals` (in the body) and `apply_measurement_weighting`, `full_params`, one
marker of six components, base and tip unknown; the time is that of `initialize` and `solve`. Its
world is the fixed one of camera and board, its marker the one on the flange. `structural`
has the weights of its UR10 example (1 for m, 0.5 for rad). `map` gets the true noise and the true
sizes of the arm's errors, like visioncal's fit; `map_cv` estimates the sizes by cross-validation,
visioncal's fit by restricted likelihood. `visioncal calibrate` has no counterpart in figaroh: it
also compares levels, detects wrong views, and gives the covariance, intervals, held-out errors, the
results of other solvers and a verdict.

"""

if __name__ == "__main__":
    need("figaroh", "-e .[bench]")
    main(wished(WORLDS))
