"""Kills recordings at random moments, and looks at what they leave."""

import os
import random
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from visioncal.core.errors import DataError
from visioncal.session import Session

_PROGRAM = Path(__file__).with_name("recorded.py")


@dataclass(frozen=True)
class Killed:
    """How a killed recording ended: when, and how many views were acknowledged by then."""

    after_s: float
    acknowledged: int
    done: bool


def kill_and_resume(
    folder: Path,
    stops: int,
    kills: int,
    seed: int,
    most_s: float,
    program: Sequence[str] = (sys.executable, str(_PROGRAM)),
) -> list[Killed]:
    """Records into a folder, killed so often, each time resumed, and in the end left to finish.

    Each time the folder is loaded, and all that was acknowledged must be in it.

    Args:
        folder: Where to.
        stops: How many there are.
        kills: How often it is killed.
        seed: Of the moments.
        most_s: The latest moment after the recording began [s].
        program: What records; it is given the folder and the number of stops.
    """
    rng = random.Random(seed)
    acknowledged: set[int] = set()
    ends = []
    for _ in range(kills):
        after_s = rng.uniform(0.0, most_s)
        done = _run([*program, str(folder), str(stops)], acknowledged, after_s)
        _check(folder, acknowledged)
        ends.append(Killed(after_s, len(acknowledged), done))
        if done:
            break
    if not _run([*program, str(folder), str(stops)], acknowledged, None):
        raise AssertionError("the last recording did not end by itself")
    _check(folder, acknowledged)
    # A view may have been on the disk already when its acknowledgement was cut off.
    there = sorted(view.number for view in Session.load(folder).views)
    if there != list(range(1, stops + 1)):
        raise AssertionError(f"views {there} of {stops} are there in the end")
    return ends


def _run(command: Sequence[str], acknowledged: set[int], after_s: float | None) -> bool:
    """Runs a recording, killed after a while; whether it came to its own end before."""
    done = False
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        timer: threading.Timer | None = None
        for line in process.stdout or ():
            word = line.strip()
            if word == "begun" and after_s is not None:
                timer = threading.Timer(after_s, process.send_signal, [signal.SIGKILL])
                timer.start()
            done = done or word == "done"
            if word.isdigit():
                acknowledged.add(int(word))
        if timer is not None:
            timer.cancel()
    return done


def _check(folder: Path, acknowledged: set[int]) -> None:
    """Every acknowledged view is there, with an image that is whole."""
    try:
        session = Session.load(folder)
    except DataError as error:
        if acknowledged:
            raise AssertionError(f"{acknowledged} were acknowledged: {error}") from error
        return
    lost = acknowledged - {view.number for view in session.views}
    if lost:
        raise AssertionError(f"acknowledged views {sorted(lost)} are lost")
    for view in session.views:
        if not session.images.read(view.image).endswith(b"IEND\xaeB`\x82"):
            raise AssertionError(f"{view.image} is cut short")
