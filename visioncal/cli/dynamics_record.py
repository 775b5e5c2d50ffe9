"""`visioncal dynamics record`."""

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from visioncal.core.errors import DataError
from visioncal.core.files import check_free

if TYPE_CHECKING:
    from visioncal.session import Stream


def dynamics_record_command(
    out: Annotated[
        Path, typer.Argument(help="The session's folder; made, or given another stream.")
    ],
    arm: Annotated[str, typer.Option(help="The arm: ur:HOST.")],
    stream: Annotated[str, typer.Option(help="Name of the recorded stream.")] = "excite",
    robot: Annotated[
        str | None, typer.Option(help="Its model; by default what the controller says.")
    ] = None,
    rest_s: Annotated[
        float, typer.Option(min=0.5, help="The motion ends after this time at rest (s).")
    ] = 3.0,
) -> None:
    """Record angles, speeds and motor currents at the controller's full rate.

    The motion is another program's: start that once this command waits for it. Exit status 0: it
    is recorded; 2: it is not.
    """
    # Imported late, so that --help stays fast.

    from visioncal.cli.console import messages, say
    from visioncal.core.interrupts import signals_as_interrupts
    from visioncal.live.capture.motions import record_motion
    from visioncal.live.drivers.ur import UrMotion
    from visioncal.session import STREAMS, check_stream

    kind, _, host = arm.partition(":")
    if kind != "ur" or not host:
        raise DataError(
            f"--arm is {arm!r}; ur:HOST is needed, as ur:192.168.0.10.",
            culprits=["--arm"],
            next_step="Other arms' recordings go into streams/NAME.csv of a session.",
        )
    path = out / STREAMS / f"{stream}.csv"
    check_free(path, force=False, replaceable=False)
    with signals_as_interrupts(), closing(UrMotion(host)) as joints:
        found = record_motion(joints, rest_s=rest_s, report=messages().print)
        model = robot or joints.model
    check_stream(stream, found)
    _keep(out, stream, found, model)
    say(
        f"wrote {len(found)} samples to {path}. They hold currents: identify needs --gains, "
        "which visioncal dynamics gains finds"
    )


def _keep(out: Path, name: str, stream: "Stream", model: str) -> None:
    """Writes a session with the stream, or adds the stream to an existing one."""
    from visioncal.session import Session, save_stream

    if (out / "session.toml").is_file():
        save_stream(out, name, stream)
        return
    document = {"schema": 1, "name": out.name or "motions", "robot": {"model": model}}
    Session.of_streams(document, {name: stream}).save(out)
