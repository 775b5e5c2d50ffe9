"""An arm whose dynamics were identified, as a file: its URDF, or a chain for a session."""

import json

from visioncal.core.errors import DataError
from visioncal.dynamics import ArmDynamics, Identified
from visioncal.interchange.exports.arm import ArmFormat, check_said
from visioncal.interchange.exports.armfiles import ROBOT_JSON, ROBOT_URDF
from visioncal.interchange.exports.content import Selection
from visioncal.robot import small_urdf, weighed_urdf, with_inertias

# What holds inertias.
_FORMATS = (ROBOT_URDF, ROBOT_JSON)


def write_dynamics(identified: Identified, to: str, selection: Selection) -> str:
    """Writes an arm with the inertias of its links that were identified, as bodies.

    Args:
        identified: The result.
        to: `robot-urdf`: the URDF that it was described by, or a small one; `robot-json`: a chain,
            which a session may name as its robot.
        selection: What is asked for beside; there is nothing to choose.

    Returns:
        The text.

    Raises:
        DataError: The format holds no inertias, something was said for which it has no use, or no
            inertias were identified.
    """
    form = _find(to)
    check_said(selection, form)
    arm = ArmDynamics.of(identified)
    session = identified.facts["session"]["name"]
    notes = [f"dynamics identified by visioncal from {session!r}, {identified.facts['created']}"]
    if form is ROBOT_JSON:
        document = with_inertias(arm.robot.corrected(), arm.inertias).document
        text = json.dumps({**document, "source": notes[0]}, indent=2, allow_nan=False)
        return f"{text}\n"
    if "urdf" in arm.robot.document:
        return weighed_urdf(arm.robot, arm.inertias, notes)
    return small_urdf(arm.weighed(), notes)


def _find(name: str) -> ArmFormat:
    known = {it.name: it for it in _FORMATS}
    if name in known:
        return known[name]
    raise DataError(
        f"Identified dynamics are inertias of an arm's links, which {name} does not hold; "
        f"{' and '.join(known)} do.",
        culprits=[name],
        next_step=f"visioncal export DYNAMICS --to {ROBOT_URDF.name}",
    )
