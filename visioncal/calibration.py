"""The result of a calibration, and calibration.json."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias

import numpy as np
from scipy.spatial.transform import RigidTransform

from visioncal.errors import DataError
from visioncal.files import read_bytes, write_atomically
from visioncal.robot import Robot
from visioncal.types import Camera, FloatArray, Mount
from visioncal.version import __version__

SCHEMA = 1

VerdictStatus: TypeAlias = Literal["good", "check", "bad"]


@dataclass(frozen=True, eq=False)
class Edge:
    """An edge of the tree of frames that was estimated.

    Attributes:
        transform: The edge, named `a_from_b` by its owner.
        covariance: (6, 6) of its (rotation [rad], translation [m]) perturbation on the right.
    """

    transform: RigidTransform
    covariance: FloatArray

    @property
    def sigma_mm(self) -> float:
        """Root of the trace of the translation's covariance [mm]."""
        return float(1e3 * np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def sigma_deg(self) -> float:
        """Root of the trace of the rotation's covariance [deg]."""
        return float(np.rad2deg(np.sqrt(np.trace(self.covariance[:3, :3]))))


@dataclass(frozen=True, eq=False)
class SolverResult:
    """What one solver made of the used views.

    Attributes:
        transforms: Both edges by name.
        rms_mm: Scatter of the target's position over the used views [mm].
        rms_deg: Scatter of the target's orientation over the used views [deg].
    """

    transforms: Mapping[str, RigidTransform]
    rms_mm: float
    rms_deg: float


@dataclass(frozen=True, eq=False)
class CameraResult:
    """The camera that the result was obtained with.

    Attributes:
        camera: The intrinsics.
        estimated: Whether they were estimated from this session's images.
        covariance: (k, k) of fx, fy, cx, cy and the distortion, where estimated.
    """

    camera: Camera
    estimated: bool
    covariance: FloatArray | None = None


@dataclass(frozen=True)
class ViewResult:
    """What became of one view. A figure that could not be computed is None, and absent on disk.

    Attributes:
        view: The view's number.
        used: Whether the fit used it.
        reason: Why it was not used, in words; empty for a used view.
        corners: How many corners were found.
        rms_px: Reprojection error through the whole chain of frames [px].
        residual_mm: Distance of the target, as this view places it, from its mean place [mm].
        residual_deg: The same in rotation [deg].
    """

    view: int
    used: bool
    reason: str = ""
    corners: int | None = None
    rms_px: float | None = None
    residual_mm: float | None = None
    residual_deg: float | None = None


@dataclass(frozen=True)
class Rms:
    """Root mean square residuals; `px` is None where no image was used."""

    mm: float
    deg: float
    px: float | None = None


@dataclass(frozen=True)
class Validation:
    """Residuals of views that the fit had not seen.

    Attributes:
        method: How views were left out, in words.
        held_out: Their residuals, over all used views in turn.
        holdout: Residuals of the views that the session declares as `holdout`.
    """

    method: str
    held_out: Rms
    holdout: Rms | None = None


@dataclass(frozen=True)
class Verdict:
    """Whether the result can be trusted: a status and the reasons in plain sentences."""

    status: VerdictStatus
    reasons: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of calibrating one session; `save` writes it as calibration.json.

    Attributes:
        session_name: The session's name.
        session_sha256: Digest of the session's canonical content.
        created: When, in ISO 8601.
        mount: How the camera is mounted.
        edges: The estimated edges by name, in the order of `joint_covariance`.
        joint_covariance: (6 k, 6 k) covariance of all edges together, in that order.
        solvers: What every solver made of it.
        noise: Estimated standard deviations by name.
        views: One entry for each view of the session.
        rms: Residuals over the used views.
        validation: Residuals of views that were left out.
        verdict: Whether to trust it.
        camera: The camera, where the session has one.
        robot: The nominal robot model, where the session names a known one.
        stages: One document for each further stage that ran, by name.
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
    stages: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def transforms(self) -> dict[str, RigidTransform]:
        """The estimated transforms by name."""
        return {name: edge.transform for name, edge in self.edges.items()}

    def covariance(self, name: str) -> FloatArray:
        """Covariance of one edge.

        Args:
            name: An edge's name, such as `flange_from_cam`.

        Returns:
            (6, 6) of (rotation [rad], translation [m]), right perturbation.

        Raises:
            DataError: There is no edge of that name.
        """
        if name not in self.edges:
            raise DataError(f"no edge {name!r}: this calibration has {', '.join(self.edges)}.")
        return self.edges[name].covariance

    def base_from_flange(self, q: FloatArray) -> RigidTransform:
        """Forward kinematics of the calibrated robot.

        Args:
            q: (m, n) joint angles [rad].

        Returns:
            m transforms, as one batched RigidTransform.

        Raises:
            DataError: The session named no known robot, or q has another number of joints.
        """
        if self.robot is None:
            raise DataError(
                "this calibration holds no robot model.",
                next_step="Name one in the session's [robot] table and calibrate again.",
            )
        return RigidTransform.from_matrix(self.robot.base_from_flange(np.atleast_2d(q)))

    def save(self, path: Path | str) -> None:
        """Writes calibration.json, whole or not at all."""
        write_atomically(Path(path), json.dumps(to_document(self), indent=2) + "\n")

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Reads a calibration.json, or the one in a folder.

        Raises:
            DataError: The file is missing or is not a calibration of a known schema.
        """
        file = Path(path)
        file = file / "calibration.json" if file.is_dir() else file
        try:
            return cls(**_fields_from_document(json.loads(read_bytes(file))))
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise DataError(f"{file}: not JSON: {error}.") from error
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise DataError(
                f"{file}: not a calibration that this version can read: {error!r}.",
                next_step="Calibrate the session again.",
            ) from error


def to_document(calibration: Calibration) -> dict[str, Any]:
    """Builds the content of calibration.json; what was not computed is absent."""
    camera, robot = calibration.camera, calibration.robot
    document: dict[str, Any] = {
        "schema": SCHEMA,
        "visioncal": __version__,
        "created": calibration.created,
        "session": {"name": calibration.session_name, "sha256": calibration.session_sha256},
        "mount": calibration.mount,
        "transforms": {name: _edge_document(edge) for name, edge in calibration.edges.items()},
        "joint_covariance": {
            "order": list(calibration.edges),
            "matrix": calibration.joint_covariance.tolist(),
        },
        "solvers": {name: _solver_document(it) for name, it in calibration.solvers.items()},
    }
    if camera is not None:
        document["camera"] = _camera_document(camera)
    if robot is not None:
        document["robot"] = dict(robot.document)
    return document | {
        "noise": dict(calibration.noise),
        "views": [_present(vars(view)) for view in calibration.views],
        "rms": _present(vars(calibration.rms)),
        "validation": _validation_document(calibration.validation),
        "verdict": {
            "status": calibration.verdict.status,
            "reasons": list(calibration.verdict.reasons),
        },
        **calibration.stages,
    }


def _present(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _pose_document(transform: RigidTransform) -> dict[str, Any]:
    return {
        "matrix": transform.as_matrix().tolist(),
        "quaternion_xyzw": transform.rotation.as_quat().tolist(),
        "translation_m": transform.translation.tolist(),
    }


def _edge_document(edge: Edge) -> dict[str, Any]:
    return _pose_document(edge.transform) | {
        "covariance": edge.covariance.tolist(),
        "sigma_mm": edge.sigma_mm,
        "sigma_deg": edge.sigma_deg,
    }


def _solver_document(result: SolverResult) -> dict[str, Any]:
    poses = {name: _pose_document(pose) for name, pose in result.transforms.items()}
    return poses | {"rms_mm": result.rms_mm, "rms_deg": result.rms_deg}


def _camera_document(result: CameraResult) -> dict[str, Any]:
    camera = result.camera
    return _present(
        {
            "model": camera.model,
            "resolution": list(camera.resolution),
            "matrix": camera.matrix.tolist(),
            "distortion": camera.distortion.tolist(),
            "estimated": result.estimated,
            "covariance": None if result.covariance is None else result.covariance.tolist(),
        }
    )


def _validation_document(validation: Validation) -> dict[str, Any]:
    document: dict[str, Any] = {
        "method": validation.method,
        "held_out": _present(vars(validation.held_out)),
    }
    if validation.holdout is not None:
        document["holdout"] = _present(vars(validation.holdout))
    return document


_OWN_KEYS = frozenset(
    {"schema", "visioncal", "created", "session", "mount", "transforms", "joint_covariance"}
    | {"solvers", "camera", "robot", "noise", "views", "rms", "validation", "verdict"}
)


def _fields_from_document(document: Mapping[str, Any]) -> dict[str, Any]:
    if document["schema"] != SCHEMA:
        raise ValueError(f"schema is {document['schema']!r}, this version reads {SCHEMA}")
    camera = document.get("camera")
    robot = document.get("robot")
    verdict = document["verdict"]
    return {
        "session_name": document["session"]["name"],
        "session_sha256": document["session"]["sha256"],
        "created": document["created"],
        "mount": document["mount"],
        "edges": {
            name: Edge(_pose(edge), np.asarray(edge["covariance"], dtype=float))
            for name, edge in document["transforms"].items()
        },
        "joint_covariance": np.asarray(document["joint_covariance"]["matrix"], dtype=float),
        "solvers": {name: _solver(it) for name, it in document["solvers"].items()},
        "noise": dict(document["noise"]),
        "views": tuple(ViewResult(**view) for view in document["views"]),
        "rms": Rms(**document["rms"]),
        "validation": _validation(document["validation"]),
        "verdict": Verdict(verdict["status"], tuple(verdict["reasons"])),
        "camera": None if camera is None else _camera(camera),
        "robot": None if robot is None else Robot.from_document(robot),
        "stages": {name: value for name, value in document.items() if name not in _OWN_KEYS},
    }


def _pose(document: Mapping[str, Any]) -> RigidTransform:
    matrix = np.asarray(document["matrix"], dtype=float)
    rotation = matrix[:3, :3]
    if matrix.shape != (4, 4) or not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-9):
        raise ValueError("a matrix is not a rigid transform")
    return RigidTransform.from_matrix(matrix)


def _solver(document: Mapping[str, Any]) -> SolverResult:
    poses = {name: _pose(it) for name, it in document.items() if isinstance(it, Mapping)}
    return SolverResult(poses, document["rms_mm"], document["rms_deg"])


def _camera(document: Mapping[str, Any]) -> CameraResult:
    width, height = document["resolution"]
    covariance = document.get("covariance")
    return CameraResult(
        Camera(
            document["model"],
            (int(width), int(height)),
            np.asarray(document["matrix"], dtype=float),
            np.asarray(document["distortion"], dtype=float),
        ),
        document["estimated"],
        None if covariance is None else np.asarray(covariance, dtype=float),
    )


def _validation(document: Mapping[str, Any]) -> Validation:
    holdout = document.get("holdout")
    return Validation(
        document["method"],
        Rms(**document["held_out"]),
        None if holdout is None else Rms(**holdout),
    )
