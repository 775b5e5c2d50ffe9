"""Content of the preview of a plan of stops, or of motions."""

import numpy as np

from visioncal.dynamics.plan_files import MotionPlan
from visioncal.planning.messages import plan_words, summary_of
from visioncal.planning.plan import Plan
from visioncal.present.recording.preview import MotionPreview, Preview, PreviewStop


def preview_of(plan: Plan, name: str) -> Preview:
    """Builds the preview of a plan under a name."""
    cell = plan.cell
    lines = [f"# {len(plan.stops)} stops for {plan.request.purpose.name}", name, ""]
    lines.append(f"{summary_of(plan)}.")
    if plan.need is not None and plan.need.limits:
        lines += ["", f"**{plan.need.limits}**"]
    if plan.start is not None and plan.start.refusal:
        lines += ["", f"So far: {plan.start.refusal}"]
    lines += [
        "",
        "The most informative first, each with what is predicted of it and all above it. Views are "
        "numbered as the arm drives to them.",
        "",
    ]
    ranked = sorted(plan.stops, key=lambda stop: stop.rank)
    lines += [f"- **view {stop.view}** ({stop.after.words}): {stop.words}" for stop in ranked]
    stops = []
    for stop in plan.stops:
        degrees = ", ".join(f"{value:.1f}" for value in np.rad2deg(stop.q))
        x, y, z = 1e3 * stop.base_from_flange[:3, 3]
        distance = 1e3 * float(np.linalg.norm(stop.cam_from_target[:3, 3]))
        note = (
            f"**View {stop.view}** (number {stop.rank} by information): {stop.words}\n\n"
            f"Joints ({degrees}) deg; flange at ({x:.0f}, {y:.0f}, {z:.0f}) mm; board's origin at "
            f"{distance:.0f} mm from the camera. The whole board is in the image in "
            f"{100 * stop.seen:.0f} % of what the cell may be."
        )
        stops.append(PreviewStop(stop.view, stop.q, stop.via, note))
    return Preview(
        cell.mount,
        cell.target,
        cell.camera,
        cell.x,
        cell.z,
        name,
        cell.robot,
        tuple(stops),
        tuple(box.body for box in cell.boxes),
        cell.limits.floor_m,
        "\n".join(lines),
    )


def motion_preview(plan: MotionPlan) -> MotionPreview:
    """Builds the preview of a plan of motions."""
    allowed, excitation = plan.allowed, plan.excitation
    # Drawn samples a second: sweeps are long, and slow.
    motions = {"excitation": excitation.series.sampled(20.0)}
    if plan.sweeps is not None:
        motions["sweeps"] = plan.sweeps.sampled(5.0)
    boxes = [
        body
        for body in allowed.bodies
        if body.link == 0 and body.shape == "box" and not body.of_arm
    ]
    name = f"motions for {allowed.robot.name}"
    note = "\n\n".join([f"# {name}", *(f"- {word}" for word in plan_words(plan))])
    return MotionPreview(name, allowed.robot, motions, boxes, allowed.share.floor_m, note)
