"""What a later look at the same cell has to know of the joint fit."""

import numpy as np

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.estimation.arm import misfit_jacobian
from visioncal.estimation.armmodel import HARMONICS
from visioncal.results.sections import FittedArm, JointFit
from visioncal.session import frame_name
from visioncal.vision.targets import target_document

# Columns of views.csv that say under which conditions a view was taken.
CONDITIONS = ("ambient_c", "payload_kg")


def joint_fit_of(known: RunState) -> JointFit | None:
    """All unknowns of the fit with their covariance; None where an instrument read them.

    The unknowns are, in this order: both edges of the chain, lens and board as far as something is
    open about them, where further boards lie from the first, and the arm's errors. The uncertainty
    of clocks and of drift with temperature counts in their covariance.
    """
    if known.mount == "instrument":
        return None
    boards, seen = known.session.boards, known.fitted.seen
    placed = known.solved.problem.unknown
    names = [it for it in boards if len(boards) < 2 or frame_name("target", it) in placed]
    return JointFit(
        targets={name: target_document(it) for name, it in boards.items()},
        boards=tuple(names) or ("",),
        looks=() if seen is None else tuple(seen.free.tolist()),
        arm=_arm(known),
        covariance=_covariance(known),
    )


def conditions_of(known: RunState) -> dict[str, float]:
    """The mean conditions of the used views; those that a used view does not say are left out."""
    views = [it for it in known.session.views if it.number in known.used]
    return {
        name: float(np.mean([it.numbers[name] for it in views]))
        for name in CONDITIONS
        if views and all(name in it.numbers for it in views)
    }


def _arm(known: RunState) -> FittedArm | None:
    """The arm's errors: of what they are, and their estimates beside the stated arm."""
    arm = known.robot_arm
    model, errors = arm.model, arm.errors
    if errors is None or not errors.of_links:
        return None
    count = errors.basis.shape[2]
    # Errors that only count are where they were stated; those of a model are in its arm already.
    problem, name = known.solved.problem, f"arm of {arm.robot}"
    linearised = problem.start({it: np.eye(4) for it in problem.unknown})
    values = problem.values_of(name, known.solved.state) - problem.values_of(name, linearised)
    values = values if errors.is_estimated else np.zeros(count)
    if model is None:
        return FittedArm(of="links", values=values)
    # What of its errors is not in its geometry goes by the loads of a stop.
    loaded = bool(model.values_by_stop.any())
    # Functions of the joints are in the arm's geometry, as well as they are known.
    kept = model.is_kept
    functions = model.functions if loaded else None
    return FittedArm(
        of="model",
        values=values[kept],
        weights={it: size for it, size in model.weights.items() if it != HARMONICS},
        flange_from_reported=model.flange_from_reported,
        by_stop=model.values_by_stop[kept] if loaded else None,
        torque_nm=model.torque_nm if loaded else None,
        yielding=model.yielding if loaded else None,
        weight_functions=None if functions is None else functions.parts,
    )


def _covariance(known: RunState) -> FloatArray:
    """The fit's own, and beside it what it has in common with errors that only count in it."""
    answer, arm, written = known.solved, known.robot_arm, _written(known)
    own = written @ answer.covariance @ written.T
    if arm.errors is None or arm.errors.is_estimated or not arm.errors.of_links:
        return own
    jacobian = written @ misfit_jacobian(
        answer.problem, answer.state, answer.noise, arm.robot, arm.errors
    )
    size, variance = jacobian.shape[1], arm.errors.sigma**2
    # The fit is off by its slopes times the errors; the truth is off from the fit the other way.
    between = -variance * jacobian
    return np.block([[own, between], [between.T, variance * np.eye(size)]])


def _written(known: RunState) -> FloatArray:
    """(w, p) how what is written moves with the fit's unknowns."""
    # Further boards are written relative to the first; clocks and drift are left out.
    problem, rows = known.solved.problem, np.eye(known.solved.problem.size)
    placed = known.solved.state.edges[1:]
    # z_k exp(d_k) = z exp(d) exp(-d_u) target_1_from_target_k
    further = [
        rows[6:12] - adjoint(invert(placed[0]) @ placed[at]) @ rows[6 * at + 6 : 6 * at + 12]
        for at in range(1, len(placed))
    ]
    nothing, arm = slice(0, 0), f"arm of {known.robot_arm.robot}"
    errors, seen = problem.effect_columns.get(arm, nothing), known.fitted.seen
    looks = known.fitted.columns_of(np.zeros(0, dtype=np.int64) if seen is None else seen.free)
    of_errors, model = rows[errors], known.robot_arm.model
    kept = slice(None) if model is None else model.is_kept
    return np.concatenate([rows[:12], rows[looks], *further, of_errors[kept]])
