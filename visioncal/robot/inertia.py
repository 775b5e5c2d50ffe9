"""Inertial parameters of links: mass, first moments and second moments.

The pseudo-inertia of a body is positive definite, and has a Cholesky factor: log-Cholesky
coordinates (Rucker and Wensing 2022, Smooth parameterization of rigid-body inertia) are the entries
of that factor, with logarithms on the diagonal. Here they are relative to a known body, which is at
zero: a change of 0.1 is one of ten percent, whatever the body's size and position.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from visioncal.core.documents.toml import DocumentTable
from visioncal.core.errors import DataError
from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray
from visioncal.robot.loads import MASS_KEYS, Masses

# Key of a link's inertia in a joint's table.
INERTIA_KEY = "inertia_kg_m2"
# The ten parameters of a body; {} is the number of its joint.
PARAMETER_NAMES = (
    "m{0}",
    "m{0}*cx{0}",
    "m{0}*cy{0}",
    "m{0}*cz{0}",
    "Ixx{0}",
    "Ixy{0}",
    "Iyy{0}",
    "Ixz{0}",
    "Iyz{0}",
    "Izz{0}",
)
# Indices of xx, xy, yy, xz, yz, zz in a symmetric matrix.
_ROWS, _COLUMNS = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])


@dataclass(frozen=True, eq=False)
class Inertias:
    """The inertial parameters of an arm's n links."""

    # (n, 10) mass [kg], first moments [kg m] and inertia xx, xy, yy, xz, yz, zz [kg m^2] of all
    # that moves with each joint; in the joint's frame after its motion and about that frame's
    # origin.
    values: FloatArray

    @classmethod
    def of_bodies(cls, kg: FloatArray, centres_m: FloatArray, about: FloatArray) -> "Inertias":
        """From masses (n,) [kg], centres (n, 3) [m], inertias about these (n, 3, 3) [kg m^2]."""
        turned = np.array([skew(centre) for centre in centres_m])
        about_origin = about - kg[:, None, None] * turned @ turned
        moments = kg[:, None] * centres_m
        return cls(np.column_stack([kg, moments, symmetric_entries(about_origin)]))

    @property
    def masses(self) -> Masses:
        """Masses and their centres; a link without mass has its centre at the frame's origin."""
        kg = self.values[:, 0]
        weighs = np.where(kg == 0.0, 1.0, kg)
        return Masses(kg, np.where(kg[:, None] == 0.0, 0.0, self.values[:, 1:4] / weighs[:, None]))

    @property
    def about_centres(self) -> FloatArray:
        """(n, 3, 3) inertias about the centres of mass, along the frames' axes [kg m^2]."""
        masses = self.masses
        turned = np.array([skew(centre) for centre in masses.centres_m])
        found = symmetric_matrices(self.values[:, 4:]) + masses.kg[:, None, None] * turned @ turned
        return np.asarray(found)

    @property
    def consistent(self) -> bool:
        """Whether all links are physically consistent: pseudo-inertias >= 0 (Wensing 2018)."""
        eigenvalues = np.linalg.eigvalsh(pseudo_inertias(self.values))
        return bool((eigenvalues[:, 0] >= -1e-12 * np.abs(eigenvalues[:, -1])).all())

    def rows(self) -> list[dict[str, Any]]:
        """Entries of the joints' tables, for a description whose rows end in the joints' frames."""
        about = symmetric_entries(self.about_centres).tolist()
        rows = zip(self.masses.rows(), about, strict=True)
        return [mass | {INERTIA_KEY: value} for mass, value in rows]


def symmetric_entries(full: FloatArray) -> FloatArray:
    """Entries (..., 6) xx, xy, yy, xz, yz, zz of (..., 3, 3) symmetric matrices."""
    return np.asarray(full[..., _ROWS, _COLUMNS])


def symmetric_matrices(six: FloatArray) -> FloatArray:
    """Symmetric matrices (..., 3, 3) of (..., 6) entries xx, xy, yy, xz, yz, zz."""
    full = np.empty((*six.shape[:-1], 3, 3))
    full[..., _ROWS, _COLUMNS] = full[..., _COLUMNS, _ROWS] = six
    return full


def pseudo_inertias(values: FloatArray) -> FloatArray:
    """Pseudo-inertias of (..., 10) inertial parameters.

    A body moved by (4, 4) X has X P X^T; parameters are physically consistent where P is positive
    (Wensing, Kim and Slotine 2018, Linear matrix inequalities for physically consistent inertial
    parameter identification).

    Returns:
        (..., 4, 4) second moments of mass [kg m^2], bordered by first moments and mass.
    """
    inertia = symmetric_matrices(values[..., 4:])
    half = 0.5 * np.trace(inertia, axis1=-2, axis2=-1)
    pseudo = np.empty((*values.shape[:-1], 4, 4))
    pseudo[..., :3, :3] = half[..., None, None] * np.eye(3) - inertia
    pseudo[..., :3, 3] = pseudo[..., 3, :3] = values[..., 1:4]
    pseudo[..., 3, 3] = values[..., 0]
    return pseudo


