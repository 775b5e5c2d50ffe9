"""Compares two checkouts world by world: accuracy, honesty, verdicts, causes and processor time.

    PYTHONPATH=tests python tests/benchmarks/compare.py BEFORE[:PYTHON] AFTER[:PYTHON][@core]
        [--worlds NAME ...] [--minutes 10] [--seeds N] [--lanes 2] [--keep FOLDER]

Each session is written once, by this checkout's simulation or by the independent generator of
`elsewhere.py`, and both checkouts work on the same folder: through commands and the results' files
alone, each in a process of its own (`compare_worker.py`). All worlds get their first seed, then all
their second, until the time is over. A checkout `@core` answers by `visioncal.fit`, without a
verdict (`core_worker.py`). A row a world, with intervals of 95 % of the paired ratio or
difference; the last line says what differs beyond chance, by a limit that counts all comparisons
(Holm 1979). Exit status 1 where anything is worse, or a bug.
"""

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from compare_worlds import WORLDS, Command, Made
from support.paired import Outcome, Pair, report

WORKER = Path(__file__).parents[1] / "support" / "compare_worker.py"
# A job that takes longer than any of the real sessions does on a loaded machine [s].
PATIENCE_S = 300.0


class Checkout:
    """A process of one checkout that does jobs; one that is killed is started anew."""

    def __init__(self, text: str) -> None:
        text, _, core = text.partition("@")
        self.options = [f"--{core}"] if core else []
        folder, _, python = text.partition(":")
        self.folder, self.python = Path(folder).resolve(), python or sys.executable
        self.process: subprocess.Popen[str] | None = None

    def ask(self, **job: Any) -> dict[str, Any]:
        """Has a job done: its status, output and processor time."""
        if self.process is None or self.process.poll() is not None:
            env = {
                "PYTHONPATH": str(self.folder),
                "OPENBLAS_NUM_THREADS": "1",
                "COLUMNS": "300",
            }
            if self.options:
                env["PYTHONPATH"] += os.pathsep + str(Path(__file__).parents[1])
            self.process = subprocess.Popen(
                [self.python, "-P", str(WORKER), *self.options], env=os.environ | env, text=True,
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        into, out = self.process.stdin, self.process.stdout
        if into is None or out is None:
            raise RuntimeError("the pipes of a process are missing")
        watch = threading.Timer(PATIENCE_S, self.process.kill)
        watch.start()
        into.write(json.dumps(job) + "\n")
        into.flush()
        line = out.readline()
        watch.cancel()
        return json.loads(line) if line else {"status": -1, "out": "", "seconds": PATIENCE_S}

    def end(self) -> None:
        """Ends the process."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()


def outcome(made: Made | Command, checkout: Checkout, out: Path) -> Outcome:
    """What a checkout makes of a session; a result without what a world reads in it is a bug."""
    try:
        return made.run(checkout.ask, out)
    except (AttributeError, LookupError, OSError, TypeError, ValueError) as error:
        return Outcome("bug", repr(error)[:80])


class Lane:
    """Two processes, one of each checkout, that take sessions by turns."""

    writing = threading.Lock()  # of sessions: the generators share this process

    def __init__(self, before: str, after: str) -> None:
        self.checkouts, self.is_warm = (Checkout(before), Checkout(after)), False

    def compare(self, world: str, seed: int, folder: Path) -> Pair | None:
        """Writes one session and has both work on it; None where the world has no more of them."""
        with self.writing:
            made = WORLDS[world](seed, folder)
        if made is None:
            return None
        # What a process does first it does with imports, which are no part of the comparison.
        for checkout in () if self.is_warm else self.checkouts:
            outcome(made, checkout, folder / "first" / checkout.folder.name)
        self.is_warm = True
        # Neither is always the first to read the files.
        sides = list(zip(("before", "after"), self.checkouts, strict=True))[:: (-1) ** seed]
        return Pair(world, seed, **{name: outcome(made, checkout, folder / name)
                                    for name, checkout in sides})  # fmt: skip


def compared(arguments: argparse.Namespace, names: Sequence[str], folder: Path) -> list[Pair]:
    """All pairs that there is time for."""
    every: Iterable[tuple[str, int]] = (
        (name, seed)
        for seed in (range(arguments.seeds) if arguments.seeds else itertools.count())
        for name in names
    )
    until, rest, pairs, done = time.monotonic() + 60.0 * arguments.minutes, iter(every), [], set()

    def work() -> None:
        lane = Lane(arguments.before, arguments.after)
        while arguments.seeds or time.monotonic() < until:
            with Lane.writing:
                # Worlds that have no more sessions leave the rest to others.
                left = set(names) - done
                job = next((job for job in rest if job[0] in left), None) if left else None
            if job is None:
                break
            pair = lane.compare(*job, folder / f"{job[0]}, {job[1]}".replace("/", "_"))
            if pair is None:
                done.add(job[0])
            else:
                pairs.append(pair)
        for checkout in lane.checkouts:
            checkout.end()

    with ThreadPoolExecutor(arguments.lanes) as pool:
        for lane in [pool.submit(work) for _ in range(arguments.lanes)]:
            lane.result()
    return sorted(pairs, key=lambda pair: (pair.world, pair.seed))


def main() -> None:
    """Prints the table; keeps sessions, results and `pairs.json` where that is asked."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    for side in ("before", "after"):
        parser.add_argument(side, nargs="?", default=str(Path(__file__).parents[2]))
    parser.add_argument("--worlds", nargs="+", default=[""], help="beginnings of names")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seeds", type=int, help="so many of each world, however long it takes")
    parser.add_argument("--lanes", type=int, default=2, help="processes of each checkout")
    parser.add_argument("--keep", type=Path, help="a folder for sessions and results")
    parser.add_argument("--quick", action="store_true")
    arguments = parser.parse_args()
    names = [name for name in WORLDS if name.startswith(tuple(arguments.worlds))]
    if arguments.quick:
        arguments.seeds, names = 1, names[:2]
    if not names:
        sys.exit(f"no world begins so; there are: {', '.join(WORLDS)}")
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.keep or Path(temporary)
        pairs = compared(arguments, names, folder)
        if arguments.keep:
            (folder / "pairs.json").write_text(json.dumps([asdict(pair) for pair in pairs]))
    text, odd = report(pairs)
    print(text)
    broken = [pair for pair in pairs if pair.after.status == "bug"]
    if broken:
        print(f"bugs: {', '.join(f'{pair.world} {pair.seed}' for pair in broken)}")
    sys.exit(bool(broken) or any(item.is_worse for item in odd))


if __name__ == "__main__":
    main()
