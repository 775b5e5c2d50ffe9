"""A plan of motions in words."""

from visioncal.core.files import some_of
from visioncal.core.number_format import figure
from visioncal.dynamics.limit_check import Kept
from visioncal.dynamics.planned import MotionPlan
from visioncal.dynamics.sweeps import Sweeps


def plan_words(plan: MotionPlan) -> tuple[str, ...]:
    """The quality of a plan and what it uses, in sentences."""
    found = plan.excitation
    condition, random = found.condition, found.random
    words = [
        f"exciting motion of {found.request.period_s:g} s: condition {condition.weighted:.1f} for "
        f"{found.base.rank} base parameters (random motions: {random.weighted:.0f})",
        "joints weighted by their greatest torques, columns of unit length; unweighted "
        f"{condition.scaled:.1f} (random: {random.scaled:.0f}), raw {condition.raw:.0f} (random: "
        f"{random.raw:.0f})",
        f"it uses {_used(found.kept)}",
    ]
    if plan.sweeps is not None:
        words += [_sweeps(plan.sweeps), f"they use {_used(plan.sweeps.kept)}"]
    return tuple(words)


def plan_warnings(plan: MotionPlan) -> tuple[str, ...]:
    """What the reader must know before the plan is driven."""
    found = [f"not checked: {it}" for it in plan.allowed.unchecked]
    if plan.sweeps is not None and plan.sweeps.left_out:
        found.append(f"too little room to sweep {some_of(plan.sweeps.left_out)}")
    return tuple(found)


def _used(kept: Kept) -> str:
    shares = kept.shares
    parts = [f"{100.0 * max(values):.0f} % of the {name}" for name, values in shares.items()]
    near = ""
    if kept.nearest:
        near = f"; {' and '.join(kept.nearest)} come to {1e3 * kept.clearance_m:.0f} mm"
    return f"at most {', '.join(parts)} allowed{near}"


def _sweeps(sweeps: Sweeps) -> str:
    speeds = [it.speed for it in sweeps.strokes if it.sweeps]
    joints = len({it.joint for it in sweeps.strokes})
    return (
        f"sweeps of {joints} joints, one at a time, there and back at "
        f"{len(speeds) // (2 * joints)} speeds from {figure(min(speeds))} to "
        f"{figure(max(speeds))} rad/s: {sweeps.begins_s[-1]:.0f} s"
    )
