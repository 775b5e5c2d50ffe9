"""How often slips with joints and models are named, and how often sound sessions are accused.

Simulated cells from their corners on. A slip counts as named where the words that name it, with the
joint, the columns, the rows or the arm, are among what is said up to the stage that looks at the
joints.

    PYTHONPATH=tests python tests/benchmarks/wrong_joints.py [SESSIONS]
"""

import sys
import time
from collections.abc import Callable, Iterator
from functools import cache

import numpy as np
from results import write_section
from slips import (
    SLIPS,
    Told,
    alarms,
    as_built,
    in_the_world,
    is_named,
    with_stray_offset,
    with_tool,
)

from visioncal.simulation import Cell, CellOptions, fine_camera, simulate
from visioncal.types import MOUNTS

SESSIONS = 20
ROBOTS = ("ur3e", "ur5e", "ur10e")
# Departures of lengths and angles.
ARMS = {
    "arm off by 0.5 mm, 1 mrad": (5e-4, 1e-3),
    "arm off by 2 mm, 3 mrad": (2e-3, 3e-3),
}
SOUND: dict[str, Callable[[Told, np.random.Generator], Told]] = {
    "as it is": lambda told, _: told,
    "a joint 2 deg off": with_stray_offset,
    "a tool on the flange": with_tool,
    "poses in the world": in_the_world,
    "poses of the arm as built": as_built,
}


@cache
def cell(arm: str, seed: int) -> Cell:
    """A cell of any kind."""
    length, angle = ARMS[arm]
    rng = np.random.default_rng([57, seed])
    options = CellOptions(
        mount=MOUNTS[seed % 2],
        robot=ROBOTS[rng.integers(len(ROBOTS))],
        camera=fine_camera(),
        views=int(rng.integers(10, 41)),
        pixel_sigma_px=0.1,
        dh_sigma_m=length,
        dh_sigma_rad=angle,
        seed=seed,
    )
    return simulate(options)


def sessions(arm: str, count: int, *, with_poses: bool) -> Iterator[Told]:
    """Sound sessions of many kinds."""
    return (Told.of(cell(arm, seed), with_poses=with_poses) for seed in range(count))


def table(rows: list[list[str]]) -> str:
    """Markdown of rows, the first of them the head."""
    lines = [rows[0], ["---"] * len(rows[0]), *rows[1:]]
    return "\n".join("| " + " | ".join(row) + " |" for row in lines)


def named(count: int) -> list[list[str]]:
    """Of how many sessions the slip was named."""
    worlds = [(arm, with_poses) for arm in ARMS for with_poses in (True, False)]
    rows = [["slip", *(_title(*world) for world in worlds)]]
    for name, plant in SLIPS.items():
        cells = []
        for arm, with_poses in worlds:
            if name == "base_link for base" and not with_poses:
                cells.append("cannot be told")
                continue
            found = 0
            for seed, told in enumerate(sessions(arm, count, with_poses=with_poses)):
                planted = plant(told, np.random.default_rng(seed))
                ok = is_named(planted, name)
                found += ok
                if not ok:
                    print(f"{name}, {_title(arm, with_poses)}, {seed}: {planted.words}")
                    print(f"    {planted.said()[:400]}")
            cells.append(str(found))
        rows.append([name, *cells])
    return rows


def accused(count: int) -> list[list[str]]:
    """How many sound sessions were accused."""
    worlds = [(arm, with_poses) for arm in ARMS for with_poses in (True, False)]
    rows = [["sound session", *(_title(*world) for world in worlds)]]
    for name, change in SOUND.items():
        cells = []
        for arm, with_poses in worlds:
            if not with_poses and change not in (SOUND["as it is"], with_stray_offset):
                cells.append("")
                continue
            found = 0
            for seed, told in enumerate(sessions(arm, count, with_poses=with_poses)):
                changed = change(told, np.random.default_rng(seed))
                why = alarms(changed)
                found += bool(why)
                if why:
                    print(f"{name}, {_title(arm, with_poses)}, {seed}: {why}")
                    print(f"    {changed.said()[:400]}")
            cells.append(str(found))
        rows.append([name, *cells])
    return rows


def _title(arm: str, with_poses: bool) -> str:
    return f"{arm}; {'with poses' if with_poses else 'joints alone'}"


def main(count: int) -> None:
    """Prints the tables and keeps them."""
    started = time.perf_counter()
    text = (
        f"Sessions, of {count} each, in which the planted slip was named. Both mounts, three arms, "
        "10 to 40 views, corners of 0.1 px. Without poses, the camera is what tells.\n\n"
        f"{table(named(count))}\n\n"
        f"Sound sessions, {count} of each kind, that were accused of anything.\n\n"
        f"{table(accused(count))}\n"
    )
    print(text, f"{time.perf_counter() - started:.0f} s")
    if count >= SESSIONS:
        command = "PYTHONPATH=tests python tests/benchmarks/wrong_joints.py"
        write_section("Wrong joints and wrong models of robots", command, text)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else SESSIONS)
