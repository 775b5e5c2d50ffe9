"""Options of commands that touch or locate: tools, fixtures, touch tests, points."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import ClassVar

from visioncal.cli.options import (
    ActOptions,
    against_option,
    example_flag,
    force_bad,
    force_flag,
    form_option,
    json_flag,
    session_argument,
)
from visioncal.cli.session_options import RobotPoseOptions
from visioncal.core.choice import Choice, camera_name, robot_name
from visioncal.core.choices import UNITS_M
from visioncal.core.options import argument, flag, numbers_option, option
from visioncal.core.parsing import FORMS, POSE


@dataclass(frozen=True, kw_only=True)
class FrameOptions(RobotPoseOptions, Choice, ActOptions):
    """Source and destination of a frame."""

    touches: Path | None = argument(
        "A table of touches, or a session with images of it.", default=None
    )
    calibration: Path | None = option(
        "An output folder, which the frame joins.", "-c", "--calibration"
    )
    out: Path | None = option("A file of frames (.json) to put it into, instead.", "-o", "--out")
    name: str | None = option("Name of the frame: gripper, jig_2.")
    force: bool = force_flag()
    remove: bool = flag("Take the frame of this name out of there again, without touches.")
    touch_noise: float | None = option(
        "Sigma of touches, per axis.", "--touch-noise-mm", min=1e-4, max=1e3
    )
    point: tuple[float, float, float] | None = numbers_option(
        "For images: the frame's origin in the target's frame, such as the tool's tip.",
        "--point-mm",
        form="x,y,z",
        scale=1e-3,
    )
    as_json: bool = json_flag()

    @property
    def noise_m(self) -> float | None:
        """Repeatability of a touch [m]."""
        return None if self.touch_noise is None else 1e-3 * self.touch_noise

    def for_touches(self) -> dict[str, object]:
        """Options of touches by their names; None for those that were not given."""
        names = [field.name for field in fields(RobotPoseOptions) if field.name != "joint_unit"]
        named = {f"--{name.replace('_', '-')}": getattr(self, name) for name in names}
        return {**named, "--touch-noise-mm": self.touch_noise}


@dataclass(frozen=True, kw_only=True)
class TcpOptions(FrameOptions):
    """Find a tool's tip, and its rotation, from touches of fixed points; or from images.

    A touch of kind point has the tip at the point; of kind z, the point lies on the tool's positive
    z axis; of kind xz, in its xz plane on the side of positive x. In images, a target on the tool
    gives both, by the camera that -c names. Exit status 2: nothing was written, for the reason
    given; 3: the tool is bad, and joins no calibration.
    """

    first: ClassVar = "calibration name out force _example"
    _example: bool = example_flag("tcp")


@dataclass(frozen=True, kw_only=True)
class FixtureOptions(FrameOptions):
    """Find a fixture in the base, from touches of it or of a drawing's points.

    A touch of kind origin is at the fixture's origin; of kind x, on its positive x axis; of kind
    xy, in its xy plane on the side of positive y: one of each at least. With --cad, three points or
    more that the drawing has, by their names. In images a target on the fixture gives its frame, by
    the camera that -c names. Exit status 2: nothing was written, for the reason given; 3: the
    fixture is bad, and joins no calibration.
    """

    first: ClassVar = "calibration name cad tool out force _example"
    cad: Path | None = option("Points of the drawing: point, x_mm, y_mm, z_mm, sigma_mm.")
    cad_unit: str | None = option("Unit of x, y, z in it.", metavar="|".join(UNITS_M))
    tool: str | None = option("A tool of the calibration or of a file, or none: poses of the tip.")
    _example: bool = example_flag("fixture")


@dataclass(frozen=True, kw_only=True)
class TouchTestOptions(ActOptions):
    """Prove a calibration: touch what the camera locates, and enter the gaps.

    The session has one image or more of a board as it lies now; of a camera that stands still, one
    image is enough. Prints where to send the robot,
    hovering first, corrected where the arm is calibrated. With all gaps, they are compared with
    what was predicted, and kept in the result and its report. Exit status 3: they are larger, or
    nothing was done as the calibration or the tool is bad.
    """

    first: ClassVar = "calibration tool gaps_mm height_mm"
    session: Path = session_argument()
    calibration: Path = against_option("-c", "--calibration")
    tool: str | None = option("The tool that touches; none: a gauge of --clearance-mm.")
    clearance_mm: float | None = option(
        "Length of that gauge, beyond all on the flange.", min=0.0, max=2e3
    )
    height_mm: float = option("Height of the hover.", default=50.0, min=1.0, max=1000.0)
    robot_form: str | None = form_option()
    gaps_mm: str | None = option("Gaps from tip to point, in order.", metavar="A,B,C,D,E")
    force: bool = force_bad()
    as_json: bool = json_flag()


@dataclass(frozen=True, kw_only=True)
class LocateOptions:
    """Locate what an image shows in the robot's base, with its uncertainty.

    It is a target, a pixel whose plane or depth is known, or a whole cloud. Exit status 2: there is
    no place, for the reason given; 3: there is none, as the calibration's verdict is bad.
    """

    first: ClassVar = "calibration pixel plane pose target point view _example"
    source: Path | None = argument(
        "A session, or one image; not needed with --pixel.", default=None
    )
    calibration: Path = against_option("-c", "--calibration")
    pixel: list[tuple[float, float]] | None = numbers_option(
        "A feature, in the image as it was taken; several may be given.", form="u,v"
    )
    depth: Path | None = option(
        "Depth picture or organised cloud at the image, instead of a plane; else that of the view."
    )
    cloud: Path | None = option("A camera's cloud, to be written in the base, with -o.")
    output: Path | None = option("The cloud in the base: .ply or .npy.", "-o", "--output")
    plane: str | None = option(f"Plane of the features: {FORMS}.")
    plane_sigma: float | None = option("Sigma of the plane's height, in mm.", "--plane-sigma-mm")
    point: tuple[float, float, float] | None = numbers_option(
        "A point of the target, instead of its origin.", "--point-mm", form="x,y,z", scale=1e-3
    )
    target: str | None = option("Another target than the session's; see convert.")
    camera: str | None = camera_name()
    robot: str | None = robot_name()
    view: int | None = option("One of the session's views; else all that show the target.")
    pose: str | None = option(
        f"Pose of the flange at the image, for a camera on it: {POSE} in metres, or as a pendant "
        "shows it.",
        metavar="POSE",
    )
    robot_form: str | None = form_option()
    sigma_px: float | None = option("Noise of a feature; else that of the corners.")
    weights: Path | None = option(
        "Weights of LightGlue for SIFT, for pictures that are hard to find (extra kornia).",
        metavar="FOLDER",
    )
    force: bool = force_bad()
    as_json: bool = json_flag()
    _example: bool = example_flag("locate")
