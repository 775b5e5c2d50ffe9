"""Sessions that are broken in the usual ways: what is said first, and whether that mends them.

Each mistake of `support.fuzz.broken_sessions` is planted into the same sound session. `calibrate`
runs on it; what it says first is looked up for the mistake's name; and what it says to do is typed.

    PYTHONPATH=tests python tests/benchmarks/first_hour.py [--quick]
"""

import re
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from results import first, write_section
from support.commands import visioncal
from support.fuzz.broken_sessions import BROKEN, Mistake, broken_session
from support.fuzz.typed_fixes import mended

_COMMAND = "PYTHONPATH=tests python tests/benchmarks/first_hour.py"
# A sentence that is longer is cut in the table.
_LONGEST = 230


@dataclass(frozen=True)
class Walked:
    """What became of a broken session."""

    status: int  # The exit status of calibrate.
    sentence: str  # What it said first.
    seconds: float  # How long it took.
    is_named: bool  # Whether that names the mistake, or there was nothing to say.
    after: str  # The verdict once the fix was typed; empty where nothing can be typed.
    found_s: float  # How long doctor took [s].


def walked(mistake: Mistake, folder: Path) -> Walked:
    """Breaks a session, calibrates it, and does what it says."""
    session = broken_session(folder / "session", mistake)
    begun = time.perf_counter()
    visioncal("doctor", session)
    doctored = time.perf_counter()
    done = visioncal("calibrate", session, "-o", folder / "out")
    seconds = time.perf_counter() - doctored
    said = [line.strip() for line in done.said.splitlines() if line.strip()]
    is_good = done.status == 0 and any(name.startswith("good ") for name in said)
    lines = [name for name in said if name.startswith(("error:", "- "))]
    sentence = re.sub(r"^(error:|- )\s*(Most likely \([^)]*\):)?\s*", "", lines[0])
    sentence = sentence.replace(f"{session}/", "").replace(str(session), "SESSION")
    nothing = is_good and not re.search(mistake.names, sentence, re.I)
    is_named = bool(re.search(mistake.names, sentence, re.I)) or (nothing and mistake.names == "-")
    if nothing and mistake.names == "-":
        after = "good"
    else:
        after = mended(session, done.said, folder / "fixed") if mistake.is_mended else ""
    return Walked(done.status, sentence, seconds, is_named, after, doctored - begun)


def main() -> None:
    rows = [
        "| mistake | status | said first | names it | typed, the verdict is | calibrate [s] |"
        " doctor [s] |",
        "| --- | ---: | --- | --- | --- | ---: | ---: |",
    ]
    found = []
    for name, mistake in first(list(BROKEN.items())):
        with tempfile.TemporaryDirectory() as folder:
            walk = walked(mistake, Path(folder))
        found.append(walk)
        cut = walk.sentence if len(walk.sentence) < _LONGEST else f"{walk.sentence[:_LONGEST]} ..."
        named, after = "yes" if walk.is_named else "no", walk.after or "(nothing to type)"
        row = (
            f"| {name} | {walk.status} | {cut.replace('|', '/')} | {named} | {after} | "
            f"{walk.seconds:.1f} | {walk.found_s:.1f} |"
        )
        print(row, flush=True)
        rows.append(row)
    named = sum(item.is_named for item in found)
    good = sum(item.after == "good" for item in found)
    text = "\n".join(
        [
            f"{len(found)} sessions of 15 rendered views, each with one mistake of the first hour: "
            f"{named} are named by the first sentence of `calibrate`, and {good} are `good` "
            "after its commands are typed, by a program that follows the messages. Blur "
            "and poor motion need a new recording; poses of the tool only give a note. "
            "Files in the style of other programs (semicolons, decimal commas, byte-order "
            "marks, empty rows) are read unchanged.",
            "",
            *rows,
        ]
    )
    write_section("The first hour", _COMMAND, text)


if __name__ == "__main__":
    main()
