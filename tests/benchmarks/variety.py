"""Ordinary cells: what the commands make of worlds that nobody chose.

Each seed is a cell of `tests/varied_cells.py`: a board, a camera, a mount, a robot and a motion
drawn from what a user may declare, rendered and named by rules of its own. All commands go through
it. Looked at are how they end, whether all files are there, and how far the result is from the
truth in units of its sigma.

    PYTHONPATH=tests python tests/benchmarks/variety.py [--cells N] [--quick] [--processes N]
"""

import argparse
import os
import pickle
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from multiprocessing import get_context
from pathlib import Path

# OpenCV warns of every board whose markers nearly fill their squares, and of torn images.
os.environ.setdefault("OPENCV_LOG_LEVEL", "OFF")

import numpy as np
from results import write_section
from support.fuzz.varied_walk import Step, Walk, walk

CELLS, QUICK = 2000, 6
# An error that is as unlikely as one of so many sigmas of a normal number.
SURPRISING = 5.0
HEAD = 90  # letters of a message that are counted as one reason


def of_one_cell(seed: int) -> Walk:
    with tempfile.TemporaryDirectory() as folder:
        return walk(seed, Path(folder), whole=False)


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def traits(walks: Sequence[Walk]) -> str:
    """What the cells were."""
    counts: dict[str, Counter[str]] = {}
    for item in walks:
        for trait, value in item.facts.items():
            counts.setdefault(trait, Counter())[value] += 1
    rows = [
        (trait, ", ".join(f"{value} {count}" for value, count in of.most_common()))
        for trait, of in counts.items()
    ]
    return "\n".join(f"- {trait}: {words}" for trait, words in rows)


def ends(walks: Sequence[Walk]) -> str:
    """How the commands ended."""
    steps = [step for item in walks for step in item.steps]
    rows = []
    for command in dict.fromkeys(step.command for step in steps):
        of = [step for step in steps if step.command == command]
        states = Counter(step.status for step in of)
        taken = [step.seconds for step in of if step.seconds]
        rows.append((command, len(of), *(states[name] for name in (0, 2, 3, 1)),
                     f"{np.median(taken):.2f}" if taken else ""))  # fmt: skip
    return table(("command", "runs", "result", "refused", "said no", "bug", "median s"), rows)


def refusals(walks: Sequence[Walk]) -> str:
    """What was refused, by command, class and the beginning of the message."""
    found = Counter(
        (step.command, step.error, reason(step))
        for item in walks
        for step in item.steps
        if step.status == 2
    )
    rows = [(*key, count) for key, count in sorted(found.items(), key=lambda pair: -pair[1])]
    return table(("command", "class", "message", "count"), rows)


def reason(step: Step) -> str:
    """The beginning of a message, without the names and figures of its cell."""
    words = []
    for word in step.message.replace("|", "/").split():
        plain = word.isascii() and not any(name in "'\"0123456789" for name in word)
        kept = word if plain else "..."
        if not (kept == "..." and words and words[-1] == "..."):
            words.append(kept)
    return " ".join(words)[:HEAD]


def errors(walks: Sequence[Walk]) -> str:
    """Error over sigma, by verdict and by what may spoil it."""
    found = [item for item in walks if item.error is not None]
    rows = [
        _errors(verdict, [item for item in found if item.verdict == verdict])
        for verdict in ("good", "check", "bad")
    ]
    good = [item for item in found if item.verdict == "good"]
    for trait in ("corners", "boards", "intrinsics", "motion", "seen"):
        for value in sorted({item.facts[trait] for item in good}):
            of = [item for item in good if item.facts[trait] == value]
            rows.append(_errors(f"good, {trait}: {value}", of))
    head = ("cells", "number", "mean chi2 / dof", "median", f"beyond {SURPRISING:g} sigma")
    return table(head, rows)


def _errors(words: str, of: Sequence[Walk]) -> tuple[object, ...]:
    per_dof = [item.error.per_dof for item in of if item.error is not None]
    beyond = sum(item.error.sigmas > SURPRISING for item in of if item.error is not None)
    if not per_dof:
        return words, 0, "", "", 0
    return words, len(of), f"{np.mean(per_dof):.2f}", f"{np.median(per_dof):.2f}", beyond


