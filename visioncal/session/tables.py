"""The tables of session.toml: their fields, types and ranges."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from visioncal.core.types import Camera, CameraKind, Need

# Squares and products of larger numbers leave what floats hold; no field of a cell has such.
_LARGEST = 1e15
Number = Annotated[FiniteFloat, Field(ge=-_LARGEST, le=_LARGEST)]
Positive = Annotated[FiniteFloat, Field(gt=0, le=_LARGEST)]
# Nobody knows a focal length better than the least of these, or worse than the largest [px].
PixelSigma = Annotated[FiniteFloat, Field(ge=1e-3, le=1e4)]
NotNegative = Annotated[FiniteFloat, Field(ge=0, le=_LARGEST)]
# Four times the side of the largest sensors [px].
Side = Annotated[int, Field(gt=0, le=65_535)]

# Where a need counts that names no place.
VIEWS: Literal["views"] = "views"
# No arm reaches this far [m]: such numbers are in millimetres.
_FAR_M = 20.0


class TableModel(BaseModel):
    """A table of session.toml. Unknown keys are kept in `model_extra`."""

    # Unknown keys are kept: a newer version, or the user, may have put them there.
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
        """Its intrinsics; None where they are left to be estimated."""
        if self.matrix is None or self.distortion is None or self.size is None:
            return None
        matrix, distortion = np.array(self.matrix, float), np.array(self.distortion, float)
        return Camera(self.model, self.size, matrix, distortion)


class RobotTable(TableModel):
    """`[robot]`. model: a built-in name, or the path of a .urdf, a DH .toml or an arm's .json.

    It may go without, where its poses are enough. gravity_m_s2: its acceleration in the robot's
    base, for a base that does not stand upright.
    """

    model: str | None = None
    tip: str | None = None
    gravity_m_s2: Annotated[list[Number], Field(min_length=3, max_length=3)] | None = None


class InstrumentTable(TableModel):
    """`[instrument]`. Standard deviations of its readings [m], [m/m], [rad]; see `instruments`."""

    name: str = "instrument"
    sigma_m: NotNegative | None = None
    sigma_per_m: NotNegative | None = None
    sigma_rad: NotNegative | None = None


class ClockTable(TableModel):
    """`[clock]`. What the camera's stamps are ahead of the robot's [s]."""

    camera_minus_robot_s: Number = 0.0


class NeedTable(TableModel):
    """`[need]`. How near picks have to come [mm], [deg], and where; see `types.Need`."""

    mm: Positive | None = None
    deg: Positive | None = None
    # "views" or three numbers: checked with the other contradictions, in one sentence.
    at: Any = VIEWS

    @property
    def need(self) -> Need:
        """The need, typed."""
        if self.at == VIEWS:
            return Need(self.mm, self.deg)
        x, y, z = map(float, self.at)
        return Need(self.mm, self.deg, (x, y, z))

    def wrong_place(self) -> str:
        """What is wrong with `at`, in words; empty where nothing is."""
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
    """`[prior.A_from_B]`. Measured components of where frame B is in A, to sigma_m [m].

    quaternion_xyzw: its rotation, to sigma_rad about each axis [rad].
    """

    x_m: Number | None = None
    y_m: Number | None = None
    z_m: Number | None = None
    sigma_m: Positive | None = None
    quaternion_xyzw: Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)] | None = None
    sigma_rad: Positive | None = None


class TargetTable(TableModel):
    """`[targets.NAME]`, one of several. target: a name in targets/, or the path of a .toml."""

    target: str
