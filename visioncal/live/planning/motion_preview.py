"""What is drawn of planned motions."""

from visioncal.dynamics.motion import Motion
from visioncal.dynamics.planned import MotionPlan
from visioncal.live.planning.motions import plan_words
from visioncal.present.recording.motions import MotionPart, MotionPreview
from visioncal.present.recording.obstacles import Obstacle

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
