"""The result of dynamic identification."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np

from visioncal.core.choices import DYNAMICS_FILE
from visioncal.core.codec import KEPT, Key, Vector, reading
from visioncal.core.documents import parse_stored
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes, write_json
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.consistent import Consistent
from visioncal.dynamics.motion import JointMotion
from visioncal.dynamics.stribeck import Stribeck
from visioncal.robot import Inertias, Robot

# A parameter is determined to so many percent of itself, or worse, or not at all.
CLASSES = ((0.02, "2 %"), (0.1, "10 %"), (1.0, "poorly"))
UNKNOWN = "not at all"


@dataclass(frozen=True, eq=False)
class StreamFacts:
    """The figures of a fitted stream.

    Attributes:
        label: Its place.
        samples: How many filtered samples it has.
        left_out: How many of these torques were left out, as outliers or as none.
        band_hz: Highest frequency of the motion [Hz].
        cutoff_hz: Where the low-pass is 6 dB down [Hz].
        rate_hz: Samples a second before the filter.
        noise_nm: (n,) noise of the filtered torques [N m].
        rms_nm: (n,) their residuals, as a root mean square [N m].
        torque_nm: (n,) how far they range, as a standard deviation [N m].
        notes: What was found in its samples, in words.
    """

    label: Annotated[str, Key("stream")]
    samples: int
    left_out: int
    band_hz: float
    cutoff_hz: float
    rate_hz: float
    noise_nm: Vector
    rms_nm: Vector
    torque_nm: Vector
    notes: Annotated[tuple[str, ...], KEPT] = ()


@dataclass(frozen=True, eq=False)
class TorqueValidation:
    """How torques are predicted that were not fitted.

    Attributes:
        label: Of which samples, in words.
        rms_nm: (n,) error, as a root mean square [N m].
        torque_nm: (n,) how far the torques range, as a standard deviation [N m].
        noise_nm: (n,) noise of the torques by the fit [N m].
        consistent_rms_nm: (n,) error with the standard parameters of bodies; None without these.
        known_rms_nm: (n,) error with the robot's own inertias and the friction that goes best with
            them; None where it has none.
    """

    label: Annotated[str, Key("samples")]
    rms_nm: Vector
    torque_nm: Vector
    noise_nm: Vector
    consistent_rms_nm: Vector | None = None
    known_rms_nm: Vector | None = None

    @property
    def shares(self) -> FloatArray:
        """(n,) error over the range of the torque."""
        return np.asarray(self.rms_nm / np.maximum(self.torque_nm, 1e-12))


@dataclass(frozen=True)
class Lag:
    """How much later torques come than their angles.

    Attributes:
        seconds: Their lag; below zero where they come earlier [s].
        sigma_s: Its standard deviation [s].
        share: What it changes of a joint's torques, over their range, where it changes most.
    """

    seconds: float
    sigma_s: float
    share: float

    @property
    def words(self) -> str:
        """The lag, and what was done about it."""
        late = self.seconds > 0.0
        return (
            f"The torques {'lag' if late else 'are ahead of'} the angles by "
            f"{figure(1e3 * abs(self.seconds))} ms (sigma {figure(1e3 * self.sigma_s)}): they were "
            f"taken so much {'earlier' if late else 'later'}."
        )


@dataclass(frozen=True, eq=False)
class Identified:
    """What torques say of an arm; `save` writes it as dynamics.json.

    Attributes:
        robot: The arm as it was known before.
        base: Its model in base parameters.
        values: (b,) these.
        covariance: (b + 2 a, b + 2 a) of these, of a humps of dry friction [N m], and of the
            logarithms of their speeds.
        stribeck: The humps.
        consistent: Standard parameters of bodies; None where the robot's inertias are not known.
        streams: What was fitted.
        validation: How torques are predicted that were not fitted; None where there were none.
        facts: Whence it comes: session, digest, when.
        lag: By how much the torques were later than their angles, as it was undone; None where that
            is not clear, or does not matter.
    """

    robot: Robot
    base: BaseModel
    values: FloatArray
    covariance: FloatArray
    stribeck: Stribeck
    consistent: Consistent | None
    streams: tuple[StreamFacts, ...]
    validation: TorqueValidation | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    lag: Lag | None = None

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Loads a dynamics.json, or that of a folder.

        Raises:
            DataError: It is missing or is none.
        """
        from visioncal.dynamics.document import fields_from_document

        path = Path(path)
        if path.is_dir() and not (path / DYNAMICS_FILE).exists():
            raise DataError(
                f"{path} has no {DYNAMICS_FILE}, as visioncal dynamics identify writes it.",
                culprits=[str(path)],
                next_step="Identify the arm first, and name its output folder: visioncal dynamics "
                "identify --help",
            )
        path = path / DYNAMICS_FILE if path.is_dir() else path
        with reading(
            str(path), f"a {DYNAMICS_FILE}", "Write one with visioncal dynamics identify."
        ):
            return cls(**fields_from_document(parse_stored(read_bytes(path), str(path))))

    def save(self, path: Path | str) -> None:
        """Writes it, whole or not at all.

        Raises:
            DataError: The file cannot be written.
        """
        from visioncal.dynamics.document import to_document

        write_json(path, to_document(self))

    @property
    def sigmas(self) -> FloatArray:
        """(b,) of the base parameters."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[: self.base.rank]))

    @property
    def fitted_rms_nm(self) -> FloatArray:
        """(n,) residuals of what was fitted, of the worst stream, as a root mean square [N m]."""
        return np.asarray(np.max([stream.rms_nm for stream in self.streams], axis=0))

    @property
    def determined(self) -> tuple[str, ...]:
        """How well each base parameter is determined: to `2 %` of itself, `10 %`, worse, or not."""
        shares = self.sigmas / np.maximum(np.abs(self.values), 1e-300)
        return tuple(
            next((word for most, word in CLASSES if share < most), UNKNOWN) for share in shares
        )

    @cached_property
    def inertias(self) -> Inertias | None:
        """Of the links, as bodies; None where the robot's were not known before."""
        return None if self.consistent is None else self.consistent.inertias(self.robot.joint_count)

    def torques(self, motion: JointMotion) -> FloatArray:
        """(m, n) what the drives have to give, by the base parameters [N m]."""
        return np.asarray(self.base.regressor(motion) @ self.values + self.stribeck.torques(motion))

    def consistent_torques(self, motion: JointMotion) -> FloatArray:
        """(m, n) the same by the standard parameters of bodies [N m].

        Raises:
            DataError: There are none.
        """
        if self.consistent is None:
            raise DataError(
                f"dynamics: nothing was known of the inertias of {self.robot.name}, so there are "
                "no standard parameters.",
                culprits=[self.robot.name],
                next_step="State mass_kg, com_m and inertia_kg_m2 of its joints.",
            )
        values = self.base.of(self.consistent.values)
        return np.asarray(self.base.regressor(motion) @ values + self.stribeck.torques(motion))
