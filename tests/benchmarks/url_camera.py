"""How old the pictures of a network camera are against their stamps, after pauses too.

A camera on the loopback sends numbered pictures of five megapixels over HTTP. The peer is how such
a stream was read before: through OpenCV when a picture is wanted, which is taken for fresh, and
stamped, once it was waited for twice. Run from the repository's root:
`PYTHONPATH=tests python tests/benchmarks/url_camera.py [--quick]`.
"""

import argparse
import time
from collections.abc import Callable
from contextlib import closing

import cv2
import numpy as np
from results import write_section
from support.mjpeg import NetworkCamera, number_of, served

from visioncal.live.drivers.protocols import Frame
from visioncal.live.drivers.uvc import UvcCamera

RATE_HZ, SIZE = 12.0, (2592, 1944)
# Pauses in which nobody asks, and pictures that are asked for after each [s].
PAUSES_S, PICTURES = (0.0, 1.0, 4.0), 10
# What the peer took for a picture that was waited for [s].
WAITED_S = 0.008


class OnDemand:
    """The peer: OpenCV's capture, read when a picture is wanted."""

    def __init__(self, url: str) -> None:
        self._capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG)

    def frame(self) -> Frame:
        """The second picture that was waited for, stamped now."""
        waits = 0
        while waits < 2:
            began = time.monotonic()
            self._capture.grab()
            waits += time.monotonic() - began > WAITED_S
        stamp = time.monotonic()
        return Frame(self._capture.retrieve()[1], stamp)

    def close(self) -> None:
        """Lets go of it."""
        self._capture.release()


def rows(label: str, opened: Callable[[str], UvcCamera | OnDemand], *, quick: bool) -> list[str]:
    """Lines of the table for one way to read."""
    rng = np.random.default_rng(5)
    drawn = cv2.resize(rng.integers(0, 255, (486, 648), dtype=np.uint8), SIZE)
    found = []
    for pause_s in PAUSES_S[::2] if quick else PAUSES_S:
        sent = NetworkCamera(lambda: drawn, period_s=1.0 / RATE_HZ)
        ages, before, waits = [], 0, []
        with served(sent) as url, closing(opened(url)) as camera:
            for _ in range(3 if quick else PICTURES):
                time.sleep(pause_s)
                count, asked = len(sent.drawn_s), time.monotonic()
                frame = camera.frame()
                waits.append(time.monotonic() - asked)
                number = number_of(frame.image)
                ages.append(frame.stamp_s - sent.drawn_s[number])
                before += number < count
        frames = RATE_HZ * np.array(ages)
        found.append(
            f"| {label} | {pause_s:g} | {len(ages)} | {np.median(frames):.2f} | {frames.max():.2f} "
            f"| {1e3 * max(ages):.0f} | {before} | {1e3 * np.median(waits):.0f} |"
        )
    return found


def main() -> None:
    """Prints the table and keeps it; a quick one is not kept."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer pictures, and nothing is kept")
    quick = parser.parse_args().quick
    lines = [
        "| read | pause [s] | pictures | age, median [frames] | worst [frames] | worst [ms] "
        "| from before the request | waited, median [ms] |",
        "|---|---:|---:|---:|---:|---:|---:|---:|",
        *rows("all the time, as now", UvcCamera, quick=quick),
        *rows("when wanted, as before", OnDemand, quick=quick),
    ]
    text = (
        f"Pictures of {SIZE[0]} x {SIZE[1]} as JPEG, {RATE_HZ:g} a second over HTTP on the "
        "loopback, each with its number in it, requested after pauses without requests. The age is "
        "the time from drawing a picture, before encoding, to its stamp; more "
        "than one frame is too old.\n\n"
    )
    table = "\n".join(lines)
    print(text + table)
    if not quick:
        command = "PYTHONPATH=tests python tests/benchmarks/url_camera.py"
        write_section("Pictures of a network camera", command, f"{text}{table}\n")


if __name__ == "__main__":
    main()
