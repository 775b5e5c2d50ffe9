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

# Classes of a parameter's relative sigma; beyond the last it is not determined.
CLASSES = ((0.02, "2 %"), (0.1, "10 %"), (1.0, "poorly"))
UNKNOWN = "not at all"


@dataclass(frozen=True, eq=False)
class StreamStatistics:
    """Statistics of a fitted stream."""

    label: Annotated[str, Key("stream")]  # Its file.
    samples: int  # Number of filtered samples.
    left_out: int  # Number of their torques that were not used: outliers and invalid ones.
    band_hz: float  # Bandwidth of the motion [Hz].
    cutoff_hz: float  # Where the low-pass is 6 dB down [Hz].
    rate_hz: float  # Sampling rate before the filter [Hz].
    noise_nm: Vector  # (n,) noise of the filtered torques [N m].
    rms_nm: Vector  # (n,) root mean square of the residuals [N m].
    torque_nm: Vector  # (n,) standard deviation of the torques, as their range [N m].
    notes: Annotated[tuple[str, ...], KEPT] = ()  # Messages on faults of its samples.


@dataclass(frozen=True, eq=False)
class TorqueValidation:
    """Prediction errors of torques that were not fitted."""

    label: Annotated[str, Key("samples")]  # The samples, for messages.
    rms_nm: Vector  # (n,) root mean square error [N m].
    torque_nm: Vector  # (n,) standard deviation of the torques, as their range [N m].
    noise_nm: Vector  # (n,) noise of the torques by the fit [N m].
    # (n,) error with the consistent standard parameters; None without these.
    consistent_rms_nm: Vector | None = None
    # (n,) error with the robot's own inertias and friction fitted to them; None where it has no
    # inertias.
    known_rms_nm: Vector | None = None

    @property
    def shares(self) -> FloatArray:
        """(n,) error over the range of the torque."""
        return np.asarray(self.rms_nm / np.maximum(self.torque_nm, 1e-12))


@dataclass(frozen=True)
class Lag:
    """Delay of the torques behind the angles."""

    seconds: float  # The delay; negative where torques are ahead [s].
    sigma_s: float  # Its standard deviation [s].
    share: float  # Greatest change of a joint's torques by it, over their range.

    @property
    def words(self) -> str:
        """Message on the lag and its correction."""
        late = self.seconds > 0.0
        return (
            f"The torques {'lag' if late else 'are ahead of'} the angles by "
            f"{figure(1e3 * abs(self.seconds))} ms (sigma {figure(1e3 * self.sigma_s)}): they were "
            f"taken so much {'earlier' if late else 'later'}."
        )


@dataclass(frozen=True, eq=False)
class Identified:
    """Identified dynamics of an arm; `save` writes them as dynamics.json."""

    robot: Robot  # The arm before identification.
    base: BaseModel  # Its model in base parameters.
    values: FloatArray  # (b,) the base parameters.
    # (b + 2 a, b + 2 a) of these, of a Stribeck humps [N m], and of the logarithms of their speeds.
    covariance: FloatArray
    stribeck: Stribeck  # The humps.
    # Consistent standard parameters; None where the robot's inertias are not known.
    consistent: Consistent | None
    streams: tuple[StreamStatistics, ...]  # Statistics of the fitted streams.
    # Prediction errors of torques that were not fitted; None where there were none.
    validation: TorqueValidation | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)  # Provenance: session, digest, date.
    lag: Lag | None = None  # Delay of the torques, which was corrected; None where not significant.

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Loads a dynamics.json, or that of a folder; raises DataError if missing or invalid."""
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
        """Writes a dynamics.json atomically; raises DataError where it cannot be written."""
        from visioncal.dynamics.document import to_document

        write_json(path, to_document(self))

    @property
    def sigmas(self) -> FloatArray:
        """(b,) standard deviations of the base parameters."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[: self.base.rank]))

    @property
    def fitted_rms_nm(self) -> FloatArray:
        """(n,) root mean square of the residuals, of the worst stream [N m]."""
        return np.asarray(np.max([stream.rms_nm for stream in self.streams], axis=0))

    @property
    def determined(self) -> tuple[str, ...]:
        """Class of each base parameter's relative sigma: `2 %`, `10 %`, `poorly`, `not at all`."""
        shares = self.sigmas / np.maximum(np.abs(self.values), 1e-300)
        return tuple(
            next((word for most, word in CLASSES if share < most), UNKNOWN) for share in shares
        )

    @cached_property
    def inertias(self) -> Inertias | None:
        """Consistent inertias of the links; None where the robot's own were not known."""
        return None if self.consistent is None else self.consistent.inertias(self.robot.joint_count)

    def torques(self, motion: JointMotion) -> FloatArray:
        """Drive torques (m, n) by the base parameters [N m]."""
        return np.asarray(self.base.regressor(motion) @ self.values + self.stribeck.torques(motion))

    def consistent_torques(self, motion: JointMotion) -> FloatArray:
        """Drive torques (m, n) by the consistent standard parameters [N m], or DataError."""
        if self.consistent is None:
            raise DataError(
                f"dynamics: nothing was known of the inertias of {self.robot.name}, so there are "
                "no standard parameters.",
                culprits=[self.robot.name],
                next_step="State mass_kg, com_m and inertia_kg_m2 of its joints.",
            )
        values = self.base.of(self.consistent.values)
        return np.asarray(self.base.regressor(motion) @ values + self.stribeck.torques(motion))
