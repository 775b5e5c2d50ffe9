"""How the time and memory of a calibration grow with its views and its cameras.

Corners are drawn (no images are rendered), and every size runs in a process of its own on one core.
An exponent is the slope of the time over the size, both as logarithms, fitted to the upper half of
the sizes: below it what does not grow with them counts, too.

    PYTHONPATH=tests python tests/benchmarks/growth.py [--quick]
"""

import argparse
import os
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
from results import first, write_section
from support.cells import known_of

from visioncal.calibration.pipeline import calibrate
from visioncal.calibration.pipeline.steps import STAGES
from visioncal.simulation import CellOptions, fine_camera, simulate
from visioncal.simulation.layout import CameraAt, Moved, NetworkOptions
from visioncal.simulation.records import cell_session

VIEWS = (20, 60, 125, 250, 500, 1000)
CAMERAS = (2, 4, 6, 8, 10)
STOPS = 200
PLAIN = CellOptions(camera=fine_camera(), pixel_sigma_px=0.1)
WRONG_ARM = replace(PLAIN, dh_sigma_m=3e-4, dh_sigma_rad=3e-4, branches=True)
# Stages whose time is named by itself.
NAMED = ("solve", "examine")


def seconds_of(options: CellOptions, *, joints: bool) -> dict[str, float]:
    """Processor time by stage of one simulated cell [s]."""
    known, taken = known_of(simulate(options), joints=joints), {}
    for stage in STAGES:
        if stage.name not in ("robot", "detect"):
            begin = time.process_time()
            known = stage.run(known)
            taken[stage.name] = time.process_time() - begin
    return taken


def of_views(task: tuple[CellOptions, bool]) -> dict[str, float]:
    options, joints = task
    taken = seconds_of(options, joints=joints)
    return {"all": sum(taken.values()), **{name: taken[name] for name in NAMED if name in taken}}


def of_cameras(task: tuple[int, int, bool]) -> dict[str, float]:
    """Processor time [s] and what memory grew by [MB] of a whole cell."""
    cameras, stops, faulty = task
    turns = 2 * np.pi * np.arange(cameras) / cameras
    around = tuple(
        CameraAt(f"c{at}", place_m=(1.1 * np.cos(turn), 1.1 * np.sin(turn), 1.1))
        for at, turn in enumerate(turns.tolist())
    )
    faults = {
        "moved": (Moved("target_floor", stops // 2), Moved("cam_c1", stops // 3)),
        "swapped_rows": 1,
        "stray_images": 6,
    }
    options = NetworkOptions(cameras=around, stops=stops, seed=1, **(faults if faulty else {}))
    cell = simulate(options)
    session = cell_session(cell, "network", seen="names")
    corners = {view_corners.view: view_corners for view_corners in cell.corners}
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begin = time.process_time()
    found = calibrate(session, corners=corners)
    taken = time.process_time() - begin
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return {
        "all": taken,
        "memory": grown / 1024,
        "moved": float(len(found.cell.moved)),
        "rows": float(len(found.views)),
    }


def exponent(sizes: Sequence[float], taken: Sequence[float]) -> float:
    """Slope of the logarithms over the upper half of the sizes."""
    half = len(sizes) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(taken[half:]), 1)[0])


def run_each(run: Callable, tasks: list, *, quick: bool) -> list[dict[str, float]]:
    """Runs every task in a fresh process, one after the other; quickly, all in this one."""
    if quick:
        return [run(task) for task in tasks]
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        return pool.map(run, tasks, chunksize=1)


def views_table(views: Sequence[int], *, quick: bool) -> str:
    lines = [
        f"| cell | {' | '.join(f'{view} views [s]' for view in views)} | exponent |",
        f"| --- | {' | '.join('---:' for _ in views)} | ---: |",
    ]
    kinds = (
        ("lens given, in hand", PLAIN, False),
        ("lens estimated, to hand", replace(PLAIN, state_intrinsics=False, mount="eye-to-hand"),
         False),
        ("with an arm", WRONG_ARM, True),
    )  # fmt: skip
    for words, options, joints in first(kinds):
        tasks = [(replace(options, views=view), joints) for view in views]
        found = run_each(of_views, tasks, quick=quick)
        for name in ("all", *NAMED):
            taken = [one.get(name, 0.0) for one in found]
            if min(taken) > 1e-3:
                figures = " | ".join(f"{value:.3f}" for value in taken)
                label = words if name == "all" else f"of it: {name}"
                lines.append(f"| {label} | {figures} | {exponent(views, taken):.2f} |")
    return "\n".join(lines)


def cameras_table(cameras: Sequence[int], stops: int, small: int, *, quick: bool) -> str:
    tasks = [(camera, stops, False) for camera in cameras] + [
        (item, stops, True) for item in first(cameras)
    ]
    tasks += [(4, small, False)]
    found = run_each(of_cameras, tasks, quick=quick)
    lines = [
        "| cameras x stops | rows | s | MB | moves named |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for (count, stops_of, faulty), taken in zip(tasks, found, strict=True):
        words = f"{count} x {stops_of}{', faults' if faulty else ''}"
        lines.append(
            f"| {words} | {taken['rows']:.0f} | {taken['all']:.2f} | {taken['memory']:.0f} "
            f"| {taken['moved']:.0f} |"
        )
    slope = exponent(cameras, [taken["all"] for taken in found[: len(cameras)]])
    return "\n".join([*lines, "", f"Exponent over the number of cameras: {slope:.2f}."])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    views, cameras, stops, small = VIEWS, CAMERAS, STOPS, 40
    if quick:
        views, cameras, stops, small = (20, 25, 30), (2, 3, 4), 12, 12
    tables = views_table(views, quick=quick), cameras_table(cameras, stops, small, quick=quick)
    busy = f"Load average meanwhile: {os.getloadavg()[2]:.0f} on {os.cpu_count()} cores."
    text = "\n\n".join([*tables, busy])
    print(text)
    if not quick:
        write_section("Growth", "PYTHONPATH=tests python tests/benchmarks/growth.py", text)


if __name__ == "__main__":
    main()
