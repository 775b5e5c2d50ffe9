"""Program of a local worker process: reads jobs from stdin and writes rows to stdout."""

import pickle
import sys
from typing import BinaryIO

from visioncal.interchange.batch.work import work


def serve(jobs: BinaryIO, rows: BinaryIO) -> None:
    """Works on one job after another, until the end of the stream."""
    while True:
        try:
            job = pickle.load(jobs)
        except EOFError:
            return
        pickle.dump(work(job), rows)
        rows.flush()


if __name__ == "__main__":
    row_stream = sys.stdout.buffer
    # Keeps output of libraries out of the rows.
    sys.stdout = sys.stderr
    serve(sys.stdin.buffer, row_stream)
