"""The result of a calibration."""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.arguments import typed
from visioncal.core.choices import DYNAMICS_FILE
from visioncal.core.codec import entries, reading
from visioncal.core.documents import parse_stored
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes, write_atomically
from visioncal.core.number_format import figure
from visioncal.core.shown import ByName, html_card, text_card
from visioncal.core.types import FloatArray, Mount
from visioncal.core.verdict import Remedy, Verdict
from visioncal.estimation.chain import edge_names
from visioncal.estimation.intervals import freedom_of
from visioncal.results.arm import NOMINAL, ArmResult, ArmSections
from visioncal.results.cell import CellResult
from visioncal.results.document import ALIGNMENT, fields_from_document, to_document
from visioncal.results.edge import Edge
from visioncal.results.frame import Frame
from visioncal.results.lens import CameraResult, RayFrame, ray_frame
from visioncal.results.parts import NeedMet, RobotResult, SolverResult
from visioncal.results.sections import CalibrationSections, CellDetails, CellUncertainty
from visioncal.results.selecting import selected_fields
from visioncal.results.tree import FrameTree
from visioncal.results.views import Rms, Validation, ViewResult
from visioncal.robot import Loads, Robot, bent_joints
from visioncal.robot.thermal import ThermalModel
from visioncal.session.choosing import PARTS, Choice, Part
from visioncal.session.frames import CELL

if TYPE_CHECKING:
    from visioncal.present.report.drawing import Drawing

# So many transforms are shown at once.
_SHOWN = 8


