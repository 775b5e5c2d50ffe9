"""What the joint fit found of board and lens, in sentences for the user."""

from collections.abc import Iterator

import numpy as np

from visioncal.estimator.joint import Arm, Problem, State, measured_scale


def findings(problem: Problem, arm: Arm, state: State) -> Iterator[str]:
    """Says what was found, and what the user can do about it."""
    yield from _scale_finding(problem, arm, state)
    yield from _bend_finding(problem, state)
    yield from _lens_finding(problem, state)


def _scale_finding(problem: Problem, arm: Arm, state: State) -> Iterator[str]:
    """Whether the robot measures another size of the squares than the file states."""
    measured = measured_scale(problem, arm, state)
    if not measured.is_another:
        return
    side = 1e3 * problem.scene.target.square_m
    prior = problem.prior_sigma[problem.scale[0]]
    yield (
        f"By the robot's motion the board is {100 * abs(measured.scale):.2g} % "
        f"{'larger' if measured.scale > 0 else 'smaller'} than stated (sigma "
        f"{100 * measured.sigma:.1g} %): squares of {side * (1 + measured.scale):.4g} mm, not of "
        f"{side:.4g} mm to within {100 * prior:.1g} %. Measure over many squares and mend square_m "
        "and square_sigma_m; if the board is right, the arm's model is off by as much."
    )


def _bend_finding(problem: Problem, state: State) -> Iterator[str]:
    if not np.isin(problem.shape, state.moving).all():
        return
    shift = state.seen.free.corners_after(state.fit.edges.shared) - problem.positions
    bend_mm = 1e3 * float(np.ptp(shift[:, 2]))
    yield (
        f"The board is not flat: its corners lie within {bend_mm:.2g} mm of depth. Its shape was "
        "estimated with the rest; a board on a stiff, flat plate makes a better result."
    )


def _lens_finding(problem: Problem, state: State) -> Iterator[str]:
    if problem.scene.mode == "refine" and not problem.has_spare_corners:
        yield (
            f'intrinsics = "refine" was not done: {len(problem.stack.px)} corners in '
            f"{len(problem.stack.views)} views leave too little to judge by. Show a board with "
            "more corners, or more views."
        )
    if problem.scene.estimated or not np.isin(problem.lens, state.moving).all():
        return
    stated = problem.scene.camera
    refined = state.seen.free.after(state.fit.edges.shared).camera
    moved = refined.matrix - stated.matrix
    yield (
        "The given intrinsics do not fit these images and were refined: fx, fy, cx, cy moved by "
        + ", ".join(f"{it:+.2g}" for it in moved)
        + ' px. Calibrate the camera anew, or hold them with intrinsics = "hold".'
    )
