"""Ordinary cells that nobody chose: how every command ends on them, and whether "good" is true.

PYTHONPATH=tests python tests/benchmarks/ordinary.py [FIRST_SEED] [--quick]
"""

import os
import sys
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from results import few, wished, write_section
from support.fuzz.varied import Walk, walk

CELLS, FIRST = few(2000, 4), wished(0, 0)
# Beyond this an error is no chance: in one cell of a million.
SURPRISING = 5.0
# Commands that may answer no.
ANSWERS_NO = ("calibrate", "verify")


def walked(seed: int) -> Walk:
    """Walks through the cell of a seed in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        return walk(seed, Path(folder))


def faults(done: Walk) -> list[str]:
    """What must not be."""
    found = [*done.wrong, *sorted(done.warned)]
    for command, status, said in done.steps:
        is_known = status in (0, 2) or (status == 3 and command in ANSWERS_NO)
        if not is_known or (status and not said.strip()):
            found.append(f"{command} ended with {status}: {said[-1500:]}")
    if done.verdict == "good" and done.sigmas > SURPRISING:
        found.append(f"good, and {done.sigmas:.1f} sigma off")
    return found


def main() -> None:
    """Prints what must not be, and keeps how often each command ended with which exit status."""
    seeds = range(FIRST, FIRST + CELLS)
    workers = min(len(os.sched_getaffinity(0)), 1 + CELLS // 100)
    ended: Counter[tuple[str, int]] = Counter()
    sigmas: dict[str, list[float]] = {}
    wrong = []
    with ProcessPoolExecutor(workers, get_context("spawn"), max_tasks_per_child=50) as pool:
        for seed, done in zip(seeds, pool.map(walked, seeds), strict=True):
            ended.update((command, status) for command, status, _ in done.steps)
            if done.verdict:
                sigmas.setdefault(done.verdict, []).append(done.sigmas)
            for fault in faults(done):
                wrong.append(seed)
                print(f"cell {seed}: {fault}", flush=True)
            if seed % 100 == 0:
                print(f"{seed - FIRST} cells, {len(set(wrong))} with a fault", flush=True)
    text = (
        f"{CELLS} cells, seeds from {FIRST} on; {len(set(wrong))} with a traceback, another exit "
        "status, a missing file or message, a warning of a library, or a good verdict that is off "
        f"by over {SURPRISING:g} sigma.\n\n"
        "| command | result | refused | said no | bug |\n| --- |" + " ---: |" * 4 + "\n"
    )
    for name in dict.fromkeys(command for command, _ in ended):
        text += f"| {name} | {' | '.join(str(ended[name, status]) for status in (0, 2, 3, 1))} |\n"
    text += (
        "\nThe error of all transforms together, as that of one normal number that is as unlikely "
        "[sigma]:\n\n| verdict | cells | median | 95 % | most |\n| --- |" + " ---: |" * 4 + "\n"
    )
    for verdict in ("good", "check", "bad"):
        if found := sigmas.get(verdict):
            figures = (np.median(found), np.quantile(found, 0.95), max(found))
            text += f"| {verdict} | {len(found)} | "
            text += " | ".join(f"{value:.2f}" for value in figures) + " |\n"
    print(text)
    script = "PYTHONPATH=tests python tests/benchmarks/ordinary.py"
    write_section("Ordinary cells", f"{script} {FIRST}", text)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
