"""Runs a command that drives what is simulated in real time: `python real_time.py COMMAND ...`.

Such a command fails where the computer itself stands still for a moment, or has more to do than it
has processors: a client library then finds every partner silent, and gives up or aborts. Both are
measured beside the command. A failure without either is a failure, and its status is returned; one
with either is tried again, and left out with clear words after the third time.
"""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from tempfile import TemporaryDirectory

# A process that sleeps for 10 ms wakes within a few more on a busy computer; a controller sends
# every 8 ms, and is called silent after 800.
_NAP_S, _STALL_S = 0.01, 0.25
# The command itself takes two processors.
_BUSY = 1.5
_TIMES = 3


def main(command: Sequence[str]) -> int:
    """Runs it; `{out}` in an argument is a folder that is new each time."""
    for attempt in range(1, _TIMES + 1):
        with TemporaryDirectory() as out:
            process = subprocess.Popen([name.replace("{out}", out) for name in command])
            longest_s = _longest_stall_s(process)
        if process.returncode == 0:
            return 0
        load, cores = os.getloadavg()[0], len(os.sched_getaffinity(0))
        if longest_s < _STALL_S and load < _BUSY * cores:
            return process.returncode
        busy = f"its load was {load:.1f} on {cores} processors"
        print(
            f"attempt {attempt}: this computer stood still for {longest_s:.2f} s, {busy}",
            flush=True,
        )
    print(f"left out, as it cannot be driven in real time here: {' '.join(command)}", flush=True)
    return 0


def _longest_stall_s(process: subprocess.Popen[bytes]) -> float:
    """How long this computer stood still at most while a process ran [s]."""
    ended = threading.Event()
    threading.Thread(target=lambda: (process.wait(), ended.set()), daemon=True).start()
    longest_s, before_s = 0.0, time.monotonic()
    while not ended.wait(_NAP_S):
        now_s = time.monotonic()
        longest_s, before_s = max(longest_s, now_s - before_s - _NAP_S), now_s
    return longest_s


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
