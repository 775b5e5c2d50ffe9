"""Runs jobs on an executor of `concurrent.futures`: a pool of processes, or a Dask cluster."""

import logging
import multiprocessing
import os
from collections.abc import Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager
from importlib.util import find_spec
from multiprocessing.context import BaseContext
from threading import Thread

from visioncal.core.errors import DataError
from visioncal.interchange.batch.work import Job, failed_row, work
from visioncal.results.fleet import FleetRow

# Timeout of the scheduler [s].
_TIMEOUT_S = 10
# Errors of rows: the process died, and the scheduler went away.
DIED, LOST = "WorkerDied", "SchedulerLost"


def rows_of(
    jobs: Sequence[Job], workers: int | None = None, scheduler: str | None = None
) -> Iterator[FleetRow]:
    """The rows of all jobs, in the order in which they finish.

    If a local process dies, the jobs that were running are run again, each in a pool of its own:
    a session on which it dies again has a row that says so, and all others go on.

    Args:
        jobs: The jobs.
        workers: Number of local processes; None for one a core.
        scheduler: The address of a Dask scheduler whose workers are used; they must see the same
            files by the same paths. If it goes away, the remaining rows say so.

    Raises:
        DataError: A scheduler is named without the extra, or does not answer; or no local process
            can be started.
    """
    waiting, count = [*reversed(jobs)], min(workers or os.cpu_count() or 1, len(jobs))
    while waiting:
        # A cluster has a queue of its own; a pool gets no more than it runs, which tells what ran.
        most, engine = (len(jobs), _cluster(scheduler)) if scheduler else (count, _pool(count))
        running: dict[Future[FleetRow], Job] = {}
        with engine as executor:
            try:
                while waiting or running:
                    while waiting and len(running) < most:
                        running[executor.submit(work, waiting[-1])] = waiting[-1]
                        waiting.pop()
                    for future in wait(running, return_when=FIRST_COMPLETED).done:
                        yield _row(future, running[future], scheduler)
                        del running[future]
            except BrokenExecutor:
                done = [future for future in running if future.exception() is None]
                yield from (future.result() for future in done)
                suspects = [job for future, job in running.items() if future not in done]
            else:
                return
        for job in suspects:
            yield _row_alone(job)


def _row(future: Future[FleetRow], job: Job, scheduler: str | None) -> FleetRow:
    """The row of a finished job; raises BrokenExecutor where the pool's processes ended."""
    try:
        return future.result()
    except BrokenExecutor:
        raise
    except CancelledError:
        return failed_row(
            job,
            LOST,
            f"the scheduler at {scheduler} went away before the session was calibrated.",
            "Start it and the same command again: what is finished is kept.",
        )
    except Exception as error:  # noqa: BLE001 - `work` raises nothing: Dask tells of a death
        return failed_row(job, DIED, f"its worker died: {error}.", _MEMORY)


_MEMORY = "It may need more memory: calibrate it by itself."


def _row_alone(job: Job) -> FleetRow:
    with _pool(1) as executor:
        try:
            executor.submit(os.getpid).result()
        except BrokenExecutor as error:
            raise DataError(
                "worker processes end as soon as they start.",
                next_step='A script that calls batch does so below if __name__ == "__main__":, '
                "since each worker imports it.",
            ) from error
        try:
            return executor.submit(work, job).result()
        except BrokenExecutor:
            words = "its worker died twice, once with no other session beside it."
            return failed_row(job, DIED, words, _MEMORY)


@contextmanager
def _pool(count: int) -> Iterator[Executor]:
    context: BaseContext
    if "forkserver" in multiprocessing.get_all_start_methods():
        # Forks of a server that has imported the calibration: no worker waits for imports, and none
        # inherits the caller's threads and locks.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(
            [work.__module__, "visioncal.calibration.pipeline", "visioncal.present.report"]
        )
    else:
        context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(count, context, initializer=_end_with_parent)
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """Ends this process if the batch is killed: the pool's queue would keep it waiting forever."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    Thread(target=watch, daemon=True).start()


@contextmanager
def _cluster(scheduler: str | None) -> Iterator[Executor]:
    if find_spec("distributed") is None:
        raise DataError(
            "a scheduler needs Dask, which is not installed.",
            culprits=["--scheduler"],
            next_step="pip install 'visioncal[cluster]'",
        )
    from distributed import Client

    # It prints tracebacks where a scheduler goes away, which rows say.
    log = logging.getLogger("distributed.client")
    log_level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        client = Client(scheduler, timeout=_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise DataError(
            f"no scheduler answers at {scheduler}: {error}", culprits=["--scheduler"]
        ) from error
    try:
        yield client.get_executor(pure=False)
    finally:
        client.close()
        log.setLevel(log_level)
