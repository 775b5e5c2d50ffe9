"""Broken inputs: how every command that reads files ends on them, and in what time.

PYTHONPATH=tests python tests/benchmarks/mutated.py [SEED] [--quick]
"""

import sys
import tempfile
from collections import Counter
from pathlib import Path

from results import few, wished, write_section
from support.fuzz.mutants import LONGEST_S, MOST_KB, READINGS, walk

MUTANTS, SEED = few(2000, 30), wished(0, 0)


def main() -> None:
    """Prints what must not be, and keeps how often each command ended with which exit status."""
    with tempfile.TemporaryDirectory() as folder:
        sound = few(-len(READINGS), 0)
        ended = [*walk(range(sound, MUTANTS), Path(folder), seed=SEED)]
    wrong = [item for item in ended if item.faults or (item.number < 0 and item.status == 2)]
    mutants = [item for item in ended if item.number >= 0]
    statuses = Counter((item.reading.split()[0], item.status) for item in mutants)
    slowest = Counter()
    for item in mutants:
        name = item.reading.split()[0]
        slowest[name] = max(slowest[name], item.seconds)
    text = (
        f"{MUTANTS} mutants of {len(READINGS)} readings, seed {SEED}; {len(wrong)} with a "
        "traceback, another status, an earlier output that changed, an unclear refusal, or beyond "
        f"the limits of {LONGEST_S} s and {MOST_KB / 1024**2:.0f} GiB.\n\n"
        "| command | result | refused | said no | slowest [s] |\n| --- |" + " ---: |" * 4 + "\n"
    )
    for name in sorted(slowest):
        counts = (str(statuses[name, status]) for status in (0, 2, 3))
        text += f"| {name} | {' | '.join(counts)} | {slowest[name]:.1f} |\n"
    print(*wrong, text, sep="\n")
    write_section("Broken inputs", "PYTHONPATH=tests python tests/benchmarks/mutated.py", text)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
