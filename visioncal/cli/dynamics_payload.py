"""`visioncal dynamics payload`."""

from dataclasses import dataclass
from typing import Annotated

import typer

from visioncal.cli.dynamics import AgainstOption, MotionsArgument, StreamOptions
from visioncal.cli.options import AsJson
from visioncal.core.choices import GAIN_SIGMA


@dataclass(frozen=True)
class PayloadOptions:
    """Session with the payload, and the dynamics identified without it."""

    session: MotionsArgument
    streams: StreamOptions
    against: AgainstOption = None
    same_friction: Annotated[
        bool,
        typer.Option(
            "--same-friction", help="Friction is as it was without the payload, however it presses."
        ),
    ] = False
    gains_sigma: Annotated[
        float, typer.Option(min=0.0, help="Sigma of each of the --gains, in percent.")
    ] = 100.0 * GAIN_SIGMA
    as_json: AsJson = False


def dynamics_payload_command(options: PayloadOptions) -> None:
    """Weigh what the arm carries, by how much more its drives gave than without it.

    Exit status 0: there are figures; 2: there are none, for the reason given.
    """
    # Imported late, so that --help stays fast.
    from visioncal.cli.payload_and_gains import print_payload

    print_payload(options)
