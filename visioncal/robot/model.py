"""Robot models: kinematics of a serial arm, and Jacobians over its calibrated parameters.

The base frame is that of the table's first row or the URDF's root link; for a UR's table it is the
frame that the controller calls base.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.errors import DataError
from visioncal.core.transforms import adjoint, exp, invert, skew
from visioncal.core.types import FloatArray
from visioncal.robot.chain import Chain, chain_document, chain_from_document, joint_tables
from visioncal.robot.inertia import INERTIA_KEY, Inertias, inertias_of_rows
from visioncal.robot.kinematics import arm_of_urdf
from visioncal.robot.loads import (
    MASS_KEYS,
    RATE_KEYS,
    DriveLimits,
    Loads,
    Masses,
    gravity_of,
    masses_of_rows,
)
from visioncal.robot.tables import chain_of_table, row_frames, table_from_document

if TYPE_CHECKING:
    import pinocchio as pin


# Optional keys of a link's collision body in a joint's table.
BODY_KEYS = ("body_radius_m", "body_offset_m")
# Optional keys of link and drive in a joint's table: all that is not geometry.
LINK_KEYS = (*BODY_KEYS, *MASS_KEYS, INERTIA_KEY, *RATE_KEYS)
# Optional keys of the whole arm beside its geometry.
COMPENSATED = "weight_compensated"
ARM_KEYS = ("gravity_m_s2", "repeatability_mm", "repeatability_deg", COMPENSATED)
# Standard deviation of an industrial arm's flange from stop to stop [mm], [deg].
REPEATABILITY = (0.1, 0.01)


@dataclass(frozen=True, eq=False)
class Robot:
    """A serial arm with its nominal or corrected geometry.

    Joints are those between the base and the tip, in this order; others are held at their neutral
    position. A prismatic joint's "angle" and limits are lengths [m]. All methods of joint angles
    `q`, (m, n) or (n,) [rad], raise DataError where their number differs from the robot's.
    """

    name: str  # The robot's name.
    tip: str  # The frame of its end, called flange here.
    document: Mapping[str, Any]  # The description that recreates it by `Robot.from_document`.
    chain: Chain  # Its geometry.
    masses: Masses | None  # Masses of its links; None where unknown.
    inertias: Inertias | None  # Inertial parameters of its links; None where unknown.
    rates: DriveLimits  # Limits of its drives.
    gravity: FloatArray  # (3,) gravitational acceleration in the base's frame [m/s^2].
    # Standard deviation of the flange from stop to stop [mm], [deg].
    repeatability: tuple[float, float]
    # Whether the controller compensates what the links' own weight bends: loads alone bend it then.
    weight_compensated: bool = False

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> "Robot":
        """Builds a robot from its description.

        Args:
            document: A DH table (name, tip, convention, [[joint]], base, flange); or name, tip and
                the URDF's text; or a chain as `corrected` writes it. A table's or a chain's joints
                may state their links' `mass_kg` and its centre `com_m`, in the frame in which the
                joint's row ends, their `inertia_kg_m2` about it, and limits of their drives; any
                description the `gravity_m_s2` in its base, the flange's `repeatability_mm` and
                `repeatability_deg`, and whether the controller has the arm's own weight
                `weight_compensated`.

        Raises:
            DataError: A field is missing or out of range, the URDF cannot be parsed, or it lacks
                the tip.
        """
        name = DocumentTable(document, "robot").text("name")
        table = DocumentTable(document, f"robot {name}")
        tip = table.text("tip", "flange")
        table.integer("schema", 1, 1)
        if "urdf" in document:
            chain, tip, masses, inertias, rates = arm_of_urdf(table)
        else:
            if "kind" in document:
                table.choice("kind", ("chain",))
                chain = chain_from_document(table)
                frames = np.broadcast_to(np.eye(4), (len(chain), 4, 4))
            else:
                rows = table_from_document(document)
                chain, frames = chain_of_table(rows), row_frames(rows)
            joints = [row for _, row in joint_tables(table)]
            masses = masses_of_rows(joints, frames)
            inertias = inertias_of_rows(joints, frames)
            rates = DriveLimits.of_rows(joints)
        gravity = gravity_of(document, table.label)
        repeats_mm = table.number("repeatability_mm", REPEATABILITY[0], positive=True)
        repeats_deg = table.number("repeatability_deg", REPEATABILITY[1], positive=True)
        facts = (masses, inertias, rates, gravity, (repeats_mm, repeats_deg))
        return cls(name, tip, dict(document), chain, *facts, bool(document.get(COMPENSATED)))

    @property
    def with_weight_compensated(self) -> "Robot":
        """The same arm by a controller that compensates what its own weight bends."""
        document = {**self.document, COMPENSATED: True}
        return replace(self, document=document, weight_compensated=True)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.chain.joint_names

    @property
    def joint_count(self) -> int:
        """The number n of joints."""
        return len(self.chain)

    @property
    def lower_rad(self) -> FloatArray:
        """(n,) lower limits [rad]; -inf for a joint without limits."""
        return self.chain.lower

    @property
    def upper_rad(self) -> FloatArray:
        """(n,) upper limits [rad]; inf for a joint without limits."""
        return self.chain.upper

    @cached_property
    def pinocchio_model(self) -> "pin.Model":
        """Pinocchio's model, over effective joint positions; for use in this package only."""
        import pinocchio as pin

        along = {(1.0, 0.0, 0.0): "X", (0.0, 1.0, 0.0): "Y", (0.0, 0.0, 1.0): "Z"}
        model, last, chain = pin.Model(), 0, self.chain
        model.name, model.gravity.linear = self.name, self.gravity
        for place, joint in enumerate(chain.joint_names):
            kind = "Prismatic" if chain.prismatic[place] else "Revolute"
            letter = along.get(tuple(chain.axes[place].tolist()))
            if letter is None:
                motion = getattr(pin, f"JointModel{kind}Unaligned")(chain.axes[place])
            else:
                motion = getattr(pin, f"JointModel{kind[0]}{letter}")()
            last = model.addJoint(last, motion, pin.SE3(chain.placements[place]), joint)
            if (masses := self.masses) is not None:
                # The rotational inertia does not matter to an arm at rest.
                body = pin.Inertia(masses.kg[place], masses.centres_m[place], np.zeros((3, 3)))
                model.appendBodyToJoint(last, body, pin.SE3.Identity())
        tip_placement = pin.SE3(chain.placements[-1])
        model.addFrame(pin.Frame(self.tip, last, 0, tip_placement, pin.FrameType.OP_FRAME))
        return model

    def base_from_flange(self, q: FloatArray) -> FloatArray:
        """Forward kinematics: (m, 4, 4) `base_from_flange` [m] at (m, n) joint angles [rad]."""
        return self.link_frames(q)[:, -1]

    def link_frames(self, q: FloatArray) -> FloatArray:
        """Frames (m, n + 1, 4, 4) of the joints, after their motion, and of the flange [m]."""
        steps = self.chain.steps(self._effective(q))
        frames = np.empty((len(steps), self.joint_count + 1, 4, 4))
        frames[:, 0] = steps[:, 0]
        for place in range(1, self.joint_count):
            frames[:, place] = frames[:, place - 1] @ steps[:, place]
        frames[:, -1] = frames[:, -2] @ self.chain.placements[-1]
        return frames

    def placement_jacobian(self, q: FloatArray) -> FloatArray:
        """Jacobian of the flange over the placements of the links.

        Placements are those of `chain.placements`: six columns (rotation [rad], translation [m])
        for each joint's frame in the one before it, and six for the flange in the last. Both the
        flange and the placements are perturbed on the right, so each block is the adjoint of the
        placement's frame, before the joint's motion, seen from the flange; the last is the
        identity.

        Returns:
            (m, 6, 6 (n + 1)) derivatives of `log(base_from_flange^-1 base_from_flange(step))`.
        """
        frames = self.link_frames(q)
        placed = np.empty_like(frames)
        placed[:, 0] = self.chain.placements[0]
        placed[:, 1:] = frames[:, :-1] @ self.chain.placements[1:]
        blocks = adjoint(invert(frames[:, -1:]) @ placed)
        return np.swapaxes(blocks, 1, 2).reshape(len(frames), 6, 6 * frames.shape[1])

    def joint_jacobian(self, q: FloatArray) -> FloatArray:
        """Jacobian (m, 6, n) of the flange over the joint angles, in the flange's frame.

        Right perturbations (rotation, translation) of `base_from_flange` [rad and m for 1 rad].
        """
        return self.axis_jacobian(q) * self.chain.jacobian(np.asarray(q, dtype=float))[:, None, :]

    @property
    def can_tilt(self) -> bool:
        """Whether the flange can rotate about more than one direction, unlike a four-axis arm's."""
        axes = self.joint_jacobian(np.zeros((1, self.joint_count)))[0, :3]
        sizes = np.linalg.svd(axes, compute_uv=False)
        # Axes of calibrated arms are parallel within this.
        return int(np.sum(sizes > 0.05 * sizes[0])) > 1

    def function_jacobian(self, q: FloatArray) -> FloatArray:
        """Jacobian of the flange over the joint function coefficients.

        Returns:
            (m, 6, 4 n) right perturbations of `base_from_flange` for each joint's offset [rad],
            ratio, sine and cosine [rad], as `chain.functions` has them.
        """
        axes = self.axis_jacobian(q)
        basis = self.chain.function_basis(np.asarray(q, dtype=float))
        columns = axes[:, :, :, None] * basis[:, None]
        return columns.reshape(*axes.shape[:2], 4 * self.joint_count)

    def axis_jacobian(self, q: FloatArray) -> FloatArray:
        """Jacobian (m, 6, n) of the flange over effective joint positions, as right perturbations.

        A joint's motion commutes with a rotation of its placement about the same axis.
        """
        links = self.placement_jacobian(q)[:, :, :-6]
        columns = links.reshape(len(links), 6, self.joint_count, 6)
        return np.asarray(np.einsum("mijk,jk->mij", columns, self.chain.twists))

    def gravity_torques(self, q: FloatArray) -> FloatArray:
        """Joint torques (m, n) that hold the links' weight [N m]; zero where masses are unknown."""
        if self.masses is None:
            return np.zeros_like(self._effective(q))
        frames = self.link_frames(q)[:, :-1]
        rotations, origins = frames[..., :3, :3], frames[..., :3, 3]
        axes, centres = (
            (rotations @ local[:, :, None])[..., 0]
            for local in (self.chain.axes, self.masses.centres_m)
        )
        # Each joint holds all links from its own on: their mass, first moments about its origin.
        kg = np.cumsum(self.masses.kg[::-1])[::-1]
        moments = self.masses.kg[:, None] * (origins + centres)
        moments = np.cumsum(moments[:, ::-1], axis=1)[:, ::-1] - kg[:, None] * origins
        turning = np.sum(moments * (axes @ skew(self.gravity).T), axis=2)
        return -np.where(self.chain.prismatic, kg * (axes @ self.gravity), turning)

    def weight_jacobian(self, q: FloatArray) -> FloatArray:
        """Derivatives of the joint torques by weight over masses and first moments.

        Returns:
            (m, n, 4 n) for mass [kg] and first moments [kg m] of all that moves with each joint.
        """
        import pinocchio as pin

        positions, count = self._effective(q), self.joint_count
        model, still = self.pinocchio_model, np.zeros(count)
        data = model.createData()
        rows = np.empty((len(positions), count, count, 4))
        for row, configuration in enumerate(positions):
            regressor = pin.computeJointTorqueRegressor(model, data, configuration, still, still)
            # Ten parameters a body: mass, first moments, and inertias, which do not matter at rest.
            rows[row] = -regressor.reshape(count, count, 10)[:, :, :4]
        return rows.reshape(len(positions), count, 4 * count)

    def load_torques(self, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """Torques (m, n) of weight, payload and force on the joints [N m; N if prismatic].

        The torque of the links' weight is the negative of the generalised gravity (Featherstone
        2008, section 5.3), zero where masses are unknown or the controller compensates it; those at
        the flange follow by the transpose of the geometric Jacobian.
        """
        torques = -self.gravity_torques(q)
        if self.weight_compensated:
            torques = np.zeros_like(torques)
        if loads is None or not loads.any:
            return torques
        base_from_flange = self.base_from_flange(q)
        flange_from_base = np.swapaxes(base_from_flange[:, :3, :3], 1, 2)
        weight = np.einsum("mij,mj->mi", flange_from_base, loads.payload_kg[:, None] * self.gravity)
        push = np.einsum("mij,mj->mi", flange_from_base, loads.force_n)
        wrench = np.concatenate([np.cross(loads.payload_m, weight), weight + push], axis=1)
        return np.asarray(torques + np.einsum("mij,mi->mj", self.axis_jacobian(q), wrench))

    def harmonic_jacobian(self, q: FloatArray, orders: int) -> FloatArray:
        """Jacobian of the flange over the harmonics of the joint functions.

        Args:
            q: (m, n) joint angles [rad].
            orders: The number k of orders, from 2 on.

        Returns:
            (m, 6, 2 n k) right perturbations of `base_from_flange` for each joint's sine and cosine
            of each order [rad], as `chain.harmonics` has them; none for a prismatic joint.
        """
        axes = np.where(self.chain.prismatic, 0.0, self.axis_jacobian(q))
        phases = np.arange(2, orders + 2) * np.asarray(q, dtype=float)[:, :, None]
        waves = np.stack([np.sin(phases), np.cos(phases)], axis=-1)
        columns = axes[:, :, :, None, None] * waves[:, None]
        return np.asarray(columns.reshape(*axes.shape[:2], 2 * orders * self.joint_count))

    def corrected(
        self,
        placements: FloatArray | None = None,
        functions: FloatArray | None = None,
        harmonics: FloatArray | None = None,
    ) -> "Robot":
        """Builds the robot with a changed geometry; arguments as of `chain_with`.

        Returns:
            The robot, with a self-contained document that recreates it exactly.

        Raises:
            DataError: As of `chain_with`, or a ratio is not positive.
        """
        chain = self.chain_with(placements, functions, harmonics)
        document = chain_document(self.name, self.tip, chain)
        for row, known in zip(document["joint"], self.document.get("joint", ()), strict=False):
            row |= {key: known[key] for key in BODY_KEYS if key in known}
        return Robot.from_document(self.weighted(document))

    def chain_with(
        self,
        placements: FloatArray | None = None,
        functions: FloatArray | None = None,
        harmonics: FloatArray | None = None,
    ) -> Chain:
        """The chain with a changed geometry.

        Args:
            placements: (n + 1, 6) twists (rotation [rad], translation [m]); each placement is
                multiplied on the right by its exponential. None leaves them.
            functions: (n, 4) additions to each joint's offset [rad], ratio, sine and cosine [rad].
                None leaves them.
            harmonics: (n, k, 2) additions to each joint's sine and cosine [rad] of the orders from
                2 on. None leaves them.

        Raises:
            DataError: A shape is wrong, or a prismatic joint has eccentricity.
        """
        chain = self.chain
        if placements is not None:
            twists = self._shaped(placements, (self.joint_count + 1, 6), "placements")
            chain = replace(chain, placements=chain.placements @ exp(twists))
        if functions is not None:
            added = self._shaped(functions, (self.joint_count, 4), "functions")
            chain = replace(chain, functions=chain.functions + added)
            if np.any(chain.functions[chain.prismatic, 2:]):
                raise DataError(
                    f"robot {self.name}: a prismatic joint has no eccentricity: its sine and "
                    "cosine must be zero.",
                    culprits=[self.name],
                )
        if harmonics is not None:
            known = chain.harmonics
            if known is not None:
                orders = max(known.shape[1], harmonics.shape[1])
                known, harmonics = (
                    np.pad(array, ((0, 0), (0, orders - array.shape[1]), (0, 0)))
                    for array in (known, harmonics)
                )
            chain = replace(chain, harmonics=harmonics if known is None else known + harmonics)
        return chain

    def weighted(self, document: Mapping[str, Any]) -> dict[str, Any]:
        """Adds this arm's masses, inertias, drive limits and `ARM_KEYS` to a description."""
        weighted = dict(document)
        bodies = self.masses if self.inertias is None else self.inertias
        nothing: list[dict[str, Any]] = [{} for _ in document["joint"]]
        parts = (nothing if bodies is None else bodies.rows(), self.rates.rows())
        weighted["joint"] = [
            row | body | rate for row, body, rate in zip(document["joint"], *parts, strict=True)
        ]
        return weighted | {key: self.document[key] for key in ARM_KEYS if key in self.document}

    def _effective(self, q: FloatArray) -> FloatArray:
        """Effective positions (m, n) of (m, n) joint angles, after a check of the shape."""
        q = np.asarray(q, dtype=float)
        if q.ndim != 2 or q.shape[1] != self.joint_count:
            raise DataError(
                f"robot {self.name} has {self.joint_count} joints up to {self.tip}: joint angles "
                f"must have the shape (m, {self.joint_count}), not {q.shape}.",
                culprits=[self.name],
            )
        return self.chain.effective(q)

    def _shaped(self, values: FloatArray, shape: tuple[int, int], what: str) -> FloatArray:
        values = np.asarray(values, dtype=float)
        if values.shape != shape or not np.isfinite(values).all():
            raise DataError(
                f"robot {self.name}: {what} must be finite numbers of the shape {shape}, not "
                f"{values.shape}.",
                culprits=[self.name],
            )
        return values


def joint_words(joint: int, robot: Robot) -> str:
    """A joint by its number and its name."""
    return f"joint {joint + 1} ({robot.joint_names[joint]})"
