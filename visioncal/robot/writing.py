"""A robot's geometry as files: joint tables, small URDFs, UR's kinematics; links alone."""

import re
from collections.abc import Sequence
from dataclasses import replace
from xml.sax.saxutils import quoteattr

import numpy as np
import tomli_w

from visioncal.core.conventions import POSE_FORMS, write_pose
from visioncal.core.errors import DataError
from visioncal.core.files import one_line
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray
from visioncal.robot.chain import FUNCTION_NAMES, IDENTITY_FUNCTION, chain_document
from visioncal.robot.conversion import parallel_axes, table_of
from visioncal.robot.model import Robot
from visioncal.robot.tables import DHTable, table_document

# The links of ur_description in its file of kinematics, in order.
_UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_UR_FIELDS = ("x", "y", "z", "roll", "pitch", "yaw")
# Which consecutive axes of a UR are parallel: those of shoulder, elbow and first wrist.
_UR_PARALLEL = (False, True, True, False, False)
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])

# A radian counts as what carries its tip so far away [m].
_LEVER_M = 0.3
# Links move with the square of a thousandth; the second step is off by less than a micrometre.
_STEPS = 4
# Twists of links that no joint tells from offsets, or hardly moves the tip by, stay.
_DETERMINED = 1e-6


def table_toml(table: DHTable, source: str, notes: Sequence[str] = ()) -> str:
    """Writes a joint table as a `.toml` that `load_robot` reads.

    Args:
        table: The table.
        source: Where its values come from.
        notes: Lines for a comment at its head.
    """
    head = "".join(f"# {one_line(note)}\n" for note in notes)
    return head + tomli_w.dumps(table_document(table, source))


def numbers_text(pose: FloatArray) -> tuple[list[str], list[str]]:
    """Writes a (4, 4) pose [m] as xyz and rpy, each number so that it reads back the same."""
    # A negative zero would only raise questions.
    numbers = [repr(value) for value in (write_pose(pose, POSE_FORMS["rpy"]) + 0.0).tolist()]
    return numbers[:3], numbers[3:]


def unwritten(robot: Robot) -> tuple[str, ...]:
    """What a corrected robot has that neither a URDF nor a table of others can hold, in words."""
    said, harmonics = [], robot.chain.harmonics
    for at, (joint, function) in enumerate(
        zip(robot.joint_names, robot.chain.functions, strict=True)
    ):
        parts = [
            f"{name} {value:.9g}"
            for name, value, none in zip(FUNCTION_NAMES, function, IDENTITY_FUNCTION, strict=True)
            if name != "offset" and value != none
        ]
        if harmonics is not None and harmonics[at].any():
            rms_mrad = 1e3 * float(np.sqrt(np.sum(harmonics[at] ** 2) / 2))
            parts.append(f"harmonics from order 2 on of {rms_mrad:.2g} mrad rms")
        said += [f"{joint}: {', '.join(parts)}"] if parts else []
    return tuple(said)


def small_urdf(robot: Robot, notes: Sequence[str] = ()) -> str:
    """Writes a URDF of bare links: the joints with their axes and limits, and the tip.

    Links have their inertias where the robot states them. Joint offsets go into the origins. A URDF
    has no place for gear ratio, eccentricity and harmonics; a comment says which are missing.
    """
    chain = robot.chain.with_offsets_placed()
    links = ["base", *(f"link_{place}" for place in range(1, len(chain) + 1))]
    lines = [
        '<?xml version="1.0"?>',
        f"<robot name={quoteattr(robot.name)}>",
        *comment_lines(robot, notes),
    ]
    lines.append(f"  <link name={quoteattr(links[0])}/>")
    for link, inertial in zip(links[1:], _inertials(robot), strict=True):
        lines += [f"  <link name={quoteattr(link)}>", *inertial, "  </link>"]
    lines.append(f"  <link name={quoteattr(robot.tip)}/>")
    rates = np.column_stack([robot.torque_nm, robot.velocity_rad_s])
    # A URDF needs both; zero stands for what is not known.
    rates = np.where(np.isfinite(rates), rates, 0.0)
    for place, joint in enumerate(chain.joint_names):
        limits = (chain.lower[place], chain.upper[place])
        bounded = bool(np.isfinite(limits).all())
        turning = "revolute" if bounded else "continuous"
        kind = "prismatic" if chain.prismatic[place] else turning
        lines.append(f'  <joint name={quoteattr(joint)} type="{kind}">')
        lines += _joint_lines(links[place], links[place + 1], chain.placements[place])
        axis = " ".join(repr(axis) for axis in chain.axes[place].tolist())
        lines.append(f'    <axis xyz="{axis}"/>')
        if bounded:
            lower, upper = map(float, limits)
            effort, velocity = rates[place].tolist()
            lines.append(
                f'    <limit lower="{lower!r}" upper="{upper!r}" effort="{effort:g}" '
                f'velocity="{velocity!r}"/>'
            )
        lines.append("  </joint>")
    lines.append(f'  <joint name={quoteattr(f"{links[-1]}-{robot.tip}")} type="fixed">')
    lines += _joint_lines(links[-1], robot.tip, chain.placements[-1])
    return "\n".join([*lines, "  </joint>", "</robot>", ""])


