"""The options of `visioncal record`, and their conversion for drivers."""

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from visioncal.cli.parsing import size_in
from visioncal.core.choices import PLAN_SPEED, POSE_FORMS, CameraMount
from visioncal.live.capture.options import CaptureOptions, Keep, Stillness

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.live.drivers.protocols import DeviceSetup

_cell = partial(typer.Option, rich_help_panel="The cell, where no plan says it")
_taking = partial(typer.Option, rich_help_panel="How views are taken")
_moving = partial(typer.Option, rich_help_panel="How the arm is moved")
_camera = partial(typer.Option, rich_help_panel="What the camera is set to")


@dataclass(frozen=True)
class RecordCellOptions:
    """The cell, where there is no plan."""

    target: Annotated[
        str | None,
        _cell(
            help="The board: a name in targets/, a .toml, or in one word as "
            "checkerboard_9x6_23.6mm."
        ),
    ] = None
    robot: Annotated[
        str | None, _cell(help="The robot's model: a built-in name, a .urdf or .toml.")
    ] = None
    mount: Annotated[
        CameraMount | None, _cell(help="Where the camera is; by default eye-in-hand.")
    ] = None
    pose_form: Annotated[
        str | None,
        _cell(
            metavar="|".join(("ours", *POSE_FORMS)), help="With a manual arm: how poses are typed."
        ),
    ] = None


@dataclass(frozen=True)
class TakingOptions:
    """How views are taken."""

    frames: Annotated[int, _taking(min=1, max=100, help="Frames a view.")] = 3
    keep: Annotated[Keep, _taking(help="The sharpest of these, or their mean.")] = "sharpest"
    still_px: Annotated[
        float, _taking(min=0.01, max=10.0, help="Image motion above which no view is taken.")
    ] = Stillness.image_px
    settle_s: Annotated[
        float,
        _taking(min=0.0, max=30.0, help="How long arm and image must be still before a view."),
    ] = Stillness.quiet_s
    speed: Annotated[float, _moving(help="Speed of the fastest joint, in rad/s; at most 1.5.")] = (
        PLAN_SPEED
    )

    def options(self, *, single: bool, lost: int) -> CaptureOptions:
        """The options of a capture.

        `single` is for a camera that provides each picture once; `lost` is the allowed number of
        consecutive stops without a view.
        """
        return CaptureOptions(
            speed=self.speed,
            frames=self.frames,
            keep=self.keep,
            still=Stillness(image_px=self.still_px, quiet_s=self.settle_s),
            single=single,
            missed_in_a_row=lost,
        )


@dataclass(frozen=True)
class DeviceOptions:
    """Camera settings."""

    resolution: Annotated[
        str | None, _camera(metavar="W,H", help="Size of the images in pixels.")
    ] = None
    exposure_us: Annotated[int | None, _camera(help="Exposure time in microseconds.")] = None
    gain: Annotated[int | None, _camera(help="ISO, or the device's own unit.")] = None
    focus: Annotated[int | None, _camera(help="Lens position, in the device's own unit.")] = None

    def setup(self) -> "DeviceSetup":
        """The settings for the drivers.

        Raises:
            DataError: The resolution is not two numbers.
        """
        from visioncal.live.drivers.protocols import DeviceSetup

        resolution = None if self.resolution is None else size_in(self.resolution)
        return DeviceSetup(resolution, self.exposure_us, self.gain, self.focus)
