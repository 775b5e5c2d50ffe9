"""Simulated UR controller as a process of its own, for the real client library to talk to.

It must be another process: the client's constructors hold the interpreter lock while they wait for
the controller. Start one by hand with
`python -m visioncal.live.rehearsal.controller --host 127.0.0.5 --robot ur10e`.
"""

import argparse
import asyncio
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

from visioncal.core.errors import DataError, DriverError
from visioncal.live.rehearsal.machine import ControllerOptions
from visioncal.live.rehearsal.serving import PORTS, ControllerServer
from visioncal.live.rehearsal.truth import TruthClient
from visioncal.simulation.arms import ArmErrors

_MODULE = "visioncal.live.rehearsal.controller"
_READY = b"ready"
# Starting takes well under a second, but much longer on a busy computer.
_START_S = 60.0
_END_S = 5.0


@dataclass(frozen=True, eq=False)
class SimulatedController:
    """A running controller; it ends with the context.

    Attributes:
        host: The loopback address that it listens on.
    """

    host: str
    process: subprocess.Popen[bytes]
    truth: TruthClient

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends it; may be called twice."""
        self.truth.close()
        _end(self.process)


def spawn(options: ControllerOptions | None = None, host: str | None = None) -> SimulatedController:
    """Starts a simulated controller at a loopback address such as `127.0.0.2`; None for any free.

    Raises:
        DriverError: It does not start, for example because a port is taken.
    """
    options = ControllerOptions() if options is None else options
    host = free_host() if host is None else host
    command = [sys.executable, "-m", _MODULE, "--host", host, "--options", _text(options)]
    pipe = subprocess.PIPE
    process = subprocess.Popen([*command, "--until-input-ends"], stdin=pipe, stdout=pipe)
    try:
        _wait(process, host)
        return SimulatedController(host, process, TruthClient(host))
    except DriverError:
        _end(process)
        raise


def free_host() -> str:
    """Finds a loopback address on which no port of a controller is taken.

    Raises:
        DriverError: There is none, as on systems whose loopback is one address only.
    """
    for host in _hosts():
        if all(_is_free(host, port) for port in PORTS):
            return host
    raise DriverError(
        "No loopback address with free ports was found for a simulated controller.",
        culprits=["127.0.0.0/8"],
        next_step="End other simulated controllers, or name an address with --host.",
    )


def _hosts() -> Iterator[str]:
    """Addresses to try; processes start at different ones."""
    first = os.getpid()
    for step in range(200):
        number = first + 251 * step
        yield f"127.{number // 62500 % 250 + 2}.{number // 250 % 250 + 2}.{number % 250 + 2}"


def _is_free(host: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True


def _wait(process: subprocess.Popen[bytes], host: str) -> None:
    """Waits until all ports listen."""
    ends_s = time.monotonic() + _START_S
    while process.stdout is not None and (remaining_s := ends_s - time.monotonic()) > 0.0:
        readable, _, _ = select.select([process.stdout], [], [], remaining_s)
        line = process.stdout.readline() if readable else b""
        if line.strip() == _READY:
            return
        if readable and not line:
            break
    raise DriverError(
        f"The simulated controller at {host} did not start within {_START_S:.0f} s, or ended.",
        culprits=[host],
        next_step=f"Look what it says: python -m {_MODULE} --host {host}",
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()


def _text(options: ControllerOptions) -> str:
    return json.dumps(asdict(options))


def _read(text: str, **more: str | int | None) -> ControllerOptions:
    """Reads what `_text` wrote, with more options where they are not None."""
    try:
        table: dict[str, Any] = json.loads(text)
        table |= {key: value for key, value in more.items() if value is not None}
        if table.get("errors") is not None:
            table["errors"] = ArmErrors(**table["errors"])
        for key in ("q", "tcp", "payload_m"):
            if key in table:
                table[key] = tuple(map(float, table[key]))
        return ControllerOptions(**table)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"--options is not a table of a controller's options: {error}.",
            culprits=["--options"],
            next_step=f"Give JSON such as {_text(ControllerOptions())}",
        ) from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a simulated controller until it is interrupted."""
    parser = argparse.ArgumentParser(prog=f"python -m {_MODULE}", description=__doc__)
    parser.add_argument("--host", default="127.0.0.2", help="the loopback address to listen on")
    parser.add_argument("--robot", help="ur3e, ur5e or ur10e")
    parser.add_argument("--seed", type=int, help="of everything random")
    parser.add_argument("--options", default="{}", help="all options, as JSON")
    parser.add_argument(
        "--until-input-ends",
        action="store_true",
        help="end with the standard input, so that no parent that is killed leaves it behind",
    )
    parsed = parser.parse_args(arguments)
    try:
        options = _read(parsed.options, robot=parsed.robot, seed=parsed.seed)
        _set_end_condition(ends_with_input=parsed.until_input_ends)
        asyncio.run(ControllerServer(options, parsed.host).run(_say_ready))
    except (DataError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


def _set_end_condition(*, ends_with_input: bool) -> None:
    """Chooses what ends the process, which has nothing to save."""
    # Ctrl-C reaches all processes of a terminal; a controller that serves another process must not
    # end before its client.
    signal.signal(signal.SIGINT, signal.SIG_IGN if ends_with_input else signal.SIG_DFL)
    if ends_with_input:
        threading.Thread(target=_end_with_input, daemon=True).start()


def _end_with_input() -> None:
    sys.stdin.buffer.read()
    os._exit(0)


def _say_ready() -> None:
    sys.stdout.buffer.write(_READY + b"\n")
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    sys.exit(main())
