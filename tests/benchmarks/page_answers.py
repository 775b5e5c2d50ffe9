"""How soon the page answers what a person does, while nothing else runs, and while a trial does.

PYTHONPATH=tests python tests/benchmarks/page_answers.py
"""

import shutil
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import psutil
from results import few, write_section
from scipy.spatial.transform import Rotation
from support.commands import visioncal as command
from support.page import launched, opened, served

from visioncal import Session

VIEWS, ROUNDS = few((24, 12), (10, 1))


def line(view) -> str:
    """The pose of a view, as a KUKA's pendant shows it."""
    matrix = np.asarray(view.base_from_flange().as_matrix())
    angles = Rotation.from_matrix(matrix[:3, :3]).as_euler("ZYX", degrees=True)
    numbers = [*(1e3 * matrix[:3, 3]), *angles]
    return " ".join(f"{name} {value:.5f}" for name, value in zip("XYZABC", numbers, strict=True))


def is_trying(page: psutil.Process) -> bool:
    """Whether a trial's process is there."""
    return bool(page.children())


def main() -> None:
    """Prints the times, and keeps them."""
    seconds = defaultdict(list)
    with tempfile.TemporaryDirectory() as name, launched() as browser:
        folder = Path(name)
        command("simulate", folder / "seen", "--views", VIEWS, "--robot", "generic-6r-1800")
        views = Session.load(folder / "seen").views
        lines = [line(view) for view in views]
        (folder / "inbox").mkdir()
        for number, view in enumerate(views, 1):
            shutil.copy(folder / "seen" / view.image, folder / "inbox" / f"shot{number:02}.png")
        words = ("record", "-o", folder / "cell", "--target", "charuco_9x6_30mm", "--arm", "manual")
        with (
            served(*words, "--camera", f"folder:{folder / 'inbox'}") as (url, process),
            opened(browser, url) as page,
        ):
            server = psutil.Process(process.pid)

            def timed(what: str, act, shown) -> None:
                tried = is_trying(server)
                begun = time.perf_counter()
                act()
                shown()
                taken = time.perf_counter() - begun
                if tried == is_trying(server):
                    seconds[what, tried].append(taken)

            pose = page.get_by_label("Pose of the flange")
            pose.fill("\n".join(lines[:-1]))
            page.get_by_text("Read as KUKA").wait_for()
            begun = time.perf_counter()
            pose.press("Enter")
            page.get_by_role("row", name=f"view {VIEWS - 1}", exact=True).wait_for()
            pasted = time.perf_counter() - begun
            last = page.get_by_role("row", name=f"view {VIEWS}", exact=True)
            dialog = page.get_by_role("dialog")
            for number in range(ROUNDS):
                pose.fill("")
                timed(
                    "a pose is read while it is typed",
                    lambda: pose.fill(lines[-1]),
                    page.get_by_text("Read as KUKA").wait_for,
                )
                timed("a pose is taken", lambda: pose.press("Enter"), last.wait_for)
                at = 2 + number % 5
                row = page.get_by_role("row", name=f"view {at}", exact=True)
                timed("a row's choices are shown", row.get_by_role("button").click, dialog.wait_for)
                # A dialog opens and closes in a third of a second.
                page.wait_for_timeout(400)
                new = lines[at - 1] + f"{number}1"
                dialog.get_by_label("Its pose").fill(new)
                timed(
                    "a pose is replaced",
                    dialog.get_by_role("button", name="Replace the pose").click,
                    row.get_by_text(new).wait_for,
                )
                dialog.wait_for(state="hidden")
                undo = page.get_by_role("button", name="Undo last")
                timed("undo", undo.click, lambda: last.wait_for(state="detached"))
                page.wait_for_timeout(1000 * (number % 3))
    text = (
        f"{VIEWS - 1} views were pasted in {pasted:.2f} s; then {ROUNDS} rounds, each from the "
        "click until the browser shows the answer, Playwright's own time included.\n\n"
        "| what | trial | times | median [s] | longest [s] |\n| --- | --- | ---: | ---: | ---: |\n"
    )
    for (what, tried), taken in sorted(seconds.items()):
        text += (
            f"| {what} | {'runs' if tried else 'none'} | {len(taken)} | "
            f"{np.median(taken):.2f} | {max(taken):.2f} |\n"
        )
    print(text)
    write_section(
        "Answers of the page", "PYTHONPATH=tests python tests/benchmarks/page_answers.py", text
    )


if __name__ == "__main__":
    main()
