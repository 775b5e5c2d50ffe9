"""Writing of robots as files: joint tables, URDFs, ur_description's kinematics."""

import re
from collections.abc import Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Comment, Element, SubElement, indent, tostring

import numpy as np
import tomli_w

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, write_pose
from visioncal.core.documents.structured import parse_xml
from visioncal.core.errors import DataError
from visioncal.core.files import one_line
from visioncal.core.transforms import compose, invert, log
from visioncal.core.types import FloatArray
from visioncal.robot.chain import FUNCTION_NAMES, IDENTITY_FUNCTION, chain_document
from visioncal.robot.conversion import has_ur_axes, table_of, with_base
from visioncal.robot.inertia import Inertias
from visioncal.robot.model import Robot
from visioncal.robot.tables import DHTable, row_frames, table_document, table_from_document

# Links and their fields in ur_description's kinematics file, in order.
_UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_UR_FIELDS = ("x", "y", "z", "roll", "pitch", "yaw")
_HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])

# Lever by which rotations are weighted against positions [m].
_LEVER_M = 0.3


def table_toml(table: DHTable, notes: Sequence[str]) -> str:
    """Writes a joint table, with origin and notes, as a `.toml` that `load_robot` reads."""
    head = "".join(f"# {one_line(note)}\n" for note in notes)
    return head + tomli_w.dumps(table_document(table, "visioncal"))


def numbers_text(pose: FloatArray) -> tuple[list[str], list[str]]:
    """Writes a (4, 4) pose [m] as xyz and rpy, with numbers that read back exactly."""
    # Adding 0.0 removes negative zeros.
    numbers = [repr(value) for value in (write_pose(pose, POSE_FORMS["rpy"]) + 0.0).tolist()]
    return numbers[:3], numbers[3:]


def unexportable_functions(robot: Robot) -> tuple[str, ...]:
    """Texts on joint functions of a corrected robot that other formats cannot hold."""
    texts, harmonics = [], robot.chain.harmonics
    for index, (joint, function) in enumerate(
        zip(robot.joint_names, robot.chain.functions, strict=True)
    ):
        parts = [
            f"{name} {value:.9g}"
            for name, value, none in zip(FUNCTION_NAMES, function, IDENTITY_FUNCTION, strict=True)
            if name != "offset" and value != none
        ]
        if harmonics is not None and harmonics[index].any():
            rms_mrad = 1e3 * float(np.sqrt(np.sum(harmonics[index] ** 2) / 2))
            parts.append(f"harmonics from order 2 on of {rms_mrad:.2g} mrad rms")
        texts += [f"{joint}: {', '.join(parts)}"] if parts else []
    return tuple(texts)


def small_urdf(robot: Robot, notes: Sequence[str] = ()) -> str:
    """Writes a URDF without shapes: joints with axes and limits, links with inertias, the tip.

    Joint offsets go into the origins. A URDF cannot hold gear ratio, eccentricity and harmonics; a
    comment lists those that are missing.
    """
    chain = robot.chain.with_offsets_placed()
    links = ["base", *(f"link_{index}" for index in range(1, len(chain) + 1)), robot.tip]
    root = Element("robot", name=robot.name)
    elements = [SubElement(root, "link", name=link) for link in links]
    if robot.inertias is not None:
        _add_inertials(elements[1:-1], robot.inertias)
    # A URDF needs both; zero means unknown.
    drives = np.stack([robot.rates.torque, robot.rates.velocity], axis=1)
    rates = np.nan_to_num(drives, posinf=0.0)
    for index, name in enumerate(chain.joint_names):
        limits = (chain.lower[index], chain.upper[index])
        bounded = bool(np.isfinite(limits).all())
        rotary = "revolute" if bounded else "continuous"
        kind = "prismatic" if chain.prismatic[index] else rotary
        joint = _joint(name, kind, links[index], links[index + 1], chain.placements[index])
        SubElement(joint, "axis", xyz=" ".join(map(repr, chain.axes[index].tolist())))
        if bounded:
            names = ("lower", "upper", "effort", "velocity")
            values = map(repr, [*map(float, limits), *rates[index].tolist()])
            SubElement(joint, "limit", dict(zip(names, values, strict=True)))
        root.append(joint)
    fixed = f"{links[-2]}-{robot.tip}"
    root.append(_joint(fixed, "fixed", links[-2], robot.tip, chain.placements[-1]))
    return _with_comments(root, comment_texts(robot, notes))


