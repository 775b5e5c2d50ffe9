"""Files of a calibrated arm: URDF, joint table, UR's kinematics, chain, joint corrections.

An arm with identified dynamics is written as a URDF, or as a chain for a session.
"""

import numpy as np

from visioncal.core.errors import DataError
from visioncal.core.files import json_text
from visioncal.core.transforms import log
from visioncal.dynamics import ArmDynamics, Identified
from visioncal.interchange.exports.arm import ArmContent, ArmFormat, joint_function_error_mm
from visioncal.interchange.exports.content import Selection
from visioncal.robot import (
    corrected_tip,
    corrected_urdf,
    small_urdf,
    table_toml,
    ur_flange,
    ur_kinematics_yaml,
    urdf_with_inertias,
    with_inertias,
    without_functions,
)

# A longer offset along an axis is an artefact of nearly parallel axes, whose common normal is far
# away [m].
_FAR_M = 10.0
# Tolerance of the flange's pose, below which no note is needed [mm, deg].
_TOLERANCE = 1e-4
# Range of corrections for joints without limits [deg].
_WIDEST_DEG = 360.0
# Placeholder for an unknown hash, which no controller has.
_NO_HASH = "calib_visioncal"


def _write_urdf(content: ArmContent) -> str:
    if "urdf" in content.nominal.document:
        robot = without_functions(content.written)
        return corrected_urdf(content.nominal, robot, content.all_notes)
    return small_urdf(without_functions(content.written), content.all_notes)


def _warn_urdf(content: ArmContent) -> tuple[str, ...]:
    warnings = content.left_out_warnings
    if "urdf" not in content.nominal.document:
        return warnings
    tip = corrected_tip(content.nominal, content.written)
    if tip != content.robot.tip:
        warnings += (
            f"no fixed joint places {content.robot.tip}, so that the calibrated one is a link of "
            f"its own in the file: {tip}. Poses are of that.",
        )
    return warnings


def _warn_dh(content: ArmContent) -> tuple[str, ...]:
    table = content.table
    far = int(np.argmax(np.abs(table.d_m)))
    if abs(table.d_m[far]) < _FAR_M:
        return content.left_out_warnings
    return (
        *content.left_out_warnings,
        f"d_m of {table.joint_names[far]} is {table.d_m[far]:.0f} m: its axis and a neighbour are "
        f"nearly parallel, and the {table.convention} convention goes to their common normal. "
        "--convention hayati does not.",
    )


def _write_ur(content: ArmContent) -> str:
    return ur_kinematics_yaml(
        without_functions(content.written),
        calibration_hash=content.calibration_hash or _NO_HASH,
        like=content.nominal_table,
        notes=content.all_notes,
    )


def _warn_ur(content: ArmContent) -> tuple[str, ...]:
    warnings = content.left_out_warnings
    difference = log(ur_flange(content.written, content.nominal_table))
    turned, moved = (
        np.rad2deg(np.linalg.norm(difference[:3])),
        1e3 * np.linalg.norm(difference[3:]),
    )
    if max(turned, moved) > _TOLERANCE:
        warnings += (
            f"the flange lies {moved:.2g} mm and {turned:.2g} deg from wrist_3, which has no field "
            "for that: a comment in the file has its pose. What sits on the flange goes behind it.",
        )
    if content.calibration_hash is None:
        warnings += (
            f"its hash is {_NO_HASH!r}, which no controller has: the driver will report that the "
            "calibration does not match, and go on. Give the one that ur_calibration extracts with "
            "--hash.",
        )
    return warnings