def tell(walks: Sequence[Walk]) -> str:
    """All tables, and what should not be, cell by cell."""
    bugs = [(item.seed, step) for item in walks for step in item.steps if step.status == 1]
    missing = [(item.seed, words) for item in walks for words in item.missing]
    mute = [(item.seed, step.command) for item in walks for step in item.steps
            if step.status == 2 and not (step.culprits or step.message)]  # fmt: skip
    beyond = [item for item in walks if item.verdict == "good" and item.error is not None
              and item.error.sigmas > SURPRISING]  # fmt: skip
    warned = Counter(words for item in walks for words in item.warned)
    for seed, step in bugs:
        print(f"BUG seed {seed}, {step.command}:\n{step.trace}", file=sys.stderr)
    lines = [
        f"- seed {item.seed}: {item.error.sigmas:.1f} sigma, {item.error.per_dof:.1f} per dof; "
        + ", ".join(item.facts.values())
        for item in beyond
        if item.error is not None
    ]
    lines += [f"- seed {seed}: {words}" for seed, words in missing]
    lines += [
        f"- seed {seed}: `{step.trace.strip().splitlines()[-1][:200]}`" for seed, step in bugs
    ]
    median_s = np.median(
        [item.drawn_s + sum(step.seconds for step in item.steps) for item in walks]
    )
    return f"""{len(walks)} cells, seeds from {walks[0].seed} on; the median cell takes
{median_s:.1f} s. Exit status 1: {len(bugs)}. Files or messages missing:
{len(missing) + len(mute)}. "good" and beyond {SURPRISING:g} sigma: {len(beyond)}. Warnings of
libraries: {sum(warned.values())}.
{chr(10).join(["", *lines]) if lines else ""}

{ends(walks)}

`calibrate` and the check of the recording's layout run in all cells, the others in some. A "no"
from `verify` is a false alarm, since the world has not changed.

{errors(walks)}

chi2 is computed for all free transforms together with their joint covariance, and converted to the
sigmas of a normal variable of equal probability. Of a checkerboard's symmetric frames, the best
fit is used. Corners are not "as finders like" on checkerboards with squares under 32 px and on
ChArUco boards whose markers come within 4.5 px of the corners or fill more than 0.7 of the
square: there OpenCV's corners have a common bias in whole views, which no covariance includes.

What the cells were:

{traits(walks)}

What was refused:

{refusals(walks)}
"""


def main() -> None:
    """Walks through the cells, prints the tables and keeps them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=CELLS)
    parser.add_argument("--seed", type=int, default=0, help="the first seed")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--quick", action="store_true", help=f"{QUICK} cells, and nothing is kept")
    parser.add_argument("--kept", type=Path, help="a file that keeps cells, to go on from")
    chosen = parser.parse_args()
    walks = _known(chosen.kept)
    known = {item.seed for item in walks}
    seeds = range(chosen.seed, chosen.seed + (QUICK if chosen.quick else chosen.cells))
    begun = time.perf_counter()
    # Spawned, since OpenCV's threads do not survive a fork; renewed, since pictures fill memory.
    with get_context("spawn").Pool(chosen.processes, maxtasksperchild=50) as pool:
        left = [seed for seed in seeds if seed not in known]
        for done, item in enumerate(pool.imap_unordered(of_one_cell, left), 1):
            walks.append(item)
            if chosen.kept is not None:
                with chosen.kept.open("ab") as file:
                    pickle.dump(item, file)
            if done % 50 == 0:
                print(
                    f"{done} of {len(left)} cells, {time.perf_counter() - begun:.0f} s", flush=True
                )
    text = tell(
        sorted((item for item in walks if item.seed in seeds), key=lambda value: value.seed)
    )
    print(text)
    if not chosen.quick:
        write_section("Ordinary cells", "PYTHONPATH=tests python tests/benchmarks/variety.py", text)


def _known(path: Path | None) -> list[Walk]:
    found: list[Walk] = []
    if path is not None and path.exists():
        with path.open("rb") as file:
            while file.peek(1):
                found.append(pickle.load(file))
    return found


if __name__ == "__main__":
    main()
