"""Options of an export."""

from dataclasses import dataclass
from typing import get_args

from visioncal.core.choice import Choice
from visioncal.core.choices import Convention
from visioncal.core.errors import DataError
from visioncal.core.options import flag, numbers_option, option
from visioncal.core.parsing import POSE, text_in


@dataclass(frozen=True)
class Load:
    """A tool's load, which no calibration determines."""

    mass_kg: float
    centre_mm: tuple[float, float, float]  # Its centre of mass in the flange's frame.


@dataclass(frozen=True, kw_only=True)
class Selection(Choice):
    """The choice of an export; None leaves it to the format."""

    edge: str | None = option("The transform, or all; of a cell any frame from any other.")
    inverse: bool = flag("Write the inverse of it.")
    parent: str | None = option("Exported name of the frame in which the pose is given.")
    child: str | None = option("Exported name of the frame whose pose it is.")
    child_from_cam: tuple[float, ...] | None = numbers_option(
        "Pose of the camera's optical frame in --child, where that is another, as camera_link [m].",
        form=POSE,
    )
    number: int | None = option("Number of the controller's tool or base.")
    mass_kg: float | None = option("The tool's mass, for ABB's tooldata (kg).")
    cog_mm: tuple[float, float, float] | None = option(
        "Its centre of mass in the flange: X Y Z (mm)."
    )
    lens: str | None = option(
        "A poorer model of the lens, refitted; what it leaves is said.",
        metavar="pinhole|radtan|plumb_bob",
    )
    # An existing document, all else of which is kept.
    onto: str | None = option(
        "For oak: the device's own calibration, as depthai saves it.",
        metavar="<path>",
        parse=text_in,
    )
    convention: str | None = option("Of robot-dh's table.", metavar="|".join(get_args(Convention)))
    calibration_hash: str | None = option("Hash of ur_calibration, for ur-kinematics.", "--hash")

    @property
    def load(self) -> Load | None:
        """The tool's load, if stated; raises DataError."""
        if self.mass_kg is not None and self.cog_mm is not None:
            return Load(self.mass_kg, self.cog_mm)
        if self.mass_kg is None and self.cog_mm is None:
            return None
        raise DataError(
            "A load is a mass and where its centre is.",
            culprits=["--mass-kg", "--cog-mm"],
            next_step="Give both --mass-kg and --cog-mm, or neither.",
        )
