"""Random boards in photographs: how many are named, and how many sound ones are accused.

    python tests/benchmarks/boards.py --seed 1 --boards 60

Prints a row for each kind, and the processor time of three photographs of 1.3 megapixels. Boards
are drawn by OpenCV and NumPy alone (tests/support/photographed.py).
"""

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.photographed import HARD, KINDS, described, is_named, photographs, print_of

from visioncal.calibration.stages.detect import detect
from visioncal.calibration.stages.other_board import OtherBoardError
from visioncal.core.errors import DataError
from visioncal.session import Session
from visioncal.vision.boards.identify import identify
from visioncal.vision.targets import target_from_document

MARKED = ("charuco", "aprilgrid", "gridboard", "marker")


def named(seed: int, count: int) -> None:
    """Names random boards, half of those with markers mirrored."""
    right, all_, times = Counter[str](), Counter[str](), list[float]()
    for at in range(count):
        rng = np.random.default_rng([seed, at])
        kind = KINDS[at % len(KINDS)]
        board = print_of(kind, rng)
        images = photographs(board, rng)
        mirrored = kind in MARKED and bool(rng.integers(2))
        images = [np.ascontiguousarray(it[:, ::-1]) for it in images] if mirrored else images
        began = time.process_time()
        try:
            identity = identify(images)
            is_right = is_named(board, identity) and identity.is_mirrored == mirrored
        except DataError:
            is_right = False
        times.append(time.process_time() - began)
        all_[kind] += 1
        right[kind] += is_right
        if not is_right:
            print(f"not named: {board.said}, mirrored: {mirrored}")
    for kind in KINDS:
        print(f"{kind:14} {right[kind]} of {all_[kind]}")
    print(f"named {right.total()} of {count}; {np.median(times):.1f} s, at most {max(times):.1f} s")


def accused(seed: int, count: int) -> None:
    """Counts sound boards that are said to be others, where they are hard to find."""
    wrong = Counter[str]()
    for at in range(count):
        for index, (hard, options) in enumerate(HARD.items()):
            rng = np.random.default_rng([seed, at, index])
            board = print_of(KINDS[(at + index) % len(KINDS)], rng)
            target = target_from_document(described(board), "board")
            images = photographs(board, rng, **options)
            session = Session.from_arrays(images, np.tile(np.eye(4), (3, 1, 1)), target)
            try:
                detect(session, threads=1)
            except OtherBoardError as error:
                wrong[hard] += 1
                print(f"accused, {hard}: {board.said}: {error.message}")
            except DataError:
                continue
    print(f"accused {wrong.total()} of {count * len(HARD)} {dict(wrong) or ''}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--boards", type=int, default=60)
    parser.add_argument("--sound", type=int, default=12)
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    named(asked.seed, asked.boards)
    accused(asked.seed, asked.sound)
