"""Speed of recording against plainly writing the same bytes, and of reading what was recorded.

Both sides write the same 60 JPEG files of five-megapixel images, in turns in one warm process. The
peer writes each image to a file of its own with fsync; visioncal writes the recording view by view,
and fsyncs it once in the end.

    python tests/benchmarks/recording.py
"""

import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from results import few, write_section

from visioncal.calibration.pipeline import Run, run
from visioncal.present.recording import RecordingWriter, read_session, write_recording
from visioncal.present.viewer import blueprint
from visioncal.session import Session
from visioncal.simulation import CellOptions, fine_camera, simulate, write_session

VIEWS, REPEATS = few((60, 5), (8, 1))
LIMIT_MS = 15.0


def seconds(work: Callable[[], object]) -> float:
    """Times one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def write_plainly(folder: Path, images: list[bytes]) -> None:
    """Writes every image to a file of its own and waits for the disk."""
    folder.mkdir()
    for place, image in enumerate(images):
        with (folder / f"{place}.jpg").open("xb") as file:
            file.write(image)
            file.flush()
            os.fsync(file.fileno())


def record(path: Path, session: Session, rows: list[list[str]], images: list[bytes]) -> None:
    """Records the views as a capture does."""
    with RecordingWriter(path, session, announced=len(rows)) as writer:
        for row, image in zip(rows, images, strict=True):
            writer.add_view(row, image)


def measured(folder: Path, session: Session, found: Run) -> dict[str, float]:
    """Milliseconds a view of each thing that is timed, once."""
    images = [session.images.read(view.image) for view in session.views]
    rows = [[view.cell(column) for column in session.columns] for view in session.views]
    captured, whole = folder / "captured.rrd", folder / "whole.rrd"
    result = found.calibration, found.evidence, blueprint(session)
    work: dict[str, Callable[[], object]] = {
        "plainly, a file each": lambda: write_plainly(folder / "files", images),
        "views recorded, as a capture does": lambda: record(captured, session, rows, images),
        "both in one, as `visioncal calibrate` does": lambda: write_recording(
            whole, session, *result
        ),
        "session read": lambda: read_session(whole),
    }
    return {name: 1e3 * seconds(job) / VIEWS for name, job in work.items()}


def main() -> None:
    """Prints the table and keeps it."""
    options = CellOptions(views=VIEWS, camera=fine_camera(), jpeg_quality=95, cut_views=0.0, seed=1)
    with tempfile.TemporaryDirectory() as name:
        session = Session.load(write_session(simulate(options), Path(name) / "session"))
        size = sum(len(session.images.read(view.image)) for view in session.views)
        result = run(session)
        turns = []
        # The first turn warms up.
        for turn in range(REPEATS + 1):
            (folder := Path(name) / str(turn)).mkdir()
            turns.append(measured(folder, session, result))
            shutil.rmtree(folder)
    lines = ["| what | ms a view, median | worst |", "|---|---:|---:|"]
    for what in turns[0]:
        values = [turn[what] for turn in turns[1:]]
        lines.append(f"| {what} | {statistics.median(values):.2f} | {max(values):.2f} |")
    text = (
        f"{VIEWS} views of 2448 x 2048 as JPEG, {size / VIEWS / 1e6:.2f} MB each, already encoded; "
        f"{REPEATS} interleaved turns. Every recorded view is flushed; the recording is fsynced "
        "once, each plain file separately. Reading checks the SHA-256 of every image. The aim "
        f"is {LIMIT_MS:g} ms per recorded view, without encoding.\n\n"
    )
    table = "\n".join(lines)
    print(text + table)
    write_section("Recordings", "python tests/benchmarks/recording.py", f"{text}{table}\n")


if __name__ == "__main__":
    main()
