"""Random boards in photographs: how many are named, and how many sound ones are accused.

    PYTHONPATH=tests python tests/benchmarks/boards.py [--quick] [SEED ...]

Prints a row for each kind, and the processor time of three photographs of 1.3 megapixels. Boards
are drawn by OpenCV and NumPy alone (tests/support/photographed.py).
"""

import time
from collections import Counter

import cv2
import numpy as np
from results import WORDS, few, write_section
from support.photographed import HARD, KINDS, described, is_named, photographs, print_of

from visioncal.calibration.stages.detect import detect
from visioncal.calibration.stages.other_board import OtherBoardError
from visioncal.core.errors import DataError
from visioncal.session import Session
from visioncal.vision.boards.identify import identify
from visioncal.vision.targets import target_from_document

MARKED = ("charuco", "aprilgrid", "gridboard", "marker")


def named(seed: int, count: int) -> tuple[Counter[str], list[float]]:
    """Random boards of each kind that are named, half of those with markers mirrored, and times."""
    right, times = Counter[str](), list[float]()
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
        right[kind] += is_right
        if not is_right:
            print(f"not named: {board.said}, mirrored: {mirrored}")
    return right, times


def accused(seed: int, count: int) -> Counter[str]:
    """Sound boards that are said to be others, by what makes them hard to find."""
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
            except DataError as error:
                if isinstance(error, OtherBoardError) or "another board" in error.message:
                    wrong[hard] += 1
                    print(f"accused, {hard}: {board.said}: {error.message}")
    return wrong


def main() -> None:
    """Prints and keeps how many are named, and accused."""
    seeds, boards, sessions = [*map(int, WORDS)] or [1], few(60, 6), few(12, 1) * len(HARD)
    cv2.setNumThreads(1)
    rows = list[str]()
    for seed in seeds:
        right, times = named(seed, boards)
        wrong = accused(seed, sessions // len(HARD))
        of_kinds = " | ".join(str(right[kind]) for kind in KINDS)
        rows.append(
            f"| {seed} | {of_kinds} | {right.total()} of {boards} | {np.median(times):.1f} s, "
            f"{max(times):.1f} s | {wrong.total()} of {sessions} |"
        )
    text = (
        "Random boards with 4 to 12 columns and 4 to 8 rows, a quarter of those with markers from "
        "another first id than 0, each in three photographs of 1280 x 1024 px with perspective, "
        "any turn, blur and noise; of those with markers half are mirrored. A board is named where "
        "kind, counts, dictionary, first id, layout, gap, border and mirroring are all right. "
        f"Sound boards are declared as they are, and hard to find: {', '.join(HARD)}.\n\n"
        f"| seed | {' | '.join(KINDS)} | named | processor time: median, most | accused |\n"
        f"|{' --- |' * (len(KINDS) + 4)}\n" + "\n".join(rows)
    )
    print(text)
    command = f"PYTHONPATH=tests python tests/benchmarks/boards.py {' '.join(map(str, seeds))}"
    write_section("Boards that name themselves", command, text)


if __name__ == "__main__":
    main()
