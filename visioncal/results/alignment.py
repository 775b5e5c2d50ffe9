"""The result of aligning a whole cell: every frame of it, with respect to every other."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.core.arguments import typed
from visioncal.core.codec import KEPT, names_but, read, reading, write
from visioncal.core.documents import parse_stored
from visioncal.core.errors import DataError
from visioncal.core.files import did_you_mean, read_bytes, write_json
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.core.verdict import Verdict
from visioncal.core.version import __version__
from visioncal.estimation.tree import Branch, Step, Tree
from visioncal.results.edge import Edge, JointCovariance, StoredEdge
from visioncal.results.frame import Frame
from visioncal.results.lens import CameraResult
from visioncal.results.parts import (
    SCHEMA,
    NeedMet,
    RobotResult,
    SessionForm,
    StoredVerdict,
    check_schema,
)
from visioncal.results.sections import CellDetails, CellSections

FILE = "alignment.json"


@dataclass(frozen=True)
class Sight:
    """What became of one observation. A figure that could not be computed is None.

    Attributes:
        view: The number of its row.
        stop: Its stop, or the view's number where the session has none.
        seer: The frame of the camera or instrument.
        seen: The frame of the target or point.
        used: Whether the fit used it.
        reason: Why it was not used, in words; empty for a used one.
        residual_mm: How far it is from what the rest of the cell predicts [mm].
        residual_deg: The same in rotation [deg]; None where a place alone was read.
        corners: How many corners were found in its image.
        rms_px: Reprojection error through the whole chain of frames [px].
        left_out_mm: How far it is from what a fit predicts that was made without its stop [mm].
        left_out_deg: The same in rotation [deg].
        left_out_px: Reprojection error by such a fit [px].
    """

    view: int
    stop: int
    seer: str
    seen: str
    used: bool
    reason: Annotated[str, KEPT] = ""
    residual_mm: float | None = None
    residual_deg: float | None = None
    corners: int | None = None
    rms_px: float | None = None
    left_out_mm: float | None = None
    left_out_deg: float | None = None
    left_out_px: float | None = None


@dataclass(frozen=True)
class Moved:
    """A frame that moved while the session was taken.

    Attributes:
        frame: The frame; its transform in the result is where it stood last.
        before: Its name in the result until then.
        last_stop: The last stop at which it was seen where it stood before.
        first_stop: The first stop at which it stands elsewhere.
        shift_mm: How far its origin moved [mm].
        turn_deg: How far it turned [deg].
        rivals: Frames that may have moved in its place: the session does not show which.
    """

    frame: str
    before: str
    last_stop: int
    first_stop: int
    shift_mm: float
    turn_deg: float
    rivals: Annotated[tuple[str, ...], KEPT] = ()


@dataclass(frozen=True)
class Untied:
    """A frame that nothing ties to the rest, and what would, in a sentence."""

    frame: str
    remedy: str


@dataclass(frozen=True, eq=False)
class Alignment(CellSections):
    """A whole cell in one frame; `save` writes it as alignment.json. See also `CellSections`.

    Attributes:
        session_name: The session's name.
        session_sha256: Digest of the session's canonical content.
        created: When, in ISO 8601.
        reference: The frame that stands for the cell: the cell's frame is its.
        frames: What each frame hangs on, by its name.
        robots: The robot of each flange, by the flange's frame.
        edges: The estimated transforms by name, as `cell_from_base_b`, in the order of
            `joint_covariance`.
        joint_covariance: (6 k, 6 k) covariance of all of them together, in that order.
        cameras: The cameras by their frames.
        noise: Estimated standard deviations, by frame or robot and by name.
        sights: One entry for each observation.
        moved: What moved while the session was taken.
        untied: Frames that nothing ties to the rest.
        weakest: The weakest link, in words.
        verdict: Whether to trust it.
        details: Further figures.
        arms: The robots by name; one that has no name goes by `robot`.
        targets: What was printed, by name as it is described.
        placed: Tools and fixtures by the transform that places them, as `flange_a_from_tool`.
        left_out: How observations were left out of fits in turn, in words; empty where none was.
        need: What the task needs, and how likely picks meet it; None where that is not said.
    """

    session_name: str
    session_sha256: str
    created: str
    reference: str
    frames: Mapping[str, str]
    robots: Mapping[str, str]
    edges: Mapping[str, Edge]
    joint_covariance: FloatArray
    cameras: Mapping[str, CameraResult]
    noise: Mapping[str, Mapping[str, float]]
    sights: tuple[Sight, ...]
    moved: tuple[Moved, ...]
    untied: tuple[Untied, ...]
    weakest: str
    verdict: Verdict
    details: CellDetails = field(default_factory=CellDetails)
    arms: Mapping[str, RobotResult] = field(default_factory=dict)
    targets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    placed: Mapping[str, Frame] = field(default_factory=dict)
    left_out: str = ""
    need: NeedMet | None = None

    @property
    def transforms(self) -> dict[str, RigidTransform]:
        """The estimated transforms by name."""
        return {name: edge.transform for name, edge in self.edges.items()}

    @typed
    def edge_of(self, frame: str) -> Edge:
        """How a frame hangs on its parent; the reference, exactly in the cell's place."""
        if frame == self.reference:
            return Edge(np.eye(4), np.zeros((6, 6)))
        return self.edges[f"{self.frames[frame]}_from_{frame}"]

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
                they count as exact.

        Returns:
            `first_from_second`.

        Raises:
            DataError: There is no such frame, or a robot's pose is needed.
        """
        near, far = self.placement(first), self.placement(second)
        matrix, slope = self.way(near[0] if near else first, far[0] if far else second, poses)
        covariance = slope @ self.joint_covariance @ slope.T
        if far:
            carry = adjoint(invert(far[1].edge.matrix))
            matrix = matrix @ far[1].edge.matrix
            covariance = carry @ covariance @ carry.T + far[1].edge.covariance
        if near:
            matrix = invert(near[1].edge.matrix) @ matrix
            carry = adjoint(invert(matrix))
            covariance = covariance + carry @ near[1].edge.covariance @ carry.T
        if not all(pair[1].oriented for pair in (near, far) if pair):
            covariance[:3], covariance[:, :3] = 0.0, 0.0
        return Edge(matrix, covariance)

    def placement(self, name: str) -> tuple[str, Frame] | None:
        """The frame in which a tool or a fixture was placed, and its place; None for no such."""
        for transform, frame in self.placed.items():
            parent, _, child = transform.partition("_from_")
            if child == name:
                return parent, frame
        return None

    def way(
        self, first: str, second: str, poses: Mapping[str, FloatArray] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """The transform of `between`, (4, 4), and (6, 6 k) how it moves with all edges."""
        tree, poses = self._tree, poses or {}
        for frame in (first, second):
            if frame != tree.root and frame not in tree.branches:
                placed = (name.partition("_from_")[2] for name in self.placed)
                known = [tree.root, *tree.branches, *placed]
                raise DataError(
                    f"no frame {frame!r}: this alignment has {', '.join(known)}.",
                    culprits=[frame],
                    next_step=did_you_mean(frame, known),
                )
        way, places = tree.path(first, second), {edge: at for at, edge in enumerate(self.edges)}
        rest, slope = np.eye(4), np.zeros((6, 6 * len(places)))
        for step in reversed(way):
            edge = self._matrix(step, poses)
            before = invert(edge) @ rest if step.is_up else edge @ rest
            moved = -adjoint(invert(before)) if step.is_up else adjoint(invert(rest))
            at = places.get(f"{self.frames[step.frame]}_from_{step.frame}")
            if at is not None:
                slope[:, 6 * at : 6 * at + 6] += moved
            rest = before
        return rest, slope

    @property
    def _tree(self) -> Tree:
        return Tree(
            "cell",
            {name: Branch(on, self.robots.get(name, "")) for name, on in self.frames.items()},
        )

    def _matrix(self, step: Step, poses: Mapping[str, FloatArray]) -> FloatArray:
        if not step.robot:
            return self.edge_of(step.frame).matrix
        if step.robot not in poses:
            raise DataError(
                f"{step.frame} moves with robot {step.robot!r}: its pose is needed.",
                culprits=[step.frame],
                next_step="Name frames that no robot moves against each other; or in Python, give "
                f'poses={{"{step.robot}": base_from_flange}}.',
            )
        return np.asarray(poses[step.robot], dtype=float)

    def document(self) -> dict[str, Any]:
        """Builds the content of alignment.json; what was not computed is absent."""
        form = AlignmentForm(
            schema=SCHEMA,
            session=SessionForm(self.session_name, self.session_sha256),
            transforms=self.edges,
            joint_covariance=JointCovariance.of(self.edges, self.joint_covariance),
            observations=self.sights,
            **{name: getattr(self, name) for name in _SAME},
        )
        return write(AlignmentForm, form)

    @typed
    def save(self, path: Path | str) -> None:
        """Writes alignment.json, whole or not at all."""
        write_json(path, self.document())

    @classmethod
    @typed
    def load(cls, path: Path | str) -> Self:
        """Reads an alignment.json, or the one in a folder.

        Raises:
            DataError: The file is missing or is not an alignment of a known schema.
        """
        file = Path(path)
        file = file / FILE if file.is_dir() else file
        return cls.from_json(read_bytes(file), str(file))

    @classmethod
    def from_json(cls, text: bytes | str, label: str) -> Self:
        """Reads the content of an alignment.json.

        Args:
            text: The content.
            label: What it came from, for messages.

        Raises:
            DataError: It is not an alignment of a known schema.
        """
        with reading(label, "an alignment", "Run visioncal align again."):
            return cls.from_document(parse_stored(text, label))

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Self:
        """Reads what `document` built.

        Raises:
            DataError: It is another, or of another schema; the message names the place.
        """
        check_schema(document)
        form = read(AlignmentForm, document, "")
        return cls(
            session_name=form.session.name,
            session_sha256=form.session.sha256,
            edges=form.transforms,
            joint_covariance=form.joint_covariance.matrix,
            sights=form.observations,
            **{name: getattr(form, name) for name in _SAME},
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class AlignmentForm:
    """alignment.json; its fields are those of `Alignment`, but for what `CalibrationForm` has."""

    schema: Literal[1]
    visioncal: str = __version__
    created: str
    session: SessionForm
    reference: str
    frames: Mapping[str, str]
    robots: Mapping[str, str]
    transforms: Mapping[str, StoredEdge]
    joint_covariance: JointCovariance
    cameras: Mapping[str, CameraResult]
    noise: Mapping[str, Mapping[str, float]]
    observations: tuple[Sight, ...]
    moved: tuple[Moved, ...]
    untied: tuple[Untied, ...]
    weakest: str
    verdict: StoredVerdict
    need: NeedMet | None = None
    details: CellDetails


# Fields that an alignment has under the same names.
_SAME = names_but(
    AlignmentForm, "schema visioncal session transforms joint_covariance observations"
)


def is_alignment(document: Mapping[str, Any]) -> bool:
    """Tells an alignment by its content: the calibration of one camera has no reference."""
    return {"reference", "transforms"} <= document.keys()
