"""Time of the joint fit of 60 images x 80 corners, against pyceres with a Python cost.

The same problem for both: both edges and one error of the flange a view, lens and noise known, from
the same start. pyceres is no part of the development environment: `pip install pyceres`.

    PYTHONPATH=tests python tests/benchmarks/joint_speed.py
"""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from results import few, need, write_section

from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import adjoint, exp, inverse_right_jacobian, invert, log
from visioncal.core.types import FloatArray
from visioncal.estimation.chain import chain
from visioncal.estimation.corners import CornerStack, reproject
from visioncal.estimation.linalg import covariance_from
from visioncal.estimation.poses import fit_poses
from visioncal.estimation.problem_parts import Noise, State
from visioncal.estimation.solve import solve_problem
from visioncal.simulation import BOARDS, CellOptions, SimulatedCell, fine_camera, simulate
from visioncal.vision.targets import corner_positions

need("pyceres", "pyceres")
import pyceres  # noqa: E402

PIXEL_PX, NOISE = 0.1, Noise.of_robot(5e-5, 3e-5)
REPEATS = few(15, 1)


def cell_of(seed: int) -> SimulatedCell:
    target = replace(BOARDS["charuco"], columns=11, rows=9, square_m=0.025, marker_m=0.018)
    return simulate(
        CellOptions(
            views=60,
            camera=fine_camera(),
            pixel_sigma_px=PIXEL_PX,
            target=replace(target, name="charuco_11x9_25mm", square_sigma_m=2.5e-5),
            cut_views=0.0,
            seed=seed,
        )
    )


class ViewCost(pyceres.CostFunction):
    """One view's corners: 2 n residuals by x, z and the flange's error, all as right steps."""

    def __init__(
        self, stack: CornerStack, cell: SimulatedCell, robot: FloatArray, start: State
    ) -> None:
        pyceres.CostFunction.__init__(self)
        self.stack, self.camera, self.robot, self.start = stack, cell.options.camera, robot, start
        self.set_num_residuals(2 * len(stack.px))
        self.set_parameter_block_sizes([6, 6, 6])

    def Evaluate(self, parameters, residuals, jacobians) -> bool:  # noqa: N802 - its interface
        """Fills in residuals and derivatives, as Ceres asks for them."""
        steps = np.array(parameters)
        by_x, by_z, flange_jacobian = exp(steps)
        from_x, z = self.start.edges @ [by_x, by_z]
        pose = invert(self.robot @ flange_jacobian @ from_x) @ z
        at = reproject(self.stack, self.camera, pose[None], lens=False)
        residuals[:] = at.residuals.ravel() / PIXEL_PX
        if jacobians is not None:
            slope = at.by_pose.reshape(-1, 6) / PIXEL_PX
            target_from_cam = adjoint(invert(pose))
            moves = (
                -slope @ target_from_cam,
                slope,
                -slope @ target_from_cam @ adjoint(invert(from_x)),
            )
            for jacobian, move, step in zip(jacobians, moves, steps, strict=True):
                if jacobian is not None:
                    jacobian[:] = (move @ np.linalg.inv(inverse_right_jacobian(step))).ravel()
        return True


def by_pyceres(cell: SimulatedCell, stacks: list[CornerStack], start: State) -> State:
    problem = pyceres.Problem()
    x, z = np.zeros(6), np.zeros(6)
    flanges = [np.zeros(6) for _ in stacks]
    covariance = np.diag(np.repeat(NOISE.robots[0] ** 2, 3))
    for stack, robot, flange in zip(stacks, cell.robot.base_from_flange, flanges, strict=True):
        problem.add_residual_block(ViewCost(stack, cell, robot, start), None, [x, z, flange])
        prior = pyceres.factors.NormalPrior(np.zeros(6), covariance)
        problem.add_residual_block(prior, None, [flange])
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR
    options.minimizer_progress_to_stdout = False
    options.num_threads = 1
    pyceres.solve(options, problem, pyceres.SolverSummary())
    return start.moved(np.concatenate([x, z]))


def by_visioncal(cell: SimulatedCell, stack: CornerStack, start: State) -> State:
    with one_blas_thread():
        x, z = start.edges
        predicted = invert(cell.robot.base_from_flange @ x) @ z
        fit = fit_poses(stack, cell.options.camera, predicted)
        covariance = PIXEL_PX**2 * covariance_from(fit.information)
        problem = chain("eye-in-hand", cell.robot.base_from_flange, fit.cam_from_target, covariance)
        return solve_problem(problem, start, NOISE)[0]


def seconds(solve: Callable[[], State]) -> float:
    begun = time.perf_counter()
    solve()
    return time.perf_counter() - begun


def main() -> None:
    """Prints the table and keeps it."""
    rows = []
    for seed in range(few(3, 1)):
        cell = cell_of(seed)
        positions = corner_positions(cell.options.target)
        stack = CornerStack.of(
            {view_corners.view: view_corners for view_corners in cell.corners}, positions
        )
        stacks = [
            CornerStack.of({view_corners.view: view_corners}, positions)
            for view_corners in cell.corners
        ]
        rng = np.random.default_rng(seed)
        start = State(np.stack([*cell.transforms.values()]), np.zeros(0))
        start = start.moved(2e-3 * rng.standard_normal(12))
        ours, theirs = by_visioncal(cell, stack, start), by_pyceres(cell, stacks, start)
        apart = np.linalg.norm(log(invert(theirs.edges[0]) @ ours.edges[0])[3:])
        times = np.array(
            [
                (
                    seconds(lambda: by_visioncal(cell, stack, start)),  # noqa: B023 - called at once
                    seconds(lambda: by_pyceres(cell, stacks, start)),  # noqa: B023
                )
                for _ in range(REPEATS)
            ]
        )
        mine, peer = 1e3 * np.median(times, axis=0)
        rows.append(
            f"| {len(stack.px)} | {mine:.1f} | {peer:.0f} | {peer / mine:.0f} | {1e6 * apart:.2f} |"
        )
    text = "\n".join(
        (
            f"Median of {REPEATS} interleaved solves, one thread each; three cells.\n",
            "| corners | visioncal [ms] | pyceres [ms] | times faster | answers apart [um] |",
            "| --- | --- | --- | --- | --- |",
            *rows,
        )
    )
    print(text)
    command = "PYTHONPATH=tests python tests/benchmarks/joint_speed.py"
    write_section("Speed of the joint fit", command, text)


if __name__ == "__main__":
    main()
