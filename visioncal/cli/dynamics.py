"""Shared options of `visioncal dynamics`: samples, and identified dynamics."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, TypeAlias

import typer

from visioncal.cli.lazy import LazyGroup
from visioncal.cli.options import RobotName
from visioncal.core.choices import DYNAMICS_FILE
from visioncal.core.errors import DataError
from visioncal.core.number_format import some_of

# For type hints only, so that --help stays fast.
if TYPE_CHECKING:
    from visioncal.dynamics.identified import Identified
    from visioncal.dynamics.model import FrictionTerms
    from visioncal.dynamics.run import IdentificationRequest

MotionsArgument: TypeAlias = Annotated[
    Path, typer.Argument(help="A session with streams of angles and torques: a folder or an .rrd.")
]
CutoffOption: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--cutoff-hz", min=0.1, help="Of the low-pass. Default: ten times the motion's band."
    ),
]
AgainstOption: TypeAlias = Annotated[
    Path | None, typer.Option("--against", help=f"A folder of identify, or its {DYNAMICS_FILE}.")
]


class _Commands(LazyGroup):
    """Its commands, in the order of a typical workflow."""

    prefix = "dynamics_"
    listed: ClassVar = {
        "plan": "Plan the motions that determine an arm's inertias and friction.",
        "record": "Record angles, speeds and motor currents at the controller's full rate.",
        "identify": "Identify an arm's inertias and friction from the torques of its motions.",
        "validate": "Predict the torques of other motions, and say how near that comes.",
        "payload": "Weigh what the arm carries, by how much more its drives gave than without it.",
        "gains": "Find how much torque a drive's current makes, by a body that is known.",
    }


dynamics_app = typer.Typer(
    cls=_Commands,
    help="Identify an arm's inertias and friction, and weigh what it carries.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@dataclass(frozen=True)
class StreamOptions:
    """Which samples are used, and how currents become torques."""

    stream: Annotated[
        list[str] | None, typer.Option(help="A stream with torques; may be repeated. Default: all.")
    ] = None
    cutoff_hz: CutoffOption = None
    gains: Annotated[
        str | None,
        typer.Option(
            metavar="K1,K2,...",
            help="Torque for a current, by joint [N m/A], where currents were recorded.",
        ),
    ] = None
    robot: RobotName = None

    def request(self) -> "IdentificationRequest":
        """The request for the identification.

        Raises:
            DataError: The gains are no numbers.
        """
        from visioncal.dynamics.run import IdentificationRequest

        try:
            gains = tuple(float(part) for part in self.gains.split(",")) if self.gains else ()
        except ValueError as error:
            raise DataError(
                f"--gains is {self.gains!r}; numbers with commas between are needed.",
                culprits=["--gains"],
            ) from error
        return IdentificationRequest(
            tuple(self.stream or ()), cutoff_hz=self.cutoff_hz, gains_nm_a=gains, robot=self.robot
        )


def friction_terms(words: str, known: Sequence[str]) -> "FrictionTerms":
    """Reads the option --friction: names among `known`, separated by commas, or none.

    Raises:
        DataError: There is no such term.
    """
    from visioncal.dynamics.model import FrictionTerms

    wanted = [] if words.strip().lower() == "none" else [part.strip() for part in words.split(",")]
    wrong = [name for name in wanted if name not in known]
    if wrong:
        raise DataError(
            f"--friction names {some_of(wrong)[:80]}; the terms are {some_of(known)}, or none.",
            culprits=["--friction"],
        )
    return FrictionTerms(*(name in wanted for name in known))


def identified_of(against: Path | None, command: str) -> "Identified":
    """Loads identified dynamics.

    Raises:
        DataError: None are named, or they cannot be read.
    """
    from visioncal.dynamics.identified import Identified

    if against is None:
        raise DataError(
            f"dynamics {command}: what was identified (--against {DYNAMICS_FILE}) is needed.",
            culprits=["--against"],
            next_step="Name the output folder of visioncal dynamics identify.",
        )
    return Identified.load(against)
