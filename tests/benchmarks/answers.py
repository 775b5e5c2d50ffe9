"""Where the estimator's answers differ from those that are kept, of sixty cells and real sessions.

    PYTHONPATH=tests python tests/benchmarks/answers.py [--quick] [--write] [--real FILE]

`--write` keeps today's answers of the cells. Those of the real sessions in ../shared/data are kept
in FILE, which is made where there is none: run it once before a change and once after.
"""

import argparse
import json
from collections.abc import Callable, Mapping
from multiprocessing import Pool
from pathlib import Path
from typing import Any

from support.kept_answers import (
    KEPT,
    Answer,
    answer_of,
    answer_of_session,
    away_in_sigmas,
    cases,
    kept,
    levels_apart,
    sigmas_apart,
)

SESSIONS = Path(__file__).parents[3] / "shared" / "data" / "sessions"


def of_cell(name: str) -> tuple[str, Answer]:
    return name, answer_of(cases()[name])


def of_session(folder: Path) -> tuple[str, Answer]:
    return folder.name, answer_of(lambda: answer_of_session(folder))


def line(name: str, answer: Answer, before: Mapping[str, Any]) -> str:
    """One row: the largest differences, and the facts that are others."""
    words = dict(answer.words)
    others = {word: (before["words"].get(word), at) for word, at in words.items()
              if before["words"].get(word) != at}  # fmt: skip
    if answer.edges.keys() != before["edges"].keys():
        return f"| {name} | - | - | - | {others} |"
    figures = (away_in_sigmas(answer, before), sigmas_apart(answer, before),
               levels_apart(answer, before))  # fmt: skip
    return f"| {name} | {' | '.join(f'{figure:.1e}' for figure in figures)} | {others or 'same'} |"


def compared(pool, run: Callable, items: list, before: Mapping[str, Any]) -> dict[str, Any]:
    """Prints the table; returns today's answers."""
    print("| cell | edges [sigmas] | sigmas [share] | noise levels [share] | facts |")
    print("| --- | ---: | ---: | ---: | --- |")
    found = {}
    for name, answer in pool.imap(run, items):
        found[name] = answer.document()
        print(line(name, answer, before.get(name, found[name])), flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--real", type=Path)
    asked = parser.parse_args()
    names = sorted(cases())[:: 20 if asked.quick else 1]
    with Pool() as pool:
        before = kept() if KEPT.exists() else {}
        found = compared(pool, of_cell, names, before)
        if asked.write and not asked.quick:
            rows = (f"{json.dumps(name)}: {json.dumps(found[name])}" for name in sorted(found))
            KEPT.write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")
        if asked.real is not None and SESSIONS.is_dir():
            then = json.loads(asked.real.read_text()) if asked.real.exists() else None
            folders = sorted(path for path in SESSIONS.iterdir() if (path / "views.csv").exists())
            real = compared(pool, of_session, folders, then or {})
            if then is None:
                asked.real.write_text(json.dumps(real, indent=1))


if __name__ == "__main__":
    main()