@dataclass(frozen=True, eq=False)
class Calibration(CalibrationSections):
    """The result of calibrating one session; `save` writes it as calibration.json.

    One camera, one robot and their targets have no names; what several have stands in `cell`.

    See also `CalibrationSections` and `ArmSections`, of which it has all attributes.

    Attributes:
        session_name: The session's name.
        session_sha256: Digest of the session's canonical content.
        created: When, in ISO 8601.
        mount: How the camera is mounted.
        edges: The estimated transforms by name, in the order of `joint_covariance`.
        joint_covariance: (6 k, 6 k) covariance of all edges together, in that order.
        solvers: What every solver made of it.
        noise: Estimated standard deviations by name.
        views: One entry for each view of the session.
        rms: Residuals over the used views.
        validation: Residuals of views that were left out.
        verdict: Whether to trust it.
        camera: The camera, where the session has one.
        robot: The nominal robot model, where the session names a known one.
        frames: Tools and fixtures by the transform that places them, as `flange_from_tool`.
        cell: What a whole cell has by name; None for one camera, one robot and their targets. What
            is of one camera or robot, `of` takes out of it.
        need: What the task needs, and how likely picks meet it; None where that is not said.
    """

    session_name: str
    session_sha256: str
    created: str
    mount: Mount
    edges: Mapping[str, Edge]
    joint_covariance: FloatArray
    solvers: Mapping[str, SolverResult]
    noise: Mapping[str, float]
    views: tuple[ViewResult, ...]
    rms: Rms
    validation: Validation
    verdict: Verdict
    camera: CameraResult | None = None
    robot: Robot | None = None
    frames: Mapping[str, Frame] = field(default_factory=dict)
    cell: CellResult | None = None
    need: NeedMet | None = None

    @cached_property
    def ray_frame(self) -> RayFrame | None:
        """The camera's transform in the frame of its image's centre ray; see `RayFrame`."""
        edge = edge_names(self.mount)[0]
        if self.camera is None or edge not in self.edges:
            return None
        return ray_frame(edge, self.edges[edge], self.camera)

    @cached_property
    def by_name(self) -> CellResult:
        """What it has by name; one camera, one robot and their targets have empty ones."""
        if self.cell is not None:
            return self.cell
        ends, known = (name.partition("_from_") for name in self.edges), self.uncertainty
        placed = {child: parent for parent, _, child in ends}
        arm = {section.name: getattr(self, section.name) for section in entries(ArmSections)}
        return CellResult(
            reference="base",
            tree={"base": CELL, "flange": "base", **placed},
            cameras={} if self.camera is None else {"": self.camera},
            robots={"": RobotResult(self.robot, **arm)},
            targets={},
            noise={"": self.noise},
            moved=(),
            untied=(),
            weakest="",
            details=CellDetails({} if self.clock is None else {"": self.clock}),
            uncertainty=None
            if known is None
            else CellUncertainty(budget_mm={}, noise_95={"": known.noise_95}),
        )

    @cached_property
    def tree(self) -> FrameTree:
        """Its frames: what hangs on what, and how."""
        cell = self.by_name
        return FrameTree(
            cell.reference,
            cell.tree,
            cell.flanges,
            self.edges,
            self.joint_covariance,
            self.frames,
            frozenset(move.before for move in cell.moved),
        )

    @typed
    def between(
        self, first: str, second: str, poses: Mapping[str, FloatArray] | None = None
    ) -> Edge:
        """Places any frame in any other, with the covariance that the whole cell gives it.

        That of tools and fixtures counts as independent of it; one whose rotation was not measured
        has that of what it was placed in, without covariance.

        Args:
            first: The one: a frame of the cell, a tool or a fixture.
            second: The other; likewise.
            poses: (4, 4) `base_from_flange` by robot, where the two move before each other by it;
                they count as exact. A robot that has no name goes by `robot`.

        Returns:
            `first_from_second`.

        Raises:
            DataError: There is no such frame, or a robot's pose is needed.
        """
        return self.tree.between(first, second, poses)

    @property
    def next_steps(self) -> tuple[Remedy, ...]:
        """What to do about what was found, of tools and fixtures, too; the most pressing first."""
        doubtful = (name for name, frame in self.frames.items() if frame.verdict.status != "good")
        frames = (Remedy(f"Read what was found of {name} before it is used.") for name in doubtful)
        return (*self.verdict.next_steps, *frames)

    @typed
    def of(
        self, camera: str | None = None, robot: str | None = None, target: str | None = None
    ) -> Self:
        """Returns the calibration of one camera, one robot and one target of a whole cell.

        Both transforms follow through the cell's frames, with the covariance that all of it gives
        them. Where there is one of each, it is the calibration itself.

        Args:
            camera: Its name, or its frame's; may be left out where only one fits.
            robot: The robot that moves camera and target before each other; likewise.
            target: The target; likewise.

        Raises:
            DataError: There is no such thing, several are meant, or this robot does not part these.
        """
        return self.chosen(Choice(camera, robot, target))

    def chosen(self, choice: Choice, needs: Collection[Part] = PARTS) -> Self:
        """As `of`, for what needs to know no more than some of the three.

        Args:
            choice: What is named.
            needs: What has to be clear; of the rest, any that fits is taken, or none.

        Raises:
            DataError: See `of`.
        """
        if self.cell is not None:
            return replace(self, **selected_fields(self, self.cell, choice, needs))
        if choice:
            raise DataError(
                f"calibration {self.session_name!r} is of one camera and one robot, which have no "
                "names.",
                culprits=[f"--{part}" for part in PARTS if choice.of(part)],
                next_step="Leave their names out.",
            )
        return self

    @property
    def transforms(self) -> ByName[RigidTransform]:
        """The estimated transforms by name, those of tools and fixtures among them."""
        return ByName({name: edge.transform for name, edge in self.placed.items()})

    @property
    def placed(self) -> ByName[Edge]:
        """The estimated transforms by name with their covariances, frames among them."""
        return ByName({**self.edges, **{name: frame.edge for name, frame in self.frames.items()}})

    def __repr__(self) -> str:
        title = f"Calibration of {self.session_name!r}: {self.verdict.status}"
        return text_card(title, self._facts)

    def _repr_html_(self) -> str:
        steps = (f"Next: {step}" for step in self.verdict.next_steps[:1])
        says = (*self.verdict.top, *steps)
        title = f"Calibration of {self.session_name}"
        return html_card(title, self._facts, self.verdict.status, says)

    @property
    def _facts(self) -> dict[str, str]:
        used = sum(view.used for view in self.views)
        left_out = self.validation.held_out
        turned = "" if left_out.deg is None else f", {figure(left_out.deg)} deg"
        return {
            "views used": f"{used} of {len(self.views)}",
            "left out, predicted to": f"{figure(left_out.mm)} mm{turned}",
            **{
                name: f"{edge.place_words()}, {edge.sigma_words}"
                for name, edge in [*self.placed.items()][:_SHOWN]
            },
        }

    def views_table(self) -> Any:  # noqa: ANN401 - a frame of pandas, or records
        """What became of each view: a pandas.DataFrame with the extra pandas, else records.

        Columns are the attributes of `ViewResult`; what was not computed is None (NaN in a frame).
        """
        records = [asdict(view) for view in self.views]
        if find_spec("pandas") is None:
            return records
        return import_module("pandas").DataFrame.from_records(records, index="view")

    @typed
    def plot(self, what: str = "residuals") -> "Drawing":
        """Draws a figure of the report, which a notebook shows and `save` writes as .svg.

        Args:
            what: `residuals` of each view, the `budget` of a pick's error, or the `directions` of
                the transforms and how well each is known.

        Raises:
            DataError: There is no such figure.
        """
        # Figures are built on results; only this one call goes the other way.
        from visioncal.present.report.drawing import draw

        return draw(self, what)

    @property
    def noise_dof(self) -> float:
        """Degrees of freedom of the noise's levels; see `estimation.intervals.freedom_of`."""
        intervals = {} if self.uncertainty is None else self.uncertainty.noise_95
        return freedom_of(intervals.values()) if intervals else np.inf

    @typed
    def covariance(self, name: str) -> FloatArray:
        """Covariance of one transform.

        Args:
            name: Its name, such as `flange_from_cam`.

        Returns:
            (6, 6) of (rotation [rad], translation [m]), right perturbation.

        Raises:
            DataError: There is no transform of that name.
        """
        return self.placed[name].covariance

    @typed
    def base_from_flange(
        self,
        q: FloatArray,
        *,
        payload_kg: float | FloatArray = 0.0,
        payload_m: FloatArray | Sequence[float] = (0.0, 0.0, 0.0),
        force_n: FloatArray | Sequence[float] = (0.0, 0.0, 0.0),
        temperatures_c: FloatArray | None = None,
    ) -> RigidTransform:
        """Forward kinematics of the calibrated robot, which bends where that was calibrated.

        Args:
            q: (m, n) joint angles [rad].
            payload_kg: Mass on the flange beside the arm's own weight; one for all, or (m,) [kg].
            payload_m: (3,) or (m, 3) its centre in the flange's frame [m].
            force_n: (3,) or (m, 3) external force on the flange's origin, in the base's frame [N].
            temperatures_c: (m, n) of the links behind the joints, or (n,) for all [deg C]; None for
                those at which the views began. `OnlineCompensator` gives them.

        Returns:
            m transforms, as one batched RigidTransform.

        Raises:
            DataError: The session named no known robot, q has another number of joints or is not
                finite, a load is none, or temperatures are given and none were calibrated.
        """
        q = np.atleast_2d(np.asarray(q, dtype=float))
        wrong = np.flatnonzero(~np.isfinite(q).all(axis=1))
        if wrong.size:
            raise DataError(f"q[{wrong[0]}] is not finite.", culprits=[f"q[{wrong[0]}]"])
        loads = Loads.alike(len(q), payload_kg, payload_m, force_n)
        standing = self.standing(q, loads)
        if temperatures_c is not None:
            standing = standing @ self.drift.motion(q, np.asarray(temperatures_c, dtype=float))
        return RigidTransform.from_matrix(standing)

    def standing(self, q: FloatArray, loads: Loads | None = None) -> FloatArray:
        """What `base_from_flange` gives, as (m, 4, 4).

        Args:
            q: (m, n) joint angles [rad].
            loads: What the flange carries; the arm's own weight alone where None.

        Raises:
            DataError: The session named no known robot, or q has another number of joints.
        """
        arm = self.calibrated_robot
        if arm is None:
            raise DataError(
                "this calibration holds no robot model.",
                next_step="Name one in the session's [robot] table and calibrate again."
                if self.cell is None
                else "It is of a whole cell: take one robot out of it with of(robot=...).",
            )
        return arm.base_from_flange(
            bent_joints(arm, q, self.compliance, loads, self.weight_moments)
        )

    @property
    def compliance(self) -> FloatArray:
        """(n,) what each joint yields to a torque [rad/(N m)]; zero where that is not known."""
        if self.elastic is None:
            return np.zeros(0 if self.robot is None else self.robot.joint_count)
        return self.elastic.compliance

    @cached_property
    def drift(self) -> ThermalModel:
        """How the arm drifts with its temperature.

        Raises:
            DataError: That was not calibrated.
        """
        arm = self.calibrated_robot
        if arm is None or self.thermal is None:
            raise DataError(
                f"calibration {self.session_name!r} does not say how its arm drifts with "
                "temperature.",
                culprits=["temperatures"],
                next_step="Record reference views while the arm warms up, with temp1_c ... or "
                "current1_a ..., and calibrate with --level thermal.",
            )
        return self.thermal.model(arm)

    @typed
    def at_temperatures(self, temperatures_c: FloatArray) -> Self:
        """Returns the calibration of the arm as it is with its links at (n,) temperatures [deg C].

        Raises:
            DataError: It does not say how the arm drifts, or has another number of joints.
        """
        warm = self.drift.robot_at(np.asarray(temperatures_c, dtype=float))
        return replace(
            self, arm=replace(self.arm or ArmResult(level=NOMINAL, levels=()), robot=warm)
        )

    @property
    def arm_is_calibrated(self) -> bool:
        """Whether the transforms go with a calibrated arm, and not with the controller's."""
        return self.arm is not None and self.arm.robot is not None

    @property
    def calibrated_robot(self) -> Robot | None:
        """The arm as it was calibrated, or else its nominal model, where there is one."""
        return self.robot if self.arm is None or self.arm.robot is None else self.arm.robot

    @property
    def weight_moments(self) -> FloatArray | None:
        """(n, 4 n) compliance times unknown masses and first moments; None where none were found.

        What `bent_joints` takes of an arm whose model does not state the masses of its links.
        """
        return None if self.elastic is None else self.elastic.weight_moments

    @typed
    def save(self, path: Path | str) -> None:
        """Writes calibration.json, whole or not at all."""
        write_atomically(Path(path), self.text + "\n")

    @cached_property
    def text(self) -> str:
        """The content of calibration.json, which recordings hold, too."""
        return json.dumps(to_document(self), indent=2, allow_nan=False)

    @classmethod
    @typed
    def load(cls, path: Path | str) -> Self:
        """Reads a calibration.json or an alignment.json, or the one in a folder.

        Raises:
            DataError: The file is missing or is not a calibration of a known schema.
        """
        file = Path(path)
        if file.is_dir():
            before = file / ALIGNMENT
            file = file / "calibration.json"
            # A cell that was aligned by an older version.
            file = before if before.is_file() and not file.exists() else file
            if not file.exists() and (file.parent / DYNAMICS_FILE).is_file():
                raise DataError(
                    f"{path} is a result of visioncal dynamics identify, and has no calibration.",
                    culprits=[str(path)],
                    next_step="Its report is the report.html there; name an output folder of "
                    "visioncal calibrate here.",
                )
        if file.suffix.lower() == ".rrd":
            raise DataError(
                f"{path} is a recording; a calibration.json, or the folder with one, is needed.",
                culprits=[str(path)],
                next_step="Name the output folder of visioncal calibrate. Of a recording alone, "
                "visioncal.present.recording.read_calibration reads the result.",
            )
        return cls.from_json(read_bytes(file), str(file))

    @classmethod
    def from_json(cls, text: bytes | str, label: str) -> Self:
        """Reads the content of a calibration.json.

        Args:
            text: The content.
            label: What it came from, for messages.

        Raises:
            DataError: It is not a calibration of a known schema.
        """
        with reading(label, "a calibration", "Calibrate the session again."):
            return cls(**fields_from_document(parse_stored(text, label)))
