"""Tables of session.toml: fields, types and ranges."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from visioncal.core.types import Camera, CameraKind, Need

# Limit that keeps squares and products from overflowing.
_LARGEST = 1e15
Number = Annotated[FiniteFloat, Field(ge=-_LARGEST, le=_LARGEST)]
Positive = Annotated[FiniteFloat, Field(gt=0, le=_LARGEST)]
# Plausible standard deviations of a focal length [px].
PixelSigma = Annotated[FiniteFloat, Field(ge=1e-3, le=1e4)]
# Standard deviations of measured lengths [m] and angles [rad]: the least is a tenth of what the
# best measuring machines reach. Beside smaller ones nothing is left of the images' information.
MeasuredSigma = Annotated[FiniteFloat, Field(ge=1e-7, le=_LARGEST)]
NotNegative = Annotated[FiniteFloat, Field(ge=0, le=_LARGEST)]
# Largest side of an image: four times that of the largest sensors [px].
Side = Annotated[int, Field(gt=0, le=65_535)]

# Default place of a need.
VIEWS: Literal["views"] = "views"
# Largest plausible reach of an arm [m].
_FAR_M = 20.0


class TableModel(BaseModel):
    """A table of session.toml. Unknown keys, of newer versions or users, are in `model_extra`."""

    model_config = ConfigDict(extra="allow", strict=True, frozen=True)


class CameraTable(TableModel):
    """`[camera]`. matrix: fx, fy, cx, cy [px]; resolution: width, height [px]."""

    name: str = "camera"
    resolution: Annotated[list[Side], Field(min_length=2, max_length=2)] | None = None
    model: CameraKind = "brown"
    matrix: Annotated[list[Number], Field(min_length=4, max_length=4)] | None = None
    distortion: list[Number] | None = None
    intrinsics: Literal["auto", "hold", "refine"] = "auto"
    matrix_sigma_px: PixelSigma | None = None
    focus: Literal["auto", "fixed"] = "auto"

    @property
    def size(self) -> tuple[int, int] | None:
        """(width, height) of its images [px], if declared."""
        return None if self.resolution is None else (self.resolution[0], self.resolution[1])

    @property
    def stated(self) -> Camera | None:
        """The stated intrinsics; None where they are to be estimated."""
        if self.matrix is None or self.distortion is None or self.size is None:
            return None
        matrix, distortion = np.array(self.matrix, float), np.array(self.distortion, float)
        return Camera(self.model, self.size, matrix, distortion)


class RobotTable(TableModel):
    """`[robot]`. model: a built-in name, or the path of a .urdf, a DH .toml or an arm's .json.

    Optional where poses are enough. gravity_m_s2: acceleration of gravity in the robot's base, for
    a base that is not upright.
    """

    model: str | None = None
    tip: str | None = None
    gravity_m_s2: Annotated[list[Number], Field(min_length=3, max_length=3)] | None = None


class InstrumentTable(TableModel):
    """`[instrument]`. Standard deviations of its readings [m], [m/m], [rad]; see `instruments`."""

    name: str = "instrument"
    sigma_m: MeasuredSigma | None = None
    sigma_per_m: NotNegative | None = None
    sigma_rad: MeasuredSigma | None = None


class ClockTable(TableModel):
    """`[clock]`. Offset of the camera's stamps from the robot's [s]."""

    camera_minus_robot_s: Number = 0.0


class NeedTable(TableModel):
    """`[need]`. Required accuracy of picks [mm], [deg], and where; see `types.Need`."""

    mm: Positive | None = None
    deg: Positive | None = None
    corrected: bool = False
    # "views" or three numbers: checked by `wrong_place`.
    at: Any = VIEWS

    @property
    def need(self) -> Need:
        """The typed need."""
        if self.at == VIEWS:
            return Need(self.mm, self.deg, corrected=self.corrected)
        x, y, z = map(float, self.at)
        return Need(self.mm, self.deg, (x, y, z), self.corrected)

    def wrong_place(self) -> str:
        """Message for an invalid `at`; empty where it is valid."""
        if self.at == VIEWS:
            return ""
        numbers = self.at if isinstance(self.at, list) else []
        if len(numbers) != 3 or not all(type(number) in (int, float) for number in numbers):
            return f'is {self.at!r}, but must be "{VIEWS}" or [x, y, z] in the base [m]'
        if not all(abs(number) < np.inf for number in numbers):
            return f"is {self.at!r}, but must be finite numbers: [x, y, z] in the base [m]"
        if not all(abs(number) <= _FAR_M for number in numbers):
            return (
                f"is {self.at!r}, farther than any arm reaches: it is in the base, in metres "
                f"(under {_FAR_M:g})"
            )
        return ""


class PriorTable(TableModel):
    """`[prior.A_from_B]`. Measured components of B's position in A, with sigma_m [m].

    quaternion_xyzw: its rotation, with sigma_rad about each axis [rad].
    """

    x_m: Number | None = None
    y_m: Number | None = None
    z_m: Number | None = None
    sigma_m: MeasuredSigma | None = None
    quaternion_xyzw: Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)] | None = None
    sigma_rad: MeasuredSigma | None = None


class TargetTable(TableModel):
    """`[targets.NAME]`, one of several. target: a name in targets/, or the path of a .toml."""

    target: str
