"""A fleet at once: how many sessions an hour, what a killed worker costs, and what stands out.

Ten simulated robots with twenty sessions each, of which one has a loose camera (it shakes at every
stop) and one is another model; twenty of the sessions are broken. Rates are between the first row
and the last: a cluster starts in some seconds.

    PYTHONPATH=tests python tests/benchmarks/batch.py [--quick] [--keep FOLDER]
"""

import argparse
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from results import write_section

from visioncal.calibration.pipeline import run
from visioncal.interchange.batch import FleetRow, batch
from visioncal.interchange.outputs import RECORDING, REPORT
from visioncal.results import Calibration, to_document
from visioncal.simulation import CellOptions, simulate, write_session

ROBOTS, WEEKS, BROKEN = 10, 20, 20
LOOSE, OTHER = 3, 7
BARE = (REPORT, RECORDING)


def write_fleet(folder: Path, robots: int, weeks: int, broken: int) -> None:
    """Pose pairs; the first session of each robot has images, for the page."""
    for robot in range(robots):
        options = CellOptions(views=12, seed=robot)
        if robot == LOOSE % robots:
            options = replace(options, robot_sigma_m=3e-4, robot_sigma_rad=6e-4)
        if robot == OTHER % robots:
            options = replace(options, robot="ur5e")
        for week in range(weeks):
            cell = simulate(replace(options, recording=week, views=8 if week == 0 else 12))
            name = f"robot_{robot:02d}/week_{week:02d}"
            write_session(cell, folder / name, images=week == 0)
    tables = sorted(folder.glob("*/week_*/views.csv"))
    for at, table in enumerate(tables[1 :: max(1, len(tables) // max(broken, 1))][:broken]):
        text = table.read_text()
        table.write_text(text[: len(text) // 3] if at % 2 else text.replace("view", "number", 1))


def facts(found: Calibration) -> dict:
    return to_document(replace(found, created=""))


@contextmanager
def engine(name: str, count: int) -> Iterator[dict[str, int | str]]:
    """The arguments of `batch` for so many workers."""
    if name == "processes":
        yield {"workers": count}
        return
    from distributed.deploy.subprocess import SubprocessCluster

    options = {"memory_limit": 0, "dashboard": False}
    with SubprocessCluster(
        n_workers=count, threads_per_worker=1, dashboard_address=None, worker_kwargs=options
    ) as cluster:
        yield {"scheduler": cluster.scheduler_address}


def rated(
    sessions: Path, out: Path, name: str, count: int, kill: bool = False
) -> tuple[float, list[FleetRow]]:
    """Sessions an hour by so many workers, and the rows."""
    begun: list[float] = []

    def progress(_: str, done: int, __: int) -> None:
        if done:
            begun.append(time.perf_counter())
        if kill and done == 5:
            os.kill(worker_of(), signal.SIGKILL)

    with engine(name, count) as arguments:
        rows = batch(sessions, out, **arguments, without=BARE, progress=progress).rows
    return 3600.0 * (len(begun) - 1) / (begun[-1] - begun[0]), list(rows)


def worker_of() -> int:
    """The process of a worker that is at work: one without children below this one."""
    children: dict[int, list[int]] = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        fields = status.read_text().rpartition(")")[2].split()
        children.setdefault(int(fields[1]), []).append(int(status.parent.name))
    below, leaves = [os.getpid()], []
    while below:
        found = children.get(below.pop(), [])
        below += found
        leaves += [index for index in found if index not in children and is_worker(index)]
    return leaves[-1]


def is_worker(process: int) -> bool:
    words = Path(f"/proc/{process}/cmdline").read_text()
    return "multiprocessing" in words and "resource_tracker" not in words


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--keep", type=Path)
    asked = parser.parse_args()
    robots, weeks, broken = (3, 2, 1) if asked.quick else (ROBOTS, WEEKS, BROKEN)
    folder = Path(tempfile.mkdtemp())
    sessions = folder / "sessions"
    write_fleet(sessions, robots, weeks, broken)
    engines = ("processes", *(("Dask",) if find_spec("distributed") else ()))
    lines = [
        "| engine | workers | sessions an hour | times one worker | results | rows with a reason |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name in engines:
        one = 0.0
        for count in (2,) if asked.quick else (1, 2, 4):
            rate, rows = rated(sessions, folder / f"{name}_{count}", name, count)
            one = one or rate
            done = sum(row.state == "done" for row in rows)
            lines.append(f"| {name} | {count} | {rate:.0f} | {rate / one:.2f} | {done} "
                         f"| {len(rows) - done} |")  # fmt: skip
        rate, rows = rated(sessions, folder / f"{name}_killed", name, 2, kill=True)
        done = [row for row in rows if row.state == "done"]
        lines.append(f"| {name}, one of them killed | 2 | {rate:.0f} | {rate / one:.2f} "
                     f"| {len(done)} | {len(rows) - len(done)} |")  # fmt: skip
    whole = folder / "page"
    rows = list(batch(sessions, whole, workers=4, without=(RECORDING,)).rows)
    sample = [row for row in rows if row.state == "done"][
        :: max(1, len(rows) // (2 if asked.quick else 10))
    ]
    same = 0
    for row in sample:
        alone = run(sessions / row.name).calibration
        verdict = alone.verdict.with_paths(sessions / row.name, whole / row.name)
        same += facts(Calibration.load(whole / row.name)) == facts(replace(alone, verdict=verdict))
    counts = [sum(row.state == state for row in rows) for state in ("done", "failed")]
    first = list(dict.fromkeys(row.group for row in rows if row.score > 0.0))
    said = [
        f"Of {len(rows)} sessions {counts[0]} have results and {counts[1]} rows a reason.",
        f"Bitwise equal to the results of `calibrate`: {same} of {len(sample)} compared.",
        f"First on the page: {', '.join(first)} (the loose camera is robot_{LOOSE % robots:02d},",
        f"the other model robot_{OTHER % robots:02d}). Load average meanwhile: ",
        f"{os.getloadavg()[2]:.0f}, on {os.cpu_count()} cores.",
    ]
    text = "\n".join([*lines, "", *said])
    print(text)
    if asked.keep:
        shutil.copytree(whole, asked.keep, dirs_exist_ok=True)
    shutil.rmtree(folder)
    if not asked.quick:
        write_section("Fleet", "PYTHONPATH=tests python tests/benchmarks/batch.py", text)


if __name__ == "__main__":
    main()