def _add_inertials(links: Sequence[Element], inertias: Inertias) -> None:
    """Adds an `<inertial>` to links: mass, centre, and inertia about the centre."""
    masses = inertias.masses
    bodies = zip(links, masses.kg.tolist(), masses.centres_m, inertias.about_centres, strict=True)
    for link, kg, centre_m, about in bodies:
        inertial = SubElement(link, "inertial")
        xyz = " ".join(map(repr, (centre_m + 0.0).tolist()))
        SubElement(inertial, "origin", xyz=xyz, rpy="0.0 0.0 0.0")
        SubElement(inertial, "mass", value=repr(kg))
        numbers = map(repr, about[np.triu_indices(3)].tolist())
        names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        SubElement(inertial, "inertia", dict(zip(names, numbers, strict=True)))


def _joint(name: str, kind: str, parent: str, child: str, placement: FloatArray) -> Element:
    """A joint whose origin is at (4, 4) [m] in its parent link."""
    joint = Element("joint", name=name, type=kind)
    SubElement(joint, "parent", link=parent)
    SubElement(joint, "child", link=child)
    _set_origin(joint, placement)
    return joint


def comment_texts(robot: Robot, notes: Sequence[str] = ()) -> list[str]:
    """Texts of XML comments: the notes, and joint functions that are missing."""
    missing = unexportable_functions(robot)
    said = f"Not in this file, for URDF cannot say it: {'; '.join(missing)}"
    # XML ends a comment at two hyphens.
    return [re.sub("-(?=-)", "- ", one_line(note)) for note in (*notes, *[said][: len(missing)])]


def ur_kinematics_yaml(
    robot: Robot, *, calibration_hash: str, like: DHTable | None = None, notes: Sequence[str] = ()
) -> str:
    """Writes the `kinematics` file that ur_description takes as `kinematics_params_file`.

    Each link's x, y, z [m] and roll, pitch, yaw [rad] place its joint in the link before it, the
    shoulder in base_link_inertia, which is the controller's base; joints rotate about z. wrist_3 is
    the flange, tool0 (ur_description, urdf/ur_macro.xacro and config/ur*/default_kinematics.yaml).
    The pose of `ur_flange` has no field there, and is written as a comment.

    Args:
        robot: The robot. Where its base is ROS's base_link, half a turn from base_link_inertia,
            that turn is left out.
        calibration_hash: The `hash` of the arm's own file, as ur_calibration extracts it. It is
            required by ur_description (urdf/inc/ur_common.xacro), and the driver warns if the
            connected arm has another.
        like: The nominal table, for the same choice of link frames.
        notes: Lines for a comment at its head.

    Raises:
        DataError: The robot does not have a UR's axes.
    """
    table = _ur_table(robot, like)
    placements = table.along_x[:-1] @ table.along_z
    placements[0] = table.base @ placements[0]
    missing = unexportable_functions(robot)
    unsaid = (
        [f"Not in this file, which has no field for it: {'; '.join(missing)}"] if missing else []
    )
    lines = [f"# {one_line(note)}" for note in (*notes, *unsaid)]
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


def ur_flange(robot: Robot, like: DHTable) -> FloatArray:
    """Flange pose (4, 4) in the last link of `ur_kinematics_yaml`, which ROS takes for the flange.

    Raises:
        DataError: The robot does not have a UR's axes.
    """
    table = _ur_table(robot, like)
    return np.asarray(table.along_x[-1] @ table.flange)


def _ur_table(robot: Robot, like: DHTable | None) -> DHTable:
    """The robot's Hayati table in the controller's base."""
    if not has_ur_axes(robot):
        raise DataError(
            f"robot {robot.name}: ur_description's kinematics are of six revolute joints, the "
            f"second, third and fourth axis parallel, and {', '.join(robot.joint_names)} are not.",
            culprits=[robot.name],
            next_step="Write another robot as a URDF or a joint table.",
        )
    # At zero a UR points along -x in the controller's base, and along x in ROS's.
    if robot.base_from_flange(np.zeros((1, 6)))[0, 0, 3] > 0.0:
        robot = with_base(robot, _HALF_TURN)
    return table_of(robot, "hayati", like=like)


