"""What the commands of `visioncal dynamics` share: which samples, and what was identified."""

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from visioncal.core.errors import DataError
from visioncal.dynamics.identified import FILE, Identified

SessionArgument: TypeAlias = Annotated[
    Path, typer.Argument(help="A session with streams of angles and torques: a folder or an .rrd.")
]
StreamOption: TypeAlias = Annotated[
    list[str] | None,
    typer.Option("--stream", help="A stream with torques; may be repeated. Default: all."),
]
CutoffOption: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--cutoff-hz", min=0.1, help="Of the low-pass. Default: ten times the motion's band."
    ),
]
GainsOption: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--gains",
        metavar="K1,K2,...",
        help="Torque for a current, by joint [N m/A], where currents were recorded.",
    ),
]
AgainstOption: TypeAlias = Annotated[
    Path | None, typer.Option("--against", help=f"A folder of identify, or its {FILE}.")
]


def number_list(words: str | None, option: str) -> tuple[float, ...]:
    """Reads a list of numbers, as many as there are.

    Raises:
        DataError: It is none.
    """
    try:
        return () if words is None else tuple(float(it) for it in words.split(","))
    except ValueError as error:
        raise DataError(
            f"{option} is {words!r}; numbers with commas between are needed.", culprits=[option]
        ) from error


def identified_of(against: Path | None, command: str) -> Identified:
    """Loads what was identified before.

    Raises:
        DataError: None is named, or it cannot be read.
    """
    if against is None:
        raise DataError(
            f"dynamics {command}: what was identified (--against {FILE}) is needed.",
            culprits=["--against"],
            next_step="Name the output folder of visioncal dynamics identify.",
        )
    return Identified.load(against)
