"""Random boards in photographs: how many are named, and how many sound ones are accused.

    PYTHONPATH=tests python tests/benchmarks/boards.py [SEED] [--quick]

Prints a row for each kind, and the processor time of three photographs of 1.3 megapixels. Boards
are drawn by OpenCV and NumPy alone (tests/support/photographed.py).
"""

import time
from collections import Counter

import cv2
import numpy as np
from results import few, wished, write_section
from support.photographed import HARD, KINDS, described, is_named, photographs, print_of

from visioncal.calibration.stages.detect import detect
from visioncal.calibration.stages.other_board import OtherBoardError
from visioncal.core.errors import DataError
from visioncal.session import Session
from visioncal.vision.boards.identify import identify
from visioncal.vision.targets import target_from_document

MARKED = ("charuco", "aprilgrid", "gridboard", "marker")


def named(seed: int, count: int) -> str:
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
    rows = "".join(f"| {kind} | {right[kind]} of {all_[kind]} |\n" for kind in KINDS)
    return (
        f"Named {right.total()} of {count}. Processor time for three photographs: "
        f"{np.median(times):.1f} s in the median, {max(times):.1f} s at most.\n\n"
        f"| kind | named |\n| --- | --- |\n{rows}"
    )


def accused(seed: int, count: int) -> str:
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
    of = ", ".join(f"{name} {number}" for name, number in wrong.items())
    return (
        f"Of {count * len(HARD)} sound sessions of three photographs ({', '.join(HARD)}) "
        f"{wrong.total()} are said to show another board{f': {of}' if of else ''}."
    )


def main() -> None:
    """Prints and keeps how many are named, and accused."""
    seed = wished(1)
    cv2.setNumThreads(1)
    text = (
        "Random boards with 4 to 12 columns and 4 to 8 rows, a quarter of those with markers from "
        "another first id than 0, each in three photographs of 1280 x 1024 px with perspective, "
        "any turn, blur and noise; of those with markers half are mirrored. A board is named where "
        "kind, counts, dictionary, first id, layout, gap, border and mirroring are all right.\n\n"
        f"{named(seed, few(60, 6))}\n{accused(seed, few(12, 1))}\n"
    )
    print(text)
    command = f"PYTHONPATH=tests python tests/benchmarks/boards.py {seed}"
    write_section("Boards that name themselves", command, text)


if __name__ == "__main__":
    main()