def parameters_of(pseudo: FloatArray) -> FloatArray:
    """Inertial parameters (..., 10) of (..., 4, 4) pseudo-inertias."""
    second = pseudo[..., :3, :3]
    trace = np.trace(second, axis1=-2, axis2=-1)
    inertia = trace[..., None, None] * np.eye(3) - second
    mass, moments = pseudo[..., 3, 3][..., None], pseudo[..., :3, 3]
    return np.concatenate([mass, moments, symmetric_entries(inertia)], axis=-1)


def parameter_transform(link_from_body: FloatArray) -> FloatArray:
    """Matrix (10, 10) that transforms a body's parameters from its own frame to a link's."""
    units = pseudo_inertias(np.eye(10))
    return np.asarray(parameters_of(link_from_body @ units @ link_from_body.T).T)


def inertias_of_rows(rows: Sequence[DocumentTable], joint_from_row: FloatArray) -> Inertias | None:
    """Reads `mass_kg`, `com_m` and `inertia_kg_m2` of a table of joints.

    Args:
        rows: The joints' tables. An inertia is xx, xy, yy, xz, yz, zz about the centre of mass,
            along the axes of the frame in which the row ends [kg m^2].
        joint_from_row: (n, 4, 4) these frames in the joints' frames after their motion.

    Returns:
        The inertias; None where no joint states an inertia, or none a mass.

    Raises:
        DataError: Only some joints state their inertia, or one is no list of numbers.
    """
    if not all(any(key in row.content for row in rows) for key in (INERTIA_KEY, MASS_KEYS[0])):
        return None
    kg = np.array([row.number(MASS_KEYS[0]) for row in rows])
    centres = np.array([row.numbers(MASS_KEYS[1], 3) for row in rows])
    about = symmetric_matrices(np.array([row.numbers(INERTIA_KEY, 6) for row in rows]))
    rotation, position = joint_from_row[:, :3, :3], joint_from_row[:, :3, 3]
    return Inertias.of_bodies(
        kg,
        (rotation @ centres[:, :, None])[:, :, 0] + position,
        rotation @ about @ np.swapaxes(rotation, 1, 2),
    )


@dataclass(frozen=True, eq=False)
class LogCholesky:
    """Log-Cholesky coordinates around n bodies."""

    # (n, 10, 10) from the parameters of Pinocchio's coordinates to those of the link, by congruence
    # with the Cholesky factor of the known body.
    maps: FloatArray

    @classmethod
    def around(cls, known: Inertias) -> Self:
        """Builds coordinates that are zero at known bodies.

        Raises:
            DataError: One of them is physically inconsistent.
        """
        pseudo = pseudo_inertias(known.values)
        values, vectors = np.linalg.eigh(pseudo)
        inconsistent = np.flatnonzero(
            (values[:, 0] < -1e-9 * values[:, -1]) | (values[:, -1] <= 0.0)
        )
        if len(inconsistent):
            raise DataError(
                f"robot: the inertia stated for link {inconsistent[0] + 1} is that of no body: its "
                "second moments of mass are negative.",
                culprits=[f"joint {index + 1}" for index in inconsistent],
                next_step="Check mass_kg, com_m and inertia_kg_m2 (about the centre of mass).",
            )
        # Bodies may have no extent.
        raised = np.maximum(values, 1e-6 * values[:, -1:])
        roots = np.linalg.cholesky((vectors * raised[:, None, :]) @ np.swapaxes(vectors, 1, 2))
        units = pseudo_inertias(np.eye(10))
        moved = roots[:, None] @ units @ np.swapaxes(roots, 1, 2)[:, None]
        return cls(np.swapaxes(parameters_of(moved), 1, 2))

    def values(self, coordinates: FloatArray) -> FloatArray:
        """Inertial parameters (n, 10) of (n, 10) coordinates."""
        import pinocchio as pin

        parameters = [
            pin.LogCholeskyParameters(coordinate).toDynamicParameters()
            for coordinate in coordinates
        ]
        return np.asarray((self.maps @ np.array(parameters)[:, :, None])[:, :, 0])

    def jacobians(self, coordinates: FloatArray) -> FloatArray:
        """Jacobians (n, 10, 10) of the parameters over the coordinates."""
        import pinocchio as pin

        derivatives = [
            pin.LogCholeskyParameters(coordinate).calculateJacobian() for coordinate in coordinates
        ]
        return np.asarray(self.maps @ np.array(derivatives))
