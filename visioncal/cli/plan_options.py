"""The options of `visioncal plan`, and their conversion for the planner."""

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from visioncal.cli.parsing import numbers_in
from visioncal.core.choices import Mount
from visioncal.core.errors import DataError
from visioncal.live.planning.purposes import PURPOSES, purpose_of

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.live.planning.cell import Box, Limits, PlanCell
    from visioncal.live.planning.plan import PlanRequest

_what = partial(typer.Option, rich_help_panel="What is planned")
_cell = partial(typer.Option, rich_help_panel="The cell, where the source does not say it")
_limits = partial(typer.Option, rich_help_panel="What the arm must keep")
_doubt = partial(typer.Option, rich_help_panel="How well it is known")
# Largest number of stops where a need decides it.
_MOST_FOR_NEED = 40
_USUAL_STOPS = ", ".join(f"{purpose.stops} for {purpose.name}" for purpose in PURPOSES.values())


@dataclass(frozen=True)
class PlanOptions:
    """Options of the plan."""

    add: Annotated[
        int | None,
        _what(min=1, max=500, help="How many stops to add to a recorded session, which counts."),
    ] = None
    purpose: Annotated[
        str, _what("--for", metavar="|".join(PURPOSES), help="What they are for.")
    ] = "hand-eye"
    stops: Annotated[int | None, _what(min=1, max=500, help=f"How many stops: {_USUAL_STOPS}.")] = (
        None
    )
    wish_mm: Annotated[
        float | None, _what(help="Fewer stops where they predict this sigma, in mm.")
    ] = None
    wish_deg: Annotated[float | None, _what(help="The same of the rotation, in degrees.")] = None
    need_mm: Annotated[
        float | None,
        _what(
            help="Fewer stops where they predict that 95 % of picks land within so many mm; up to "
            f"{_MOST_FOR_NEED} stops where no number is given."
        ),
    ] = None
    need_deg: Annotated[float | None, _what(help="The same of the rotation, in degrees.")] = None
    workspace: Annotated[
        str | None,
        _what(
            metavar="X,Y,Z:SX,SY,SZ",
            help="Where the arm's accuracy matters: a box by its centre in the base and its "
            "lengths, in mm; by default all of its reach.",
        ),
    ] = None
    start_joints: Annotated[
        str | None,
        _what(
            metavar="Q1,Q2,...",
            help="The arm's present joint angles, in radians; without them the path to the first "
            "stop is not checked.",
        ),
    ] = None
    candidates: Annotated[int, _what(min=12, max=20000, help="Number of candidate stops.")] = 1500
    seed: Annotated[int, _what(min=0, help="Random seed of the candidate stops.")] = 0

    def request(self, cell: "PlanCell") -> "PlanRequest":
        """The request for the planner.

        Raises:
            DataError: A number, a box or a purpose is malformed.
        """
        import numpy as np

        from visioncal.core.types import Need
        from visioncal.live.planning.design import Wish
        from visioncal.live.planning.plan import PlanRequest

        purpose = purpose_of(self.purpose, "--for")
        form = ",".join(f"q{index + 1}" for index in range(cell.robot.joint_count))
        start = self.start_joints and numbers_in(self.start_joints, "--start-joints", form)
        has_no_wish = self.wish_mm is None and self.wish_deg is None
        has_no_need = self.need_mm is None and self.need_deg is None
        return PlanRequest(
            purpose,
            self.add or self.stops or (purpose.stops if has_no_need else _MOST_FOR_NEED),
            None if has_no_wish else Wish(self.wish_mm, self.wish_deg),
            self.candidates,
            _box_of(self.workspace, "--workspace", "workspace") if self.workspace else None,
            np.array(start) if start else None,
            self.seed,
            None if has_no_need else Need(self.need_mm, self.need_deg),
        )