def inertial_lines(kg: float, centre_m: FloatArray, about: FloatArray) -> list[str]:
    """Writes a body in its link's frame: mass, centre (3,), and inertia (3, 3) about the centre."""
    xyz = " ".join(repr(value) for value in (centre_m + 0.0).tolist())
    names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    numbers = about[np.triu_indices(3)].tolist()
    values = " ".join(f'{name}="{number!r}"' for name, number in zip(names, numbers, strict=True))
    return [
        "    <inertial>",
        f'      <origin xyz="{xyz}" rpy="0.0 0.0 0.0"/>',
        f'      <mass value="{kg!r}"/>',
        f"      <inertia {values}/>",
        "    </inertial>",
    ]


def _inertials(robot: Robot) -> list[list[str]]:
    """Each link's body as lines; none where the robot states no inertias."""
    if robot.inertias is None:
        return [[] for _ in robot.joint_names]
    masses = robot.inertias.masses
    bodies = zip(masses.kg.tolist(), masses.centres_m, robot.inertias.about_centres, strict=True)
    return [inertial_lines(*body) for body in bodies]


def comment_lines(robot: Robot, notes: Sequence[str] = ()) -> list[str]:
    """Lines of XML comments: the notes, and what is missing where something is."""
    missing = unwritten(robot)
    said = f"Not in this file, for URDF cannot say it: {'; '.join(missing)}"
    # XML ends a comment at two hyphens.
    texts = [
        re.sub("-(?=-)", "- ", one_line(note)) for note in (*notes, *([said] if missing else []))
    ]
    return [f"  <!-- {text} -->" for text in texts]


def _joint_lines(parent: str, child: str, placement: FloatArray) -> list[str]:
    xyz, rpy = numbers_text(placement)
    return [
        f"    <parent link={quoteattr(parent)}/>",
        f"    <child link={quoteattr(child)}/>",
        f'    <origin xyz="{" ".join(xyz)}" rpy="{" ".join(rpy)}"/>',
    ]


def ur_kinematics_yaml(
    robot: Robot,
    *,
    calibration_hash: str,
    like: DHTable | None = None,
    notes: Sequence[str] = (),
) -> str:
    """Writes the `kinematics` file that ur_description takes as `kinematics_params_file`.

    Each link's x, y, z [m] and roll, pitch, yaw [rad] place its joint in the link before it, the
    shoulder in base_link_inertia, which is the controller's base; joints turn about z. wrist_3 is
    the flange, tool0 (ur_description, urdf/ur_macro.xacro and config/ur*/default_kinematics.yaml).
    What `ur_flange` gives has no field there: a comment says it.

    Args:
        robot: The robot. Where its base is ROS's base_link, a half turn before base_link_inertia,
            that turn is left out.
        calibration_hash: The `hash` of the arm's own file, as ur_calibration extracts it; the
            driver compares it with the arm it is connected to and complains of another. It must be
            there: ur_description reads it (urdf/inc/ur_common.xacro).
        like: The nominal table, so that the links lie as they do there.
        notes: Lines for a comment at its head.

    Raises:
        DataError: The robot has not six revolute joints with a UR's parallel axes.
    """
    table = _ur_table(robot, like)
    placements = table.along_x[:-1] @ table.along_z
    placements[0] = table.base @ placements[0]
    missing = unwritten(robot)
    said = [f"Not in this file, which has no field for it: {'; '.join(missing)}"] if missing else []
    lines = [f"# {one_line(note)}" for note in (*notes, *said)]
    rest = table.along_x[-1] @ table.flange
    if np.abs(rest - np.eye(4)).max() > 0.0:
        xyz, rpy = numbers_text(rest)
        lines.append(f"# flange in wrist_3: xyz {' '.join(xyz)} rpy {' '.join(rpy)}")
    lines.append("kinematics:")
    for link, placement in zip(_UR_LINKS, placements, strict=True):
        xyz, rpy = numbers_text(placement)
        lines.append(f"  {link}:")
        lines += [f"    {key}: {name}" for key, name in zip(_UR_FIELDS, [*xyz, *rpy], strict=True)]
    return "\n".join([*lines, f"  hash: {calibration_hash}", ""])


