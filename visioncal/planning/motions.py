"""A plan of motions as it is told and drawn."""

from visioncal.dynamics.kept import Kept
from visioncal.dynamics.motion import Motion
from visioncal.dynamics.planned import MotionPlan
from visioncal.dynamics.sweeps import Sweeps
from visioncal.files import some_of
from visioncal.recording.motions import MotionPart, MotionPreview
from visioncal.recording.obstacles import Obstacle

# Samples a second that are drawn: sweeps are long, and slow.
_EXCITATION_HZ, _SWEEPS_HZ = 20.0, 5.0


def motion_preview(plan: MotionPlan) -> MotionPreview:
    """What is drawn of a plan."""
    allowed, excitation = plan.allowed, plan.excitation
    parts = [_part(plan, "excitation", excitation.series.sampled(_EXCITATION_HZ))]
    if plan.sweeps is not None:
        parts.append(_part(plan, "sweeps", plan.sweeps.sampled(_SWEEPS_HZ)))
    boxes = [
        Obstacle(it.name, it.link_from_body, it.size_m)
        for it in allowed.bodies
        if it.link == 0 and it.shape == "box" and not it.of_arm
    ]
    name = f"motions for {allowed.robot.name}"
    note = "\n\n".join([f"# {name}", *(f"- {it}" for it in plan_words(plan))])
    return MotionPreview(name, allowed.robot, parts, boxes, allowed.share.floor_m, note)


def _part(plan: MotionPlan, name: str, motion: Motion) -> MotionPart:
    return MotionPart(name, motion, plan.allowed.torques(motion))


def plan_words(plan: MotionPlan) -> tuple[str, ...]:
    """What a plan is worth and what it uses, in sentences."""
    found = plan.excitation
    condition, random = found.condition, found.random
    told = [
        f"exciting motion of {found.request.period_s:g} s: condition {condition.weighted:.1f} for "
        f"{found.base.rank} base parameters (random motions: {random.weighted:.0f})",
        "joints weighted by their greatest torques, columns of unit length; unweighted "
        f"{condition.scaled:.1f} (random: {random.scaled:.0f}), raw {condition.raw:.0f} (random: "
        f"{random.raw:.0f})",
        f"it uses {_used(found.kept)}",
    ]
    if plan.sweeps is not None:
        told += [_sweeps(plan.sweeps), f"they use {_used(plan.sweeps.kept)}"]
    return tuple(told)


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
        f"{len(speeds) // (2 * joints)} speeds from {min(speeds):.2g} to {max(speeds):.2g} rad/s: "
        f"{sweeps.begins_s[-1]:.0f} s"
    )