def without_functions(robot: Robot) -> Robot:
    """The arm with offsets as its only joint functions."""
    functions = np.array(IDENTITY_FUNCTION) - robot.chain.functions
    functions[:, 0] = 0.0
    harmonics = robot.chain.harmonics
    return robot.corrected(functions=functions, harmonics=None if harmonics is None else -harmonics)


def fit_links(
    robot: Robot, q: FloatArray, base_from_flange: FloatArray, weights: FloatArray
) -> Robot:
    """Fits placements and joint offsets of an arm to (m, 4, 4) flange poses, weighted by (m,).

    Least squares over (m, n) joint angles; the base and the other joint function coefficients stay.
    See `Robot.placement_jacobian`.
    """
    count, units = robot.joint_count, np.repeat([1.0, _LEVER_M], 3)
    row_weights = np.sqrt(weights)[:, None] * np.repeat([_LEVER_M, 1.0], 3)
    # Corrections are some thousandths: two suffice for a micrometre.
    for _ in range(4):
        residual = log(invert(robot.base_from_flange(q)) @ base_from_flange)
        links = robot.placement_jacobian(q)[:, :, 6:] * np.tile(units, count)
        offsets = robot.function_jacobian(q).reshape(len(q), 6, count, -1)[..., 0]
        columns = row_weights[:, :, None] * np.concatenate([offsets, links], axis=2)
        # Undetermined twists stay.
        step = np.linalg.lstsq(
            columns.reshape(-1, 7 * count), (row_weights * residual).ravel(), rcond=1e-6
        )[0]
        functions, placements = np.zeros((count, 4)), np.zeros((count + 1, 6))
        functions[:, 0] = step[:count]
        placements[1:] = step[count:].reshape(count, 6) * units
        robot = robot.corrected(placements, functions)
    return robot


def corrected_urdf(nominal: Robot, corrected: Robot, notes: Sequence[str] = ()) -> str:
    """Writes the URDF of a robot with a calibrated geometry.

    The content of the URDF stays, though not its formatting: only the origins of the joints between
    base and tip change, and that of the fixed joint before the tip; where there is none, a link
    NAME_corrected with a fixed joint is added. Joint offsets go into the origins. A URDF cannot
    hold gear ratio and eccentricity; a comment lists those that are missing.

    Args:
        nominal: The robot as the URDF describes it.
        corrected: Its corrected model.
        notes: Lines for comments at the head of the robot.

    Raises:
        DataError: The nominal robot is not of a URDF, or the joints differ.
    """
    text = nominal.document.get("urdf")
    if not isinstance(text, str) or nominal.joint_names != corrected.joint_names:
        raise DataError(
            f"robot {nominal.name} must come from a URDF, with its corrected model.",
            culprits=[nominal.name],
            next_step="Write a small URDF or a joint table instead.",
        )
    root, joints = joints_of(text)
    old, new = nominal.chain, corrected.chain.with_offsets_placed()
    steps = invert(old.placements) @ new.placements
    for name, before, after, step in zip(
        (*old.joint_names, None), old.placements, new.placements, steps, strict=True
    ):
        if np.array_equal(before, after):
            continue
        joint = _of_tip(joints, nominal) if name is None else joints[name]
        if joint is None:
            # A link with a fixed joint for the corrected tip.
            tip, link = nominal.tip, f"{nominal.tip}_corrected"
            parent = end_of(joints[tip], "child") if tip in joints else tip
            root.append(Element("link", name=link))
            root.append(_joint(f"{tip}_correction", "fixed", parent, link, step))
        else:
            origin = joint.find("origin")
            attributes = {} if origin is None else origin.attrib
            xyz, rpy = (
                np.array(attributes.get(key, "0 0 0").split(), dtype=float)
                for key in ("xyz", "rpy")
            )
            _set_origin(
                joint, compose(ROTATION_FORMS["euler-xyz-rad"].read(rpy[None])[0], xyz) @ step
            )
    return _with_comments(root, comment_texts(corrected, notes))


def corrected_tip(nominal: Robot, corrected: Robot) -> str:
    """Name of the frame in `corrected_urdf` that corresponds to the corrected flange."""
    if np.array_equal(nominal.chain.placements[-1], corrected.chain.placements[-1]):
        return nominal.tip
    _, joints = joints_of(str(nominal.document["urdf"]))
    return nominal.tip if _of_tip(joints, nominal) is not None else f"{nominal.tip}_corrected"


