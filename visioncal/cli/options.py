"""Shared options, each declared once, as a field of a dataclass or a parameter's type."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from visioncal.core.choices import ImagesKept
from visioncal.interchange.outputs import RECORDING, REPORT

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.session import Session
    from visioncal.session.selecting import Choice

SessionArgument: TypeAlias = Annotated[
    Path, typer.Argument(help="A session's folder, or its .rrd recording.")
]
OutFolder: TypeAlias = Annotated[
    Path, typer.Option("-o", "--out", file_okay=False, help="The folder to write into.")
]
OutFile: TypeAlias = Annotated[
    Path | None, typer.Option("-o", "--out", help="The file to write; otherwise, or as -, stdout.")
]
AsJson: TypeAlias = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON to stdout, without words.")
]
Force: TypeAlias = Annotated[
    bool, typer.Option("--force", help="Replace what is there under the same name; never a folder.")
]
ForceBad: TypeAlias = Annotated[
    bool, typer.Option("--force", help="Use a result even if its verdict is bad.")
]
ForceBoth: TypeAlias = Annotated[
    bool,
    typer.Option("--force", help="Replace an existing file; and use a result that is bad."),
]
Yes: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--yes", help="Move the arm without asking: the cell is clear, a hand on the stop button."
    ),
]
View: TypeAlias = Annotated[
    bool, typer.Option("--view", help="Show it in the rerun viewer as it goes.")
]
Seed: TypeAlias = Annotated[int, typer.Option("--seed", min=0, help="Random seed.")]
CameraName: TypeAlias = Annotated[
    str | None, typer.Option("--camera", help="Of a whole cell: which camera, as left.")
]
RobotName: TypeAlias = Annotated[
    str | None, typer.Option("--robot", help="Of a whole cell: which robot, as a.")
]


@dataclass(frozen=True)
class PartOptions:
    """Which camera, robot and target of a cell are meant."""

    camera: CameraName = None
    robot: RobotName = None
    target: Annotated[str | None, typer.Option(help="Of a whole cell: which target, as floor.")] = (
        None
    )

    @property
    def choice(self) -> "Choice":
        """The choice, for sessions and results."""
        from visioncal.session.selecting import Choice

        return Choice(self.camera, self.robot, self.target)


@dataclass(frozen=True)
class NeedOptions:
    """Required accuracy of the task."""

    need_mm: Annotated[
        float | None,
        typer.Option(
            help="Required accuracy of picks, in mm, on which the verdict is based; replaces the "
            "need in session.toml."
        ),
    ] = None
    need_deg: Annotated[float | None, typer.Option(help="The same in rotation, in degrees.")] = None

    def session(self, path: Path, *, corrected: bool) -> "Session":
        """Loads a session with this need, for targets that are corrected or not.

        Raises:
            DataError: It cannot be read, or the need is no positive number.
        """
        from visioncal.session import Session

        return Session.load(path).needing(self.need_mm, self.need_deg, corrected=corrected)


@dataclass(frozen=True)
class WorkOptions:
    """How a session is processed, and which drawings are made."""

    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Images searched in parallel; by default one a core. The result is the same.",
        ),
    ] = None
    no_report: Annotated[
        bool, typer.Option("--no-report", help=f"Leave {REPORT} out, which takes a second to draw.")
    ] = False
    no_recording: Annotated[
        bool,
        typer.Option("--no-recording", help=f"Leave {RECORDING} out, for the viewer."),
    ] = False
    images: Annotated[
        ImagesKept,
        typer.Option(
            help=f"What {RECORDING} keeps of them: faint copies to look at, all of them, or none. "
            "The corners found in them are kept in any case, and give the same result again."
        ),
    ] = "thumbnail"

    @property
    def left_out(self) -> tuple[str, ...]:
        """The files that are left out."""
        asked = {REPORT: self.no_report, RECORDING: self.no_recording}
        return tuple(name for name, is_left_out in asked.items() if is_left_out)
