"""Broken inputs: how every command that reads files ends on them, in what time and memory.

Small sound inputs of every kind are made, one thing of each is broken by chance (a byte, a row, a
value, a picture, a file itself), and a command reads it. Each ends within its limits, with a result
or with one clear refusal that names a culprit, and a refusal leaves what was there as it was.

    PYTHONPATH=tests python tests/benchmarks/mutated.py [--quick] [--seed N] [--processes N]
"""

import argparse
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from results import write_section
from support.fuzz.mutants import LONGEST_S, MOST_BYTES, READINGS, Ended, walk
from support.fuzz.mutators import KINDS

MUTANTS = 2000
# With --quick one reading of so many is broken once: nineteen of the 21 commands.
QUICK = 3
# Reasons that are given less often than once in so many mutants share a row.
RARE = 250
_COLUMNS = (*KINDS, "file system")
_COMMAND = "PYTHONPATH=tests python tests/benchmarks/mutated.py"


def reason(message: str) -> str:
    """A refusal without what is of one input alone: what is needed, or else what is wrong."""
    words = re.sub(r"\S*/\S*\w|(\w\.){3,}\w*", "FILE", message.strip().partition("\n")[0])
    words = re.sub(r"'[^']*'|\"[^\"]*\"", "'...'", words)
    words = re.sub(r"\b[\w-]+\.(csv|toml|json|rrd|urdf|png|ya?ml)\b", "FILE", words)
    words = re.sub(r"-?\d[\w.]*", "N", words).partition(". ")[0]
    if "; " in words:
        words = words.rpartition("; ")[2]
    elif not re.search("TOML|JSON", words):
        words = words.partition(": ")[2] or words
    words = re.sub("^FILE(, line N)?(, column N)? ", "", words.partition(": ")[0])
    return words[:90].strip(" .:").replace("|", "/")


def by_command(ended: Sequence[Ended]) -> list[str]:
    """The rows of a table: how often each command ended with 0, 2 and 3, by what was broken."""
    rows = [
        f"| command | {' | '.join(_COLUMNS)} | slowest [s] | most memory [MB] |",
        "| --- |" + " --- |" * len(_COLUMNS) + " ---: | ---: |",
    ]
    for command in sorted({item.reading.command for item in ended}):
        mine = [item for item in ended if item.reading.command == command]
        cells = []
        for kind in _COLUMNS:
            counts = Counter(item.status for item in mine if item.kind == kind)
            cells.append(", ".join(f"{counts[count]} x {count}" for count in sorted(counts)))
        slowest = max(item.seconds for item in mine)
        most = max(item.peak_bytes for item in mine) / 1e6
        rows.append(f"| {command} | {' | '.join(cells)} | {slowest:.1f} | {most:.0f} |")
    return rows


def reasons(ended: Sequence[Ended]) -> list[str]:
    """The rows of a table: why inputs were refused."""
    found = Counter(reason(item.message) for item in ended if item.status == 2)
    often = [(words, index) for words, index in found.most_common() if index * RARE > len(ended)]
    rows = ["| refused because | times |", "| --- | ---: |"]
    rows += [f"| {words} | {index} |" for words, index in often]
    rest = found.total() - sum(index for _, index in often)
    return [*rows, f"| {len(found) - len(often)} other reasons | {rest} |"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="Few mutants, nothing kept.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    asked = parser.parse_args()
    quick, whole = range(0, len(READINGS), QUICK), range(-len(READINGS), MUTANTS)
    ended: list[Ended] = []
    with tempfile.TemporaryDirectory() as folder:
        numbers = quick if asked.quick else whole
        for item in walk(numbers, Path(folder), seed=asked.seed, processes=asked.processes):
            ended.append(item)
            if item.faults or (item.number < 0 and item.status != item.reading.sound):
                print(item, flush=True)
    mutants = [item for item in ended if item.number >= 0]
    wrong = [item for item in ended if item.faults]
    statuses = Counter(mutant.status for mutant in mutants)
    slowest, largest = max(item.seconds for item in ended), max(item.peak_bytes for item in ended)
    text = "\n".join(
        [
            f"{len(mutants)} mutants of {len(READINGS)} readings, seed {asked.seed}: "
            + ", ".join(
                f"{statuses[statuse]} with exit status {statuse}" for statuse in sorted(statuses)
            )
            + f"; {len(wrong)} with a traceback, another status, an earlier output that changed, "
            "an unclear refusal, invalid JSON, or beyond the limits of "
            f"{LONGEST_S:.0f} s and {MOST_BYTES / 1024**3:.0f} GiB. The slowest took "
            f"{slowest:.1f} s, the largest process had {largest / 1e6:.0f} MB, all libraries "
            "included. A cell of the table counts the exit statuses of a command, by the kind of "
            "broken input.",
            "",
            *by_command(mutants),
            "",
            *reasons(mutants),
        ]
    )
    print(text)
    if not asked.quick:
        write_section("Broken inputs", _COMMAND, text)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