@dataclass(frozen=True)
class PlanCellOptions:
    """Options of the cell; None for those that were not given."""

    robot: Annotated[str | None, _cell(help="The robot, where a session names none.")] = None
    target: Annotated[
        str | None,
        _cell(
            help="The board: a name in targets/, a .toml, or in one word as "
            "checkerboard_9x6_23.6mm."
        ),
    ] = None
    camera: Annotated[
        str | None,
        _cell(
            metavar="FX,FY,CX,CY | FILE",
            help="The lens: four numbers in pixels, a file of intrinsics, or an earlier "
            "calibration.",
        ),
    ] = None
    resolution: Annotated[
        str | None, _cell(metavar="W,H", help="Size of the images in pixels.")
    ] = None
    mount: Annotated[Mount | None, _cell(help="Where the camera is.")] = None
    cam: Annotated[
        str | None,
        _cell(
            metavar="'X Y Z RX RY RZ'",
            help="Rough place of the camera on the flange (or in the base), in mm and degrees: "
            "turned about the fixed axes x, then y, then z. It looks along its z.",
        ),
    ] = None
    board: Annotated[
        str | None,
        _cell(
            metavar="'X Y Z RX RY RZ'",
            help="Rough place of the board in the base (or on the flange), in the same form. Its z "
            "points into the paper: face up is '... 180 0 0'.",
        ),
    ] = None
    guess_mm: Annotated[
        float, _doubt(min=0.1, max=500.0, help="Sigma of both rough positions, per axis, in mm.")
    ] = 20.0
    guess_deg: Annotated[
        float, _doubt(min=0.01, max=45.0, help="The same of their rotations, in degrees.")
    ] = 5.0
    noise_px: Annotated[
        float | None, _doubt(help="Sigma of a corner in the image; by default 0.1, or as recorded.")
    ] = None
    noise_mm: Annotated[
        float | None,
        _doubt(help="Sigma of the robot at a stop, per axis; by default 0.03, or as recorded."),
    ] = None
    noise_deg: Annotated[
        float | None, _doubt(help="The same of its rotation; by default 0.003, or as recorded.")
    ] = None

    def options(self, *names: str) -> dict[str, object]:
        """Some options by their names; None for those that were not given."""
        return {f"--{name}": getattr(self, name) for name in names}


@dataclass(frozen=True)
class ClearanceOptions:
    """Clearances that the arm must keep in any motion."""

    boxes: Annotated[
        list[str] | None,
        _limits(
            "--box",
            metavar="NAME:X,Y,Z:SX,SY,SZ",
            help="An obstacle, by its centre in the base and its lengths, in mm; may be repeated.",
        ),
    ] = None
    floor: Annotated[
        str, _limits(metavar="Z|none", help="Height of the floor or table in the base, in mm.")
    ] = "0"
    clearance_mm: Annotated[
        float,
        _limits(
            min=0.0, max=1000.0, help="Distance of the arm from floor, board, boxes and itself."
        ),
    ] = 30.0
    margin_deg: Annotated[
        float, _limits(min=0.0, max=90.0, help="Distance of the joints from their limits.")
    ] = 3.0

    @property
    def bodies(self) -> "tuple[Box, ...]":
        """Obstacles.

        Raises:
            DataError: A box is malformed.
        """
        return tuple(_box_of(box) for box in self.boxes or ())

    @property
    def floor_m(self) -> float | None:
        """Height of the floor in the base [m]; None for no floor.

        Raises:
            DataError: It is no number.
        """
        if self.floor.strip().lower() == "none":
            return None
        return 1e-3 * numbers_in(self.floor, "--floor", "z")[0]


@dataclass(frozen=True)
class SightOptions:
    """Conditions that the camera must keep."""

    tilt_deg: Annotated[
        float,
        _limits(
            min=5.0,
            max=80.0,
            help="Largest angle between the line of sight and the board's normal.",
        ),
    ] = 50.0
    edge_px: Annotated[
        float, _limits(min=0.0, max=10000.0, help="Distance of the board from the image's edge.")
    ] = 20.0
    distance_mm: Annotated[
        str | None,
        _limits(
            metavar="NEAR,FAR",
            help="Distance of the camera from the board; by default as the board fills the image.",
        ),
    ] = None
    focus_mm: Annotated[
        str | None, _limits(metavar="NEAR,FAR", help="Depths at which images are sharp.")
    ] = None

    def limits(self, kept: ClearanceOptions) -> "Limits":
        """These limits together with those of any motion."""
        from visioncal.live.planning.cell import Limits

        return Limits(
            math.radians(kept.margin_deg),
            _span(self.distance_mm, "--distance-mm"),
            _span(self.focus_mm, "--focus-mm"),
            math.radians(self.tilt_deg),
            self.edge_px,
            1e-3 * kept.clearance_mm,
            kept.floor_m,
        )


def _box_of(words: str, option: str = "--box", name: str = "") -> "Box":
    """Parses a box: NAME:x,y,z:sx,sy,sz, its centre in the base and its lengths [mm]."""
    import numpy as np

    from visioncal.core.transforms import compose
    from visioncal.live.planning.cell import Box

    parts = ([name] if name else []) + words.split(":")
    if len(parts) != 3 or not parts[0].strip():
        label = "" if name else "NAME:"
        form = f"{label}X,Y,Z:SX,SY,SZ"
        raise DataError(
            f"{option} is {words[:80]!r}; {form} is needed, with the centre in the base and the "
            "lengths in mm.",
            culprits=[option],
            next_step=f"Such as {option} {label.lower()}500,0,300:400,400,400",
        )
    centre = numbers_in(parts[1], option, "x,y,z")
    size = numbers_in(parts[2], option, "sx,sy,sz")
    return Box(parts[0].strip(), compose(np.eye(3), 1e-3 * np.array(centre)), 1e-3 * np.array(size))


def _span(words: str | None, option: str) -> tuple[float, float] | None:
    if words is None:
        return None
    near, far = numbers_in(words, option, "near,far")
    return 1e-3 * near, 1e-3 * far
