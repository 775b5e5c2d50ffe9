"""The user's options for a foreign recording: what the recording does not state itself."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from visioncal.core.conventions import POSE_FORMS, ROTATION_FORMS, UNITS_M, PoseNumbers, Reading
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import Mount


@dataclass(frozen=True)
class PoseImportOptions:
    """Location and convention of poses; None or empty leaves it to the source."""

    # Columns of a table, keys of JSON or arrays of an .npz: position first.
    names: tuple[str, ...] = ()
    form: str | None = None  # A name among `POSE_FORMS` or `ROTATION_FORMS`.
    unit: str | None = None  # A name among `UNITS_M`.
    inverse: bool | None = None  # Whether the inverse of the pose is written.

    @property
    def is_scalar_first(self) -> bool:
        """Whether the stated form has quaternions with the scalar first."""
        maker = POSE_FORMS.get(self.form or "")
        return (self.form if maker is None else maker.rotation) == "quaternion-wxyz"

    def applied_to(self, poses: PoseNumbers) -> PoseNumbers:
        """The poses with the user's options in place of the declared reading."""
        return poses.read_as(self.reading(poses.reading))

    def reading(self, declared: Reading) -> Reading:
        """The declared reading with the user's options in its place.

        Raises:
            DataError: There is no such form or unit.
        """
        reading = declared
        if self.form is not None:
            maker = POSE_FORMS.get(self.form)
            rotation = self.form if maker is None else maker.rotation
            _check("form of poses", rotation, [*POSE_FORMS, *ROTATION_FORMS])
            reading = replace(
                reading, rotation=rotation, unit=maker.unit if maker else reading.unit
            )
        if self.unit is not None:
            _check("unit of length", self.unit, list(UNITS_M))
            reading = replace(reading, unit=self.unit)
        if self.inverse is not None:
            reading = replace(reading, inverse=self.inverse)
        return reading


def _check(what: str, name: str, names: Sequence[str]) -> None:
    if name not in names:
        raise DataError(
            f"There is no {what} named {name!r}; the names are {some_of(names, 20)}.",
            culprits=[name],
            next_step=did_you_mean(name, names),
        )


@dataclass(frozen=True)
class ImportOptions:
    """All options for a foreign recording."""

    robot: PoseImportOptions = PoseImportOptions()  # Of the robot's poses, `base_from_flange`.
    # Of the measured poses of the target, `cam_from_target`.
    camera: PoseImportOptions = PoseImportOptions()
    joints: tuple[str, ...] = ()  # Columns or keys of the joint angles.
    joints_deg: bool = False
    image: str | None = None  # The column or key that names each row's image.
    camera_file: Path | None = None  # A second file, which holds the camera's poses.
    mount: Mount | None = None
    target: str | None = None  # A shipped name, the path of a `.toml`, or a one-word description.
    intrinsics: str | None = None  # The path of a file with intrinsics, or `estimate`.
    images: Path | None = None
    corners: Path | None = None  # A file with corners that another program found in the images.
    resolution: tuple[int, int] | None = None  # (width, height) [px].
    robot_model: str | None = None  # A built-in robot's name, or the path of a .urdf or a DH .toml.
    tip: str | None = None  # The frame that the poses are of.
