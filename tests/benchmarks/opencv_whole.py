"""OpenCV's whole calibration of a simulated session, beside which `calibrate.py` times the command.

As a user would write it: it reads and detects in each image, and calibrates the lens and the
hand-eye transform, with OpenCV and NumPy alone.
"""

import csv
import sys
from pathlib import Path

import cv2
import numpy as np


def calibrate(session: Path) -> None:
    """Calibrates a session of the board that is simulated unless another is chosen."""
    cv2.setNumThreads(1)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((9, 6), 0.030, 0.022, dictionary)
    detector, points, places, turns, shifts = cv2.aruco.CharucoDetector(board), [], [], [], []
    with (session / "views.csv").open(encoding="utf-8") as table:
        for row in csv.DictReader(table):
            image = cv2.imread(str(session / row["image"]), cv2.IMREAD_GRAYSCALE)
            corners, ids, *_ = detector.detectBoard(image)
            if ids is None or len(ids) < 6:
                continue
            on_board, in_image = board.matchImagePoints(corners, ids)
            points.append(on_board)
            places.append(in_image)
            x, y, z, w = (float(row[name]) for name in ("qx", "qy", "qz", "qw"))
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            turns.append(np.eye(3) + 2 * w * cross + 2 * cross @ cross)
            shifts.append(np.array([float(row[name]) for name in ("x_m", "y_m", "z_m")]))
    size = image.shape[1], image.shape[0]
    _, _, _, cam_turns, cam_shifts = cv2.calibrateCamera(points, places, size, None, None)
    print(*cv2.calibrateHandEye(turns, shifts, cam_turns, cam_shifts)[1].ravel())


if {*sys.argv[1:]} & {"-h", "--help"}:
    sys.exit(f"{__doc__.strip()}\n\nIts only word is the folder of a session.")
calibrate(Path(sys.argv[1]))
