"""Nominal robot models: forward kinematics from a DH table or a URDF.

This is the only module that knows Pinocchio, and it imports it where a model is built. The base
frame is that of the table's first row or the URDF's root link; for a UR's table it is the frame
that the controller calls base.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from visioncal.errors import DataError
from visioncal.files import Table, did_you_mean, find_described, parse_toml, read_text
from visioncal.types import FloatArray

if TYPE_CHECKING:
    import pinocchio as pin

# Far above any arm's URDF; a larger file is something else.
_MAX_URDF_BYTES = 10_000_000
# The tips by which arms commonly call the frame of the reported poses, the best first.
_USUAL_TIPS = ("tool0", "flange")


def _shipped() -> dict[str, Path]:
    """The robots that come with visioncal, by name."""
    folder = Path(__file__).resolve().parent / "robots"
    return {path.stem: path for path in folder.glob("*.toml")}


def robot_names() -> tuple[str, ...]:
    """Lists the names of the robots that come with visioncal."""
    return tuple(sorted(_shipped()))


def read_robot_document(
    name_or_path: str, *, tip: str | None = None, folder: Path | None = None
) -> dict[str, Any]:
    """Reads a robot's description without building its model.

    Args:
        name_or_path: A name among `robot_names()`, or the path of a DH `.toml` or a `.urdf`.
        tip: The frame that poses are of. A DH table has one end, which gets this name; in a URDF
            it is a link or joint.
        folder: Relative paths start here; the working directory where None.

    Returns:
        What `Robot.from_document` needs, with nothing else; it can be written as JSON.

    Raises:
        DataError: There is no such robot, or its file is too large or no TOML.
    """
    path = find_described(
        name_or_path, what="robot", shipped=_shipped(), suffixes=(".toml", ".urdf"), folder=folder
    )
    if path.suffix.lower() == ".toml":
        table = parse_toml(read_text(path), path.name)
        named = {"name": path.stem, "tip": "flange"} | table
        return named if tip is None else named | {"tip": tip}
    size = path.stat().st_size
    if size > _MAX_URDF_BYTES:
        raise DataError(
            f"{path} has {size / 1e6:.0f} MB; a URDF of at most {_MAX_URDF_BYTES / 1e6:.0f} MB is "
            "read.",
            culprits=[str(path)],
            next_step="Meshes belong into files of their own.",
        )
    return {"schema": 1, "name": path.stem, "tip": tip or "", "urdf": read_text(path)}


def robot_file(document: Mapping[str, Any]) -> tuple[str, str]:
    """Writes a robot's description as a file that `load_robot` reads: (file name, content)."""
    if "urdf" in document:
        return "robot.urdf", str(document["urdf"])
    return "robot.toml", tomli_w.dumps(document)


def load_robot(name_or_path: str, tip: str | None = None, folder: Path | None = None) -> "Robot":
    """Loads a robot's model; the arguments are those of `read_robot_document`.

    Raises:
        DataError: There is no such robot, or its description is wrong.
    """
    return Robot.from_document(read_robot_document(name_or_path, tip=tip, folder=folder))