def ur_flange(robot: Robot, like: DHTable | None = None) -> FloatArray:
    """(4, 4) the flange in the last link of `ur_kinematics_yaml`, which takes it for the flange.

    Raises:
        DataError: The robot is no UR.
    """
    table = _ur_table(robot, like)
    return np.asarray(table.along_x[-1] @ table.flange)


def _ur_table(robot: Robot, like: DHTable | None) -> DHTable:
    """The robot as Hayati's table in the controller's base."""
    six = robot.joint_count == len(_UR_LINKS) and not robot.chain.prismatic.any()
    if not six or tuple(parallel_axes(robot)) != _UR_PARALLEL:
        raise DataError(
            f"robot {robot.name}: ur_description's kinematics are of six revolute joints, the "
            f"second, third and fourth axis parallel, and {', '.join(robot.joint_names)} are not.",
            culprits=[robot.name],
            next_step="Write another robot as a URDF or a joint table.",
        )
    return table_of(_in_controllers_base(robot), "hayati", like=like)


def _in_controllers_base(robot: Robot) -> Robot:
    """A UR with the controller's base: at zero its arm points along -x there, along x in ROS's."""
    chain = robot.chain
    if robot.base_from_flange(np.zeros((1, len(chain))))[0, 0, 3] <= 0.0:
        return robot
    placements = np.array([_HALF_TURN @ chain.placements[0], *chain.placements[1:]])
    turned = replace(chain, placements=placements)
    return Robot.from_document(robot.weighted(chain_document(robot.name, robot.tip, turned)))


def without_functions(robot: Robot) -> Robot:
    """The arm without gear ratios, eccentricity and harmonics; the offsets stay."""
    functions = np.array(IDENTITY_FUNCTION) - robot.chain.functions
    functions[:, 0] = 0.0
    harmonics = robot.chain.harmonics
    return robot.corrected(functions=functions, harmonics=None if harmonics is None else -harmonics)


def fit_links(
    robot: Robot, q: FloatArray, base_from_flange: FloatArray, weights: FloatArray
) -> Robot:
    """Fits links and offsets of an arm to where a real one stands; its functions stay.

    Links are moved behind their joints, so that the base stays; see `Robot.placement_jacobian`.

    Args:
        robot: The arm, with the functions that a reader is to know.
        q: (m, n) postures [rad].
        base_from_flange: (m, 4, 4) where the real one stands there.
        weights: (m,) how much each counts.

    Returns:
        The arm that is off the least, in the mean of squares.
    """
    count, units = robot.joint_count, np.repeat([1.0, _LEVER_M], 3)
    row_weights = np.sqrt(weights)[:, None] * np.repeat([_LEVER_M, 1.0], 3)
    for _ in range(_STEPS):
        away = log(invert(robot.base_from_flange(q)) @ base_from_flange)
        links = robot.placement_jacobian(q)[:, :, 6:] * np.tile(units, count)
        offsets = robot.function_jacobian(q).reshape(len(q), 6, count, -1)[..., 0]
        columns = row_weights[:, :, None] * np.concatenate([offsets, links], axis=2)
        step = np.linalg.lstsq(
            columns.reshape(-1, 7 * count), (row_weights * away).ravel(), rcond=_DETERMINED
        )[0]
        functions, placements = np.zeros((count, 4)), np.zeros((count + 1, 6))
        functions[:, 0] = step[:count]
        placements[1:] = step[count:].reshape(count, 6) * units
        robot = robot.corrected(placements, functions)
    return robot
