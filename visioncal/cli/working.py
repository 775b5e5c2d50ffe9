"""Options of how a session is worked on, which change no result."""

from typing import Annotated, TypeAlias

import typer

from visioncal.interchange.outputs import RECORDING, REPORT

NoReport: TypeAlias = Annotated[
    bool, typer.Option("--no-report", help=f"Leave {REPORT} out, which takes a second to draw.")
]
NoRecording: TypeAlias = Annotated[
    bool, typer.Option("--no-recording", help=f"Leave {RECORDING} out, which holds all images.")
]
Threads: TypeAlias = Annotated[
    int | None,
    typer.Option(
        min=1, help="Images searched at a time; one a core where left out. No result changes."
    ),
]


def left_out(*, report: bool, recording: bool) -> tuple[str, ...]:
    """The files that these options leave out."""
    asked = {REPORT: report, RECORDING: recording}
    return tuple(name for name, is_left_out in asked.items() if is_left_out)
