"""Transform with covariance, and their form in files."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.choices import PoseForm as PoseNotation
from visioncal.core.codec import Array, WrittenForm
from visioncal.core.conventions import ROTATION_FORMS
from visioncal.core.documents.pendants import rotation_names
from visioncal.core.errors import DataError
from visioncal.core.number_format import fixed, sigma_words
from visioncal.core.types import FloatArray

# Largest difference between the forms of one pose, rounded to six places [m, rad].
_SAME = 5e-6
# Tolerance of correlations for symmetry and definiteness: rounding of J C J^T is amplified where a
# rotation is known much better than the translation.
_ROUNDING = 1e-3


class PoseSigmas:
    """Sigmas of a pose from its covariance of (rotation [rad], translation [m])."""

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
class Edge(PoseSigmas):
    """Estimated edge of the tree of frames."""

    matrix: FloatArray  # (4, 4) the transform, named `a_from_b` by its owner, exactly as on disk.
    # (6, 6) of its (rotation [rad], translation [m]) perturbation on the right.
    covariance: FloatArray

    @property
    def transform(self) -> RigidTransform:
        """The edge as a transform; scipy makes the matrix orthonormal, to the last digit."""
        return RigidTransform.from_matrix(self.matrix)

    @property
    def oriented(self) -> bool:
        """Whether its rotation was estimated; else it is declared, and has no covariance."""
        return bool(self.covariance[:3, :3].any())

    @property
    def sigma_words(self) -> str:
        """The transform's sigmas in words."""
        turned = f" and {sigma_words(self.sigma_deg, 'deg')}" if self.oriented else ""
        return f"sigma {sigma_words(self.sigma_mm, 'mm')}{turned}"

    def place_words(self, decimals: int = 2) -> str:
        """The translation in words, in millimetres with `decimals` decimals."""
        x, y, z = (f"{1e3 * value:.{decimals}f}" for value in self.transform.translation)
        return f"({x}, {y}, {z}) mm"

    def rotation_words(self, controller: PoseNotation | None = None) -> str:
        """The rotation in words, by `rotations`."""
        forms = (f"{name} ({numbers}) {unit}" for name, numbers, unit in self.rotations(controller))
        return ", ".join(map(str.strip, forms)) if self.oriented else "rotation not measured"

    def rotations(self, controller: PoseNotation | None = None) -> Iterator[tuple[str, str, str]]:
        """The rotation vector, and the rotation as a robot's controller states it.

        Yields:
            Name of the form, numbers with commas between, and their unit.
        """
        forms = [("rotation vector", "rotation-vector-deg", "deg")]
        if controller is not None:
            names = controller.words.partition("Z, ")[2] or ", ".join(rotation_names(controller))
            unit = {"deg": "deg", "rad": "rad", "tor": "rad"}.get(controller.rotation[-3:], "")
            forms.append((f"{controller.name.upper()} {names}", controller.rotation, unit))
        for name, rotation, unit in forms:
            numbers = ROTATION_FORMS[rotation].write(self.matrix[None, :3, :3])[0]
            # A tenth of a millidegree, and less of quaternions: under any sigma of a camera.
            decimals = 4 if unit == "deg" else 6
            yield name, ", ".join(fixed(number, decimals) for number in numbers), unit


def _covariance_fault(matrix: FloatArray) -> str:
    """Why a matrix is no covariance; empty for one."""
    variance = np.diagonal(matrix)
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    fault = "is no covariance"
    if matrix.shape[0] != matrix.shape[1] or (variance < 0.0).any():
        return fault
    with np.errstate(over="ignore"):
        scaled = matrix / scale[:, None] / scale
    if (
        np.abs(scaled).max(initial=0.0) > 1.0 + _ROUNDING
        or np.abs(scaled - scaled.T).max(initial=0.0) > _ROUNDING
        or (len(scaled) and np.linalg.eigvalsh(scaled)[0] < -_ROUNDING)
    ):
        return fault
    return ""


Covariance = Annotated[FloatArray, Array((-1, -1), _covariance_fault)]


@dataclass(frozen=True, eq=False)
class PoseForm:
    """Transform in several redundant forms for readers."""

    matrix: Annotated[FloatArray, Array((4, 4))]  # (4, 4), its translation in metres.
    quaternion_xyzw: Annotated[FloatArray, Array((4,))]  # (4,) its rotation.
    translation_m: Annotated[FloatArray, Array((3,))]  # (3,) its translation [m].

    @classmethod
    def of(cls, matrix: FloatArray) -> "PoseForm":
        """Form of a (4, 4) transform."""
        transform = RigidTransform.from_matrix(matrix)
        return cls(matrix, transform.rotation.as_quat(), matrix[:3, 3])

    def pose(self, path: str) -> FloatArray:
        """(4, 4) the checked transform; raises DataError."""
        matrix, rotation = self.matrix, self.matrix[:3, :3]
        if (
            matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]
            or np.abs(rotation).max() > 2.0
            or not np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-9)
            or np.linalg.det(rotation) < 0
        ):
            raise DataError(f"{path}.matrix is not a rigid transform.", culprits=[path])
        turned = Rotation.from_quat(self.quaternion_xyzw).as_matrix()
        stated, name = self.translation_m, path.rpartition(".")[2]
        for form, value, same in (
            ("translation_m", stated, np.allclose(stated, matrix[:3, 3], 0.0, _SAME)),
            ("quaternion_xyzw", self.quaternion_xyzw, np.allclose(turned, rotation, 0.0, _SAME)),
        ):
            if not same:
                raise DataError(
                    f"{name}: {form} is {value.tolist()}, and its matrix is that of another pose: "
                    f"{matrix.tolist()}.",
                    culprits=[f"{name}: {form}", f"{name}: matrix"],
                    next_step="Somebody changed one of them: take the file as calibrate wrote it.",
                )
        return matrix


@dataclass(frozen=True, eq=False)
class EdgeForm(PoseForm):
    """Transform with its covariance."""

    # (6, 6) of its (rotation [rad], translation [m]) perturbation on the right.
    covariance: Annotated[FloatArray, Array((6, 6), _covariance_fault)]
    sigma_mm: float  # Root of the trace of the translation's covariance [mm].
    sigma_deg: float  # Root of the trace of the rotation's covariance [deg].


StoredPose = Annotated[FloatArray, WrittenForm(PoseForm.of, PoseForm.pose, PoseForm)]
StoredEdge = Annotated[
    Edge,
    WrittenForm(
        lambda edge: EdgeForm(
            **vars(PoseForm.of(edge.matrix)),
            covariance=edge.covariance,
            sigma_mm=edge.sigma_mm,
            sigma_deg=edge.sigma_deg,
        ),
        lambda item, path: Edge(item.pose(path), item.covariance),
        EdgeForm,
    ),
]


@dataclass(frozen=True, eq=False)
class JointCovariance:
    """Joint covariance of all transforms, and their names in its order."""

    order: tuple[str, ...]
    matrix: Covariance
