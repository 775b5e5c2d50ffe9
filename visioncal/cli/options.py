"""Shared options, each declared once, as a field of a dataclass or a parameter's type."""

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from visioncal.core.choices import ImagesKept
from visioncal.core.options import argument, flag, option
from visioncal.interchange.outputs import RECORDING, REPORT

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.session.selecting import Choice

session_argument = partial(argument, "A session's folder, or its .rrd recording.")
out_folder = partial(option, "The folder to write into.", "-o", "--out", file_okay=False)
out_file = partial(option, "The file to write; otherwise, or as -, stdout.", "-o", "--out")
json_flag = partial(flag, "Print the result as JSON to stdout, without words.", "--json")
force_flag = partial(flag, "Replace what is there under the same name; never a folder.", "--force")
force_bad = partial(flag, "Use a result even if its verdict is bad.", "--force")
force_both = partial(flag, "Replace an existing file; and use a result that is bad.", "--force")
yes_flag = partial(
    flag, "Move the arm without asking: the cell is clear, a hand on the stop button.", "--yes"
)
view_flag = partial(flag, "Show it in the rerun viewer as it goes.", "--view")
seed_option = partial(option, "Random seed.", "--seed", default=0, min=0)
camera_name = partial(option, "Of a whole cell: which camera, as left.", "--camera")
robot_name = partial(option, "Of a whole cell: which robot, as a.", "--robot")


@dataclass(frozen=True, kw_only=True)
class PartOptions:
    """Which camera, robot and target of a cell are meant."""

    camera: str | None = camera_name()
    robot: str | None = robot_name()
    target: str | None = option("Of a whole cell: which target, as floor.")

    @property
    def choice(self) -> "Choice":
        """The choice, for sessions and results."""
        from visioncal.session.selecting import Choice

        return Choice(self.camera, self.robot, self.target)


@dataclass(frozen=True, kw_only=True)
class NeedOptions:
    """Required accuracy of the task."""

    need_mm: float | None = option(
        "Required accuracy of picks, in mm, on which the verdict is based; replaces the "
        "need in session.toml."
    )
    need_deg: float | None = option("The same in rotation, in degrees.")


@dataclass(frozen=True, kw_only=True)
class WorkOptions:
    """How a session is processed, and which drawings are made."""

    threads: int | None = option(
        "Images searched in parallel; by default one a core. The result is the same.", min=1
    )
    no_report: bool = flag(f"Leave {REPORT} out, which takes a second to draw.")
    no_recording: bool = flag(f"Leave {RECORDING} out, for the viewer.")
    images: ImagesKept = option(
        f"What {RECORDING} keeps of them: faint copies to look at, all of them, or none. "
        "The corners found in them are kept in any case, and give the same result again.",
        default="thumbnail",
    )

    @property
    def left_out(self) -> tuple[str, ...]:
        """The files that are left out."""
        asked = {REPORT: self.no_report, RECORDING: self.no_recording}
        return tuple(name for name, is_left_out in asked.items() if is_left_out)