def joints_of(urdf: str) -> tuple[Element, dict[str, Element]]:
    """The root of a URDF, and its joints by name, without those nested in transmissions."""
    root = parse_xml(urdf.encode("utf-8"), "the URDF")
    return root, {joint.get("name", ""): joint for joint in root.iterfind("joint")}


def end_of(joint: Element, end: str) -> str:
    """The `parent` or `child` link of a joint; empty where absent."""
    link = joint.find(end)
    return "" if link is None else link.get("link", "")


def _with_comments(root: Element, comments: Sequence[str]) -> str:
    """Text of an edited URDF, with comments at its head."""
    root[:0] = [Comment(f" {comment} ") for comment in comments]
    indent(root)
    return f'<?xml version="1.0"?>\n{tostring(root, encoding="unicode")}\n'


def _of_tip(joints: Mapping[str, Element], robot: Robot) -> Element | None:
    """The fixed joint that places the tip; None where a moving joint does."""
    fixed = {name: joint for name, joint in joints.items() if name not in robot.joint_names}
    named = (
        element for name, element in fixed.items() if robot.tip in (name, end_of(element, "child"))
    )
    return next(named, None)


def _set_origin(joint: Element, placement: FloatArray) -> None:
    """Gives a joint another origin (4, 4) [m]."""
    origin = joint.find("origin")
    origin = SubElement(joint, "origin") if origin is None else origin
    for key, numbers in zip(("xyz", "rpy"), numbers_text(placement), strict=True):
        origin.set(key, " ".join(numbers))


def with_inertias(robot: Robot, inertias: Inertias) -> Robot:
    """Builds an arm with other inertias of its links, in the joints' frames.

    A table or a chain stays one; a URDF becomes a chain.
    """
    if "convention" in robot.document:
        document = dict(robot.document)
        joint_from_row = row_frames(table_from_document(document))
    else:
        document = robot.weighted(chain_document(robot.name, robot.tip, robot.chain))
        joint_from_row = np.broadcast_to(np.eye(4), (robot.joint_count, 4, 4))
    row_from_joint = invert(joint_from_row)
    rotation, position = row_from_joint[:, :3, :3], row_from_joint[:, :3, 3]
    masses = inertias.masses
    centres = (rotation @ masses.centres_m[:, :, None])[:, :, 0] + position
    about = rotation @ inertias.about_centres @ np.swapaxes(rotation, 1, 2)
    rows = zip(document["joint"], Inertias.of_bodies(masses.kg, centres, about).rows(), strict=True)
    joints: list[dict[str, Any]] = [{**row, **inertial} for row, inertial in rows]
    return Robot.from_document(document | {"joint": joints})


def urdf_with_inertias(robot: Robot, inertias: Inertias, notes: Sequence[str] = ()) -> str:
    """Writes the URDF of a robot with identified inertias.

    All that moves with a joint of the arm is one body: the link after the joint gets its inertia,
    and other links that move with it none.

    Args:
        robot: The robot as the URDF describes it.
        inertias: Of the bodies that move with its joints.
        notes: Lines for comments at the head of the robot.

    Raises:
        DataError: The robot is not of a URDF.
    """
    text = robot.document.get("urdf")
    if not isinstance(text, str):
        raise DataError(
            f"robot {robot.name} must come from a URDF.",
            culprits=[robot.name],
            next_step="Write a small URDF or a joint table instead.",
        )
    root, joints = joints_of(text)
    links = {link.get("name", ""): link for link in root.iterfind("link")}
    moving = [end_of(joints[joint], "child") for joint in robot.joint_names]
    for link_name in moving:
        for name in _moving_with(link_name, joints, robot.joint_names):
            for former in links[name].findall("inertial"):
                links[name].remove(former)
    _add_inertials([links[link_name] for link_name in moving], inertias)
    return _with_comments(root, comment_texts(robot, notes))


def _moving_with(link: str, joints: Mapping[str, Element], arm: Sequence[str]) -> list[str]:
    """A link and all links attached to it other than by the arm's joints."""
    links = [link]
    for name in links:
        links += [
            end_of(element, "child")
            for joint, element in joints.items()
            if end_of(element, "parent") == name and joint not in arm
        ]
    return links