def _write_corrections(content: ArmContent) -> str:
    """A table of corrections: a line for each joint and degree."""
    robot = content.written
    lines = [f"# {note}" for note in content.notes]
    lines.append("joint,angle_deg,correction_deg,sigma_deg")
    limits = np.rad2deg([robot.lower_rad, robot.upper_rad]).clip(-_WIDEST_DEG, _WIDEST_DEG)
    for at, joint in enumerate(robot.joint_names):
        if robot.chain.prismatic[at]:
            continue
        # One turn, or the joint's range if its gear ratio is not 1.
        degrees = np.arange(-180, 180)
        if robot.chain.functions[at, 1] != 1.0:
            low, high = limits[:, at]
            degrees = np.arange(int(np.floor(low)), int(np.ceil(high)) + 1)
        angles = np.repeat(np.deg2rad(degrees)[:, None], robot.joint_count, axis=1)
        # The joint with its links alone: with its offset, and a ratio of 1.
        sent = robot.chain.encoded(robot.chain.functions[:, 0] + angles)
        corrections = np.rad2deg(sent - angles)[:, at]
        sigmas = [""] * len(degrees)
        if content.functions is not None:
            nodes_deg = np.rad2deg(1e-3 * np.array(content.functions.joints[at].sigma_mrad))
            nodes = np.linspace(-180.0, 180.0, len(nodes_deg), endpoint=False)
            interpolated = np.interp(degrees, nodes, nodes_deg, period=360.0)
            sigmas = [f"{value:.6f}" for value in interpolated.tolist()]
        rows = zip(degrees.tolist(), corrections.tolist(), sigmas, strict=True)
        lines += [f"{joint},{angle},{correction:.6f},{sigma}" for angle, correction, sigma in rows]
    return "\n".join([*lines, ""])


def _warn_corrections(content: ArmContent) -> tuple[str, ...]:
    return (
        "It corrects what joints err by as functions of their angles, for the links and offsets "
        "that --to robot-urdf, robot-dh or ur-kinematics writes --with-corrections: send each "
        "joint to its angle and the correction there. Without it the flange of that arm is off by "
        f"up to {joint_function_error_mm(content.written):.2g} mm{content.bending_error_words}.",
        *(f"{name}." for name in content.omitted),
    )


ROBOT_URDF = ArmFormat(
    "robot-urdf",
    "the calibrated arm as a URDF: the session's own with other origins, or a small one [m, rad]",
    _write_urdf,
    takes=frozenset({"with-corrections"}),
    warn=_warn_urdf,
    holds="links",
)
ROBOT_DH = ArmFormat(
    "robot-dh",
    "the calibrated arm as a DH table (.toml), --convention standard, modified or hayati [m, rad]",
    lambda content: table_toml(content.table, "visioncal", content.all_notes),
    takes=frozenset({"convention", "with-corrections"}),
    warn=_warn_dh,
    holds="links",
)
UR_KINEMATICS = ArmFormat(
    "ur-kinematics",
    "the calibrated UR as ur_description's kinematics_params_file (YAML), --hash its hash [m, rad]",
    _write_ur,
    takes=frozenset({"hash", "with-corrections"}),
    warn=_warn_ur,
    holds="links",
)
ROBOT_JSON = ArmFormat(
    "robot-json",
    "the calibrated arm with all that was found: 4x4 placements, axes, joints' functions [m, rad]",
    lambda content: json_text({**content.robot.document, "source": "; ".join(content.notes)}),
)

JOINT_CORRECTIONS = ArmFormat(
    "joint-corrections",
    "what to add to each joint's angle, degree by degree, for encoders that err (CSV) [deg]",
    _write_corrections,
    warn=_warn_corrections,
    holds="functions",
)

ARMS = (ROBOT_URDF, ROBOT_DH, UR_KINEMATICS, ROBOT_JSON, JOINT_CORRECTIONS)


def write_dynamics(identified: Identified, to: str, selection: Selection) -> str:
    """Writes an arm with the identified inertias of its links.

    Args:
        identified: The result.
        to: `robot-urdf`: its own URDF, or a small one; `robot-json`: a chain, which a session may
            name as its robot.
        selection: The user's selection, which must be empty.

    Returns:
        The text.

    Raises:
        DataError: The format holds no inertias, an option does not apply to it, or no inertias were
            identified.
    """
    by_name = {form.name: form for form in (ROBOT_URDF, ROBOT_JSON)}
    if to not in by_name:
        raise DataError(
            f"Identified dynamics are inertias of an arm's links, which {to} does not hold; "
            f"{' and '.join(by_name)} do.",
            culprits=[to],
            next_step=f"visioncal export DYNAMICS --to {ROBOT_URDF.name}",
        )
    by_name[to].check(selection)
    arm = ArmDynamics.of(identified)
    session = identified.facts["session"]["name"]
    notes = [f"dynamics identified by visioncal from {session!r}, {identified.facts['created']}"]
    if to == ROBOT_JSON.name:
        document = with_inertias(arm.robot.corrected(), arm.inertias).document
        return json_text({**document, "source": notes[0]})
    if "urdf" in arm.robot.document:
        return urdf_with_inertias(arm.robot, arm.inertias, notes)
    return small_urdf(arm.weighed(), notes)
