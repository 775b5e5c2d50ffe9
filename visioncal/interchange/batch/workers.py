"""Gives jobs to workers of one thread each: of Dask's cluster, or processes of this machine."""

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib.util import find_spec
from queue import Empty, SimpleQueue
from threading import Event, Thread

from visioncal.core.errors import DataError
from visioncal.interchange.batch.work import Job, died, work
from visioncal.results.fleet import FleetRow

# A session that so many workers have died of is not tried again.
_TRIES = 3
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
# So long a scheduler may take to answer [s].
_PATIENCE_S = 10


def rows_of(
    jobs: Sequence[Job], workers: int | None = None, scheduler: str | None = None
) -> Iterator[FleetRow]:
    """The rows of all jobs, as they are done.

    Args:
        jobs: What to do.
        workers: How many at a time; one a core where None.
        scheduler: The address of a Dask scheduler, whose workers then do it; they must see the same
            files by the same paths. None for this machine: a cluster of Dask's where the extra
            `cluster` is installed, or else plain processes.

    Raises:
        DataError: A scheduler is named without the extra, or does not answer.
    """
    count = min(workers or os.cpu_count() or 1, max(len(jobs), 1))
    has_dask = find_spec("distributed") is not None
    if scheduler is not None and not has_dask:
        raise DataError(
            "a scheduler needs Dask, which is not installed.",
            culprits=["--scheduler"],
            next_step="pip install 'visioncal[cluster]'",
        )
    if has_dask and (scheduler is not None or os.name == "posix"):
        return _by_dask(jobs, count, scheduler)
    return _by_processes(jobs, count)


def _by_dask(jobs: Sequence[Job], count: int, scheduler: str | None) -> Iterator[FleetRow]:
    import dask
    from distributed import Client, as_completed
    from distributed.deploy.subprocess import SubprocessCluster

    settings = {
        "distributed.scheduler.allowed-failures": _TRIES - 1,
        "distributed.nanny.pre-spawn-environ": _ONE_THREAD,
    }
    with dask.config.set(settings):
        cluster = None
        if scheduler is None:
            # Processes of their own programs: others would import the caller's main module.
            cluster = SubprocessCluster(
                n_workers=count,
                threads_per_worker=1,
                dashboard_address=None,
                worker_kwargs={"memory_limit": 0, "dashboard": False},
            )
        try:
            client = Client(cluster or scheduler, timeout=_PATIENCE_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise DataError(
                f"no scheduler answers at {scheduler}: {error}", culprits=["--scheduler"]
            ) from error
        try:
            futures = dict(zip(client.map(work, jobs, pure=False), jobs, strict=True))
            for future in as_completed(futures, loop=client.loop):
                # Only the worker's death is an error: all others are rows.
                is_row = future.exception() is None
                yield future.result() if is_row else died(futures[future], _TRIES)
                future.release()
        finally:
            client.close()
            if cluster is not None:
                cluster.close()


def _by_processes(jobs: Sequence[Job], count: int) -> Iterator[FleetRow]:
    """The rows of all jobs, by processes of this machine; one that dies is replaced."""
    waiting: SimpleQueue[Job] = SimpleQueue()
    rows: SimpleQueue[FleetRow | BaseException] = SimpleQueue()
    stopped = Event()
    for job in jobs:
        waiting.put(job)
    threads = [Thread(target=_feed, args=(waiting, rows, stopped)) for _ in range(count)]
    for thread in threads:
        thread.start()
    try:
        for _ in jobs:
            row = rows.get()
            if isinstance(row, BaseException):
                raise row
            yield row
    finally:
        stopped.set()
        for thread in threads:
            thread.join()


def _feed(
    waiting: "SimpleQueue[Job]", rows: "SimpleQueue[FleetRow | BaseException]", stopped: Event
) -> None:
    """Keeps one worker busy until nothing waits any more."""
    worker = None
    try:
        while not stopped.is_set():
            try:
                job = waiting.get_nowait()
            except Empty:
                return
            row = None
            for _ in range(_TRIES):
                worker = worker or _started()
                row = _asked(worker, job)
                if row is not None:
                    break
                _ended(worker)
                worker = None
            rows.put(row or died(job, _TRIES))
    except BaseException as error:  # noqa: BLE001 - whoever waits for rows raises it
        rows.put(error)
    finally:
        if worker is not None:
            _ended(worker)


def _started() -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "visioncal.interchange.batch.worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, **_ONE_THREAD},
    )


def _asked(worker: subprocess.Popen[bytes], job: Job) -> FleetRow | None:
    """The row of a job; None where the worker died of it."""
    if worker.stdin is None or worker.stdout is None:
        raise RuntimeError("a worker is spoken to by pipes")
    try:
        pickle.dump(job, worker.stdin)
        worker.stdin.flush()
        row = pickle.load(worker.stdout)
    except (EOFError, OSError, pickle.UnpicklingError):
        return None
    return row if isinstance(row, FleetRow) else None


def _ended(worker: subprocess.Popen[bytes]) -> None:
    worker.kill()
    # What it was not asked any more is flushed into a pipe that nobody reads.
    with suppress(BrokenPipeError), worker:
        pass
