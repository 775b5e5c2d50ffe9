"""A plan of stops, or of motions, in words."""

from visioncal.core.number_format import counted, figure
from visioncal.dynamics.limits import MotionExtremes
from visioncal.dynamics.plan_files import MotionPlan
from visioncal.planning.plan import Plan


def summary_of(plan: Plan) -> str:
    """Summarises a plan in a sentence."""
    count, design = len(plan.stops), plan.design
    stops = counted(count, "stop")
    wanted = f"{plan.request.purpose.errors}, predicted sigma"
    if plan.start is None:
        accuracy = design.predicted.words
        return f"{stops} from {plan.candidate_count} possible ones; {wanted}: {accuracy}"
    return (
        f"{stops} to add, from {plan.candidate_count} possible ones; {wanted}: "
        f"{design.before.words} before, {design.predicted.words} after"
    )


def plan_words(plan: MotionPlan) -> tuple[str, ...]:
    """States the quality of a plan and what it uses of the limits, in sentences."""
    motion = plan.excitation
    words = [
        f"exciting motion of {motion.request.period_s:g} s: condition {motion.condition:.1f} for "
        f"{motion.base.rank} base parameters (random motions: {motion.random:.0f})",
        f"it uses {_used(motion.extremes)}",
    ]
    if plan.sweeps is not None:
        speeds = [stroke.speed for stroke in plan.sweeps.strokes if stroke.sweeps]
        joints = len({stroke.joint for stroke in plan.sweeps.strokes})
        words += [
            f"sweeps of {joints} joints, one at a time, there and back at "
            f"{len(speeds) // (2 * joints)} speeds from {figure(min(speeds))} to "
            f"{figure(max(speeds))} rad/s: {plan.sweeps.begins_s[-1]:.0f} s",
            f"they use {_used(plan.sweeps.extremes)}",
        ]
    return tuple(words)


def _used(kept: MotionExtremes) -> str:
    shares = kept.shares
    parts = [f"{100.0 * max(values):.0f} % of the {name}" for name, values in shares.items()]
    near = ""
    if kept.nearest:
        near = f"; {' and '.join(kept.nearest)} come to {1e3 * kept.clearance_m:.0f} mm"
    return f"at most {', '.join(parts)} allowed{near}"
