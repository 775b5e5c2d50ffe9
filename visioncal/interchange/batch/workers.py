"""Distributes jobs over workers of one thread each: of a Dask cluster, or local processes."""

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

# Number of worker deaths after which a session is given up.
_TRIES = 3
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
# Timeout of the scheduler [s].
_TIMEOUT_S = 10


def rows_of(
    jobs: Sequence[Job], workers: int | None = None, scheduler: str | None = None
) -> Iterator[FleetRow]:
    """The rows of all jobs, in the order in which they finish.

    Args:
        jobs: The jobs.
        workers: Number of parallel workers; None for one a core.
        scheduler: The address of a Dask scheduler whose workers are used; they must see the same
            files by the same paths. None for this machine: a local Dask cluster where the extra
            `cluster` is installed, else plain processes.

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
            # Separate programs: forked or spawned workers would import the caller's main module.
            cluster = SubprocessCluster(
                n_workers=count,
                threads_per_worker=1,
                dashboard_address=None,
                worker_kwargs={"memory_limit": 0, "dashboard": False},
            )
        try:
            client = Client(cluster or scheduler, timeout=_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise DataError(
                f"no scheduler answers at {scheduler}: {error}", culprits=["--scheduler"]
            ) from error
        try:
            futures = dict(zip(client.map(work, jobs, pure=False), jobs, strict=True))
            for future in as_completed(futures, loop=client.loop):
                # Only a worker's death is an error: all others are rows.
                is_row = future.exception() is None
                yield future.result() if is_row else died(futures[future], _TRIES)
                future.release()
        finally:
            client.close()
            if cluster is not None:
                cluster.close()


def _by_processes(jobs: Sequence[Job], count: int) -> Iterator[FleetRow]:
    """The rows of all jobs by local processes; one that dies is replaced."""
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
    """Keeps one worker busy until no jobs are left."""
    worker = None
    try:
        while not stopped.is_set():
            try:
                job = waiting.get_nowait()
            except Empty:
                return
            row = None
            for _ in range(_TRIES):
                worker = worker or _start_worker()
                row = _run_job(worker, job)
                if row is not None:
                    break
                _end_worker(worker)
                worker = None
            rows.put(row or died(job, _TRIES))
    except BaseException as error:  # noqa: BLE001 - whoever waits for rows raises it
        rows.put(error)
    finally:
        if worker is not None:
            _end_worker(worker)


def _start_worker() -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "visioncal.interchange.batch.worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, **_ONE_THREAD},
    )


def _run_job(worker: subprocess.Popen[bytes], job: Job) -> FleetRow | None:
    """The row of a job; None where the worker died."""
    if worker.stdin is None or worker.stdout is None:
        raise RuntimeError("a worker is spoken to by pipes")
    try:
        pickle.dump(job, worker.stdin)
        worker.stdin.flush()
        row = pickle.load(worker.stdout)
    except (EOFError, OSError, pickle.UnpicklingError):
        return None
    return row if isinstance(row, FleetRow) else None


def _end_worker(worker: subprocess.Popen[bytes]) -> None:
    worker.kill()
    # Buffered requests are flushed into a pipe that nobody reads.
    with suppress(BrokenPipeError), worker:
        pass
