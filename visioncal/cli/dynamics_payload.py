"""`visioncal dynamics payload`."""

from typing import Annotated

import typer

from visioncal.cli.dynamics import AgainstOption, MotionsArgument, StreamOptions
from visioncal.cli.options import AsJson
from visioncal.core.choices import GAIN_SIGMA


def dynamics_payload_command(
    session: MotionsArgument,
    streams: StreamOptions,
    against: AgainstOption = None,
    same_friction: Annotated[
        bool,
        typer.Option(
            "--same-friction", help="Friction is as it was without the payload, however it presses."
        ),
    ] = False,
    gains_sigma: Annotated[
        float, typer.Option(min=0.0, help="What each of the --gains is known to, in percent.")
    ] = 100.0 * GAIN_SIGMA,
    as_json: AsJson = False,
) -> None:
    """Weigh what the arm carries, by how much more its drives gave than without it.

    Exit status 0: there are figures; 2: there are none, for the reason given.
    """
    # Help does not wait for it.
    from visioncal.cli.weighed import print_payload

    print_payload(
        session,
        streams,
        against,
        same_friction=same_friction,
        gains_sigma=gains_sigma,
        as_json=as_json,
    )
