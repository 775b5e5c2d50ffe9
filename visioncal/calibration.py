"""The result of a calibration, and calibration.json."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias, get_args

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
        matrix: (4, 4) the edge, named `a_from_b` by its owner, exactly as it stands on disk.
        covariance: (6, 6) of its (rotation [rad], translation [m]) perturbation on the right.
    """

    matrix: FloatArray
    covariance: FloatArray

    @property
    def transform(self) -> RigidTransform:
        """The edge as a transform; scipy makes it orthonormal anew, to the last digit."""
        return RigidTransform.from_matrix(self.matrix)

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
        matrices: (4, 4) both edges by name.
        rms_mm: Scatter of the target's position over the used views [mm].
        rms_deg: Scatter of the target's orientation over the used views [deg].
    """

    matrices: Mapping[str, FloatArray]
    rms_mm: float
    rms_deg: float

    @property
    def transforms(self) -> dict[str, RigidTransform]:
        """Both edges by name."""
        return {name: RigidTransform.from_matrix(it) for name, it in self.matrices.items()}


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
        write_atomically(
            Path(path), json.dumps(to_document(self), indent=2, allow_nan=False) + "\n"
        )

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Reads a calibration.json, or the one in a folder.

        Raises:
            DataError: The file is missing or is not a calibration of a known schema.
        """
        file = Path(path)
        file = file / "calibration.json" if file.is_dir() else file
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
        try:
            return cls(**_fields_from_document(json.loads(text)))
        except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise DataError(f"{label}: not JSON: {error}.") from error
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise DataError(
                f"{label}: not a calibration that this version can read: {error!r}.",
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


def _pose_document(matrix: FloatArray) -> dict[str, Any]:
    transform = RigidTransform.from_matrix(matrix)
    return {
        "matrix": matrix.tolist(),
        "quaternion_xyzw": transform.rotation.as_quat().tolist(),
        "translation_m": matrix[:3, 3].tolist(),
    }


def _edge_document(edge: Edge) -> dict[str, Any]:
    return _pose_document(edge.matrix) | {
        "covariance": edge.covariance.tolist(),
        "sigma_mm": edge.sigma_mm,
        "sigma_deg": edge.sigma_deg,
    }


def _solver_document(result: SolverResult) -> dict[str, Any]:
    poses = {name: _pose_document(pose) for name, pose in result.matrices.items()}
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
    if document["mount"] not in get_args(Mount):
        raise ValueError(f"mount is {document['mount']!r}")
    if document["verdict"]["status"] not in get_args(VerdictStatus):
        raise ValueError(f"verdict.status is {document['verdict']['status']!r}")
    camera = document.get("camera")
    robot = document.get("robot")
    verdict = document["verdict"]
    return {
        "session_name": document["session"]["name"],
        "session_sha256": document["session"]["sha256"],
        "created": document["created"],
        "mount": document["mount"],
        "edges": {
            name: Edge(_pose(edge), _array(edge, "covariance", (6, 6)))
            for name, edge in document["transforms"].items()
        },
        "joint_covariance": _array(document["joint_covariance"], "matrix", (-1, -1)),
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


def _pose(document: Mapping[str, Any]) -> FloatArray:
    matrix = _array(document, "matrix", (4, 4))
    rotation = matrix[:3, :3]
    if not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-9) or np.linalg.det(rotation) < 0:
        raise ValueError("a matrix is not a rigid transform")
    return matrix


def _array(document: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> FloatArray:
    """Reads an array of finite numbers; a dimension of -1 is any, but the same throughout."""
    array = np.asarray(document[key], dtype=float)
    size = array.shape[0] if array.ndim else 0
    if array.shape != tuple(size if it < 0 else it for it in shape):
        raise ValueError(f"{key} has the shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{key} has entries that are no finite numbers")
    return array


def _solver(document: Mapping[str, Any]) -> SolverResult:
    poses = {name: _pose(it) for name, it in document.items() if isinstance(it, Mapping)}
    return SolverResult(poses, document["rms_mm"], document["rms_deg"])


def _camera(document: Mapping[str, Any]) -> CameraResult:
    width, height = document["resolution"]
    return CameraResult(
        Camera(
            document["model"],
            (int(width), int(height)),
            _array(document, "matrix", (4,)),
            _array(document, "distortion", (-1,)),
        ),
        document["estimated"],
        _array(document, "covariance", (-1, -1)) if "covariance" in document else None,
    )


def _validation(document: Mapping[str, Any]) -> Validation:
    holdout = document.get("holdout")
    return Validation(
        document["method"],
        Rms(**document["held_out"]),
        None if holdout is None else Rms(**holdout),
    )