@dataclass(frozen=True, eq=False)
class Robot:
    """A serial arm with its nominal geometry.

    Joints are those between the base and the tip, in this order; others are held at their neutral
    position. A prismatic joint's "angle" and limits are lengths [m].

    Attributes:
        name: The robot's name.
        tip: The frame of its end, called flange here.
        document: What recreates it: `Robot.from_document(document)`.
        joint_names: The joints' names.
        lower_rad: (n,) lower limits [rad]; -inf for a joint without limits.
        upper_rad: (n,) upper limits [rad]; inf for a joint without limits.
    """

    name: str
    tip: str
    document: Mapping[str, Any]
    joint_names: tuple[str, ...]
    lower_rad: FloatArray
    upper_rad: FloatArray
    _model: "pin.Model" = field(repr=False)

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> "Robot":
        """Builds a robot from its description.

        Args:
            document: A DH table (name, tip, convention, [[joint]], flange), or name, tip and the
                URDF's text.

        Raises:
            DataError: A field is missing or out of range, the URDF cannot be parsed, or it lacks
                the tip.
        """
        name = Table(document, "robot").text("name")
        table = Table(document, f"robot {name}")
        if table.integer("schema", 1, 1) and "urdf" in document:
            model, tip = _urdf_model(table)
        else:
            tip = table.text("tip", "flange")
            model = _dh_model(table, tip)
        unbounded = np.array([joint.nq == 2 for joint in model.joints][1:], dtype=bool)
        places = [joint.idx_q for joint in model.joints][1:]
        lower = np.where(unbounded, -np.inf, model.lowerPositionLimit[places])
        upper = np.where(unbounded, np.inf, model.upperPositionLimit[places])
        return cls(name, tip, dict(document), tuple(model.names)[1:], lower, upper, model)

    @property
    def joint_count(self) -> int:
        """The number of joints between base and tip."""
        return len(self.joint_names)

    def base_from_flange(self, q: FloatArray) -> FloatArray:
        """Computes the nominal forward kinematics.

        Args:
            q: (m, n) joint angles [rad].

        Returns:
            (m, 4, 4) `base_from_flange` [m].

        Raises:
            DataError: The number of joints differs from the robot's.
        """
        flange = self._model.getFrameId(self.tip)
        return np.array([data.oMf[flange].homogeneous for data in self._solved(q)]).reshape(
            -1, 4, 4
        )

    def link_frames(self, q: FloatArray) -> FloatArray:
        """Computes where the joints and the flange are, for drawing.

        Args:
            q: (n,) joint angles [rad].

        Returns:
            (n + 1, 4, 4) the joints' frames, after their motion, and the flange in the base [m].

        Raises:
            DataError: The number of joints differs from the robot's.
        """
        flange = self._model.getFrameId(self.tip)
        (data,) = self._solved(np.asarray(q)[None])
        return np.array(
            [*(joint.homogeneous for joint in data.oMi[1:]), data.oMf[flange].homogeneous]
        )

    def _solved(self, q: FloatArray) -> Iterator["pin.Data"]:
        """Yields Pinocchio's data, the same object each time, with one row's kinematics in it."""
        import pinocchio as pin

        q = np.asarray(q, dtype=float)
        if q.ndim != 2 or q.shape[1] != self.joint_count:
            raise DataError(
                f"robot {self.name} has {self.joint_count} joints up to {self.tip}; joint angles "
                f"of shape (m, {self.joint_count}) are needed, not {q.shape}.",
                culprits=[self.name],
            )
        data = self._model.createData()
        flange = self._model.getFrameId(self.tip)
        for configuration in self._configurations(q):
            pin.forwardKinematics(self._model, data, configuration)
            pin.updateFramePlacement(self._model, data, flange)
            yield data

    def _configurations(self, q: FloatArray) -> FloatArray:
        """Writes angles as Pinocchio does: a joint without limits as (cosine, sine)."""
        configurations = np.empty((len(q), self._model.nq))
        for joint, angles in zip(list(self._model.joints)[1:], q.T, strict=True):
            if joint.nq == 2:
                configurations[:, joint.idx_q] = np.cos(angles)
                configurations[:, joint.idx_q + 1] = np.sin(angles)
            else:
                configurations[:, joint.idx_q] = angles
        return configurations


def _dh_model(table: Table, tip: str) -> "pin.Model":
    """Builds a model of revolute joints about z from a DH table.

    Standard (Denavit and Hartenberg, 1955): link i is Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i).
    Modified (Craig, 1986): Rx(alpha_i) Tx(a_i) Rz(theta_i) Tz(d_i), with row i holding Craig's
    a and alpha of index i - 1. Rz and Tz commute, so the joint's own rotation can stand first
    (standard) or last (modified) and the rest of the row is a constant.
    """
    import pinocchio as pin

    modified = table.choice("convention", ("standard", "modified")) == "modified"
    joints = _joint_tables(table)
    model = pin.Model()
    model.name = table.text("name")
    pending, last = np.eye(4), 0
    for name, joint in joints:
        constant = _dh_constant(joint, "theta_offset_rad", modified=modified)
        placement = pending @ constant if modified else pending
        pending = np.eye(4) if modified else constant
        lower, upper = joint.number("lower_deg", -360.0), joint.number("upper_deg", 360.0)
        if lower >= upper:
            raise joint.refuse("lower_deg", lower, f"less than upper_deg = {upper!r}")
        last = model.addJoint(last, pin.JointModelRZ(), pin.SE3(placement), name)
        model.lowerPositionLimit[last - 1] = math.radians(lower)
        model.upperPositionLimit[last - 1] = math.radians(upper)
    if "flange" in table.content:
        content = table.content["flange"]
        if not isinstance(content, Mapping):
            raise table.refuse("flange", content, "a [flange] table")
        flange = Table(content, f"{table.label}, flange")
        pending = pending @ _dh_constant(flange, "theta_rad", modified=modified)
    model.addFrame(pin.Frame(tip, last, 0, pin.SE3(pending), pin.FrameType.OP_FRAME))
    return model


