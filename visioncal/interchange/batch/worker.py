"""The program of a worker of this machine: takes jobs and gives rows, by its standard streams."""

import pickle
import sys
from typing import BinaryIO

from visioncal.interchange.batch.work import work


def serve(jobs: BinaryIO, rows: BinaryIO) -> None:
    """Works on one job after the other, until there are no more."""
    while True:
        try:
            job = pickle.load(jobs)
        except EOFError:
            return
        pickle.dump(work(job), rows)
        rows.flush()


if __name__ == "__main__":
    answers = sys.stdout.buffer
    # What a library prints is no answer.
    sys.stdout = sys.stderr
    serve(sys.stdin.buffer, answers)
