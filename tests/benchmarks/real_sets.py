"""Real recordings: verdict, sigma, and how far left-out views are off, beside Park's answer.

    PYTHONPATH=tests python tests/benchmarks/real_sets.py [NAME ...]

Nobody knows the truth of these; what was wrong with each is in the folder's own description.
"""

import textwrap
from multiprocessing import Pool
from pathlib import Path

from results import QUICK, WORDS, write_section

import visioncal
from visioncal.core.errors import VisioncalError

SESSIONS = Path(__file__).parents[3] / "shared" / "data" / "sessions"
WORKERS = 2
HEAD = (
    "session", "verdict", "left out", "sigmas", "left-out views", "all, Park's", "first"
)  # fmt: skip


def first_words(text: str) -> str:
    """What a table has room for of a sentence."""
    return textwrap.shorten(text.split(". ")[0], 140, placeholder=" ...")


def both(mm: float, deg: float | None) -> str:
    """A length and, where it is known, an angle."""
    return f"{mm:.2g} mm" + ("" if deg is None else f", {deg:.2g} deg")


def row_of(session: Path) -> tuple[str, ...]:
    """Calibrates one session: the cells of its row."""
    try:
        result = visioncal.calibrate(session)
    except VisioncalError as refused:
        return session.name, "refused", *[""] * 4, first_words(str(refused))
    unused = [view.view for view in result.views if not view.used]
    words = " ".join(map(str, unused)) if len(unused) < 15 else f"{len(unused)} views"
    sigmas = [both(edge.sigma_mm, edge.sigma_deg) for edge in result.placed.values()]
    held_out, park = result.validation.held_out, result.solvers.get("park")
    return (
        session.name,
        result.verdict.status,
        words or "none",
        "; ".join(sigmas),
        both(held_out.mm, held_out.deg),
        "" if park is None else both(park.rms_mm, park.rms_deg),
        first_words(result.verdict.top[0]),
    )


def main() -> None:
    """Prints the table and keeps it."""
    sessions = [path for path in sorted(SESSIONS.iterdir()) if (path / "session.toml").is_file()]
    wished = [session for session in sessions if session.name in WORDS] if WORDS else sessions
    with Pool(WORKERS) as pool:
        rows = pool.map(row_of, wished[-1:] if QUICK else wished, chunksize=1)
    lines = [HEAD, ["---"] * len(HEAD), *rows]
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    print(table)
    if not WORDS:
        text = f"""Sigmas are those of the camera and of the board or, by an instrument, of its
base and probe. Views are left out one by one, and the others fitted again; for Park's solution
(from the same views, with poses from the fitted lens and board) the residuals are those of the
views in its fit. The true values are unknown.

{table}
"""
        command = "PYTHONPATH=tests python tests/benchmarks/real_sets.py"
        write_section("Real recordings", command, text)


if __name__ == "__main__":
    if SESSIONS.is_dir():
        main()
    else:
        print(f"left out: {SESSIONS} is absent")
