"""Options of how a session is worked on, which change no result."""

from dataclasses import dataclass
from typing import Annotated

import typer

from visioncal.core.choices import ImagesKept
from visioncal.interchange.outputs import RECORDING, REPORT


@dataclass(frozen=True)
class WorkOptions:
    """How a session is worked on, and what is drawn of its result."""

    threads: Annotated[
        int | None,
        typer.Option(
            min=1, help="Images searched at a time; one a core where left out. No result changes."
        ),
    ] = None
    keep_corners: Annotated[
        bool,
        typer.Option(
            "--keep-corners",
            help="Keep what is found in the images, in .visioncal in the session's folder: the "
            "next time need not look. It can be deleted.",
        ),
    ] = False
    no_report: Annotated[
        bool, typer.Option("--no-report", help=f"Leave {REPORT} out, which takes a second to draw.")
    ] = False
    no_recording: Annotated[
        bool, typer.Option("--no-recording", help=f"Leave {RECORDING} out, which holds all images.")
    ] = False
    images: Annotated[
        ImagesKept,
        typer.Option(
            help=f"What {RECORDING} keeps of them: full, so that it is the whole session; faint "
            "copies to look at; or none. Their digests are kept in any case."
        ),
    ] = "full"

    @property
    def left_out(self) -> tuple[str, ...]:
        """The files that are left out."""
        asked = {REPORT: self.no_report, RECORDING: self.no_recording}
        return tuple(name for name, is_left_out in asked.items() if is_left_out)