def _joint_tables(table: Table) -> list[tuple[str, Table]]:
    """The rows of a DH table with their names."""
    rows = table.content.get("joint")
    if not isinstance(rows, Sequence) or not rows or not all(isinstance(r, Mapping) for r in rows):
        raise table.refuse("joint", rows, "one [[joint]] table for each joint")
    names = [
        Table(row, f"{table.label}, joint {place}").text("name", f"joint_{place}")
        for place, row in enumerate(rows, start=1)
    ]
    if len(set(names)) < len(names):
        raise table.refuse("joint", names, "a name of its own for each joint")
    return [
        (name, Table(row, f"{table.label}, joint {name}"))
        for row, name in zip(rows, names, strict=True)
    ]


def _dh_constant(row: Table, theta: str, *, modified: bool) -> FloatArray:
    """The constant part of a DH row: everything but the joint's own angle."""
    angle, alpha = row.number(theta, 0.0), row.number("alpha_rad")
    about_z, along_x = np.eye(4), np.eye(4)
    c, s = math.cos(angle), math.sin(angle)
    about_z[:3] = [[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, row.number("d_m")]]
    c, s = math.cos(alpha), math.sin(alpha)
    along_x[:3] = [[1, 0, 0, row.number("a_m")], [0, c, -s, 0], [0, s, c, 0]]
    return np.asarray(along_x @ about_z if modified else about_z @ along_x)


def _urdf_model(table: Table) -> tuple["pin.Model", str]:
    """Builds the chain from a URDF's root to the tip: (model, the tip's name)."""
    import pinocchio as pin

    try:
        model = pin.buildModelFromXML(table.text("urdf"))
    except (ValueError, RuntimeError) as error:
        raise DataError(
            f"{table.label}: the URDF cannot be parsed: {error}.",
            culprits=[table.label],
            next_step="Expand xacro first (xacro robot.urdf.xacro > robot.urdf); check_urdf names "
            "the place.",
        ) from error
    tip = _find_tip(table, [frame.name for frame in model.frames][1:])
    chain = list(model.supports[model.frames[model.getFrameId(tip)].parentJoint])[1:]
    for joint in chain:
        if model.joints[joint].nv != 1:
            raise DataError(
                f"{table.label}: joint {model.names[joint]} before {tip} has "
                f"{model.joints[joint].nv} degrees of freedom; revolute, continuous and prismatic "
                "joints are read.",
                culprits=[model.names[joint]],
            )
    others = [joint for joint in range(1, model.njoints) if joint not in chain]
    return pin.buildReducedModel(model, others, pin.neutral(model)), tip


def _find_tip(table: Table, frames: Sequence[str]) -> str:
    """Finds the tip among a URDF's frames; one that is not named is the usual one."""
    tip = table.text("tip", "")
    usual = [name for name in _USUAL_TIPS if name in frames]
    if not tip and usual:
        return usual[0]
    if tip in frames:
        return tip
    links = ", ".join(dict.fromkeys(frames))
    what = f"has no frame {tip!r}" if tip else "has no tool0 or flange, and no tip is named"
    raise DataError(
        f"{table.label}: the URDF {what}; its frames are {links}.",
        culprits=[f"{table.label}: tip"],
        next_step=f"{did_you_mean(tip, frames)} Name the frame of the reported poses as tip in "
        "[robot].".strip(),
    )
