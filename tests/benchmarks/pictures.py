"""The pictures that the pages show: report, arm, certificate, viewer and notebook card.

    PYTHONPATH=tests python tests/benchmarks/pictures.py [--quick]

It needs Chromium. A quick run takes the pictures of pages, and leaves recordings/ as it is.
"""

import os
import sys
import tempfile
import time
from contextlib import chdir
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from rerun.experimental import ViewerClient
from results import QUICK
from support.browser import CHROMIUM, picture
from support.commands import visioncal
from support.fuzz.broken_sessions import BROKEN, broken_session

import visioncal as package
from visioncal.present.recording import paths
from visioncal.present.viewer.native import free_port, viewer_process
from visioncal.simulation import CAMERAS, CellOptions, cell_session, simulate, write_session

_FOLDER = Path(__file__).parents[2] / "recordings"
# How long the viewer has for its drawing, without a graphics card [s].
_PATIENCE_S = 60.0
# Height of the viewer's own bar, whose notes are about the machine [px].
_TITLE_PX = 37
# Of a report, its first figure of the arm and what follows.
_ARM = "body :not(.arm, .arm *, :has(.arm)), .arm > :has(~ figure):not(figure) { display: none }"


def main() -> None:
    if CHROMIUM is None:
        words = "Chromium is not installed."
        print(f"left out: {words}")
        sys.exit(None if QUICK else words)
    with tempfile.TemporaryDirectory() as place, chdir(place):
        write_session(simulate(replace(CellOptions(), views=15, seed=3)), "cell-4")
        broken_session(Path("cell-5"), BROKEN["one pose typed wrong"])
        visioncal("calibrate", "cell-4", "-o", "out", "--need-mm", "0.5")
        visioncal("calibrate", "cell-5", "-o", "doubted")
        errors = {"dh_sigma_m": 5e-4, "dh_sigma_rad": 1e-3}
        options = CellOptions(robot="ur5e", **errors, views=40, camera=CAMERAS["fine"])
        cell_session(simulate(options), "cell-6", seen="corners").save(Path("cell-6"))
        visioncal("calibrate", "cell-6", "-o", "calibrated")
        signed = ("--operator", "A. Smith", "--serial", "camera=1944301", "--serial", "robot=UR-77")
        visioncal("show", "out", "--certificate", *signed, "-o", "certificate.html")
        card = package.Calibration.load("out")._repr_html_()
        Path("card.html").write_text(f"<meta charset=utf-8>{card}", "utf-8")
        arm = Path("calibrated/report.html").read_text("utf-8")
        Path("arm.html").write_text(
            arm.replace("</head>", f"<style>{_ARM}</style></head>"), "utf-8"
        )
        for name, file, width, height in (
            ("report", "out/report.html", 1100, 1300),
            ("report_phone", "out/report.html", 390, 1300),
            ("certificate", "certificate.html", 800, 1130),
            ("notebook_card", "card.html", 800, 330),
            ("arm", "arm.html", 900, 880),
        ):
            picture(Path(file), width, height, Path("page.png").absolute())
            _keep(name, cv2.imread("page.png"))
        for name, folder, row in () if QUICK else (("demo", "out", 5), ("viewer", "doubted", 6)):
            _keep(name, _viewed(Path(folder, "recording.rrd"), row))


def _viewed(recording: Path, row: int) -> np.ndarray:
    """Picture (h, w, 3) of the viewer at a row of the recording's views."""
    port, file = free_port(), Path("viewer.png")
    options = ("--headless", "--bind", "127.0.0.1", "--port", str(port))
    with viewer_process(*options, "--window-size", "1400x880", str(recording)) as process:
        for line in process.stdout:
            if "Listening" in line:
                break
        client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
        end, before, picture = time.monotonic() + _PATIENCE_S, np.zeros(0), np.zeros(1)
        # What it draws at once is not yet all of it.
        while time.monotonic() < end and not np.array_equal(before, picture):
            time.sleep(3.0)
            before = picture
            client.set_time(paths.TIMELINE, sequence=row, play_state="paused")
            client.save_screenshot(str(file))
            picture = cv2.imread(str(file))
    return picture[_TITLE_PX:]


def _keep(name: str, image: np.ndarray) -> None:
    """Writes a picture where the pages have it; a quick run, beside what it was taken of."""
    file = (Path(os.curdir) if QUICK else _FOLDER) / f"{name}.png"
    cv2.imwrite(str(file), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    height, width = image.shape[:2]
    print(f"{file.name}: {width} x {height}, {file.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
