"""Several threads calibrate and write at once, and leave the process as it was."""

import concurrent.futures
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Barrier

import cv2
import pytest
from support.kept import assert_same_evidence
from support.refusals import raised
from threadpoolctl import threadpool_info, threadpool_limits

from visioncal.calibration.run import calibrate, run
from visioncal.core.errors import DataError
from visioncal.core.threads import SharedSetting
from visioncal.dynamics import run as dynamics
from visioncal.interchange.outputs import write_outputs
from visioncal.present.recording import read_evidence
from visioncal.results import to_document
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate, write_session

# Reports are compared, figures included.
DRAWS = True
CREATED = "2026-11-21T00:00:00+00:00"


def settings():
    blas = sorted((value["filepath"], value["num_threads"]) for value in threadpool_info())
    return cv2.getNumThreads(), blas


@pytest.mark.slow
def test_threads_write_what_one_alone_writes(tmp_path):
    threads = 2
    write_session(simulate(CellOptions(views=6, seed=2)), tmp_path / "cell")
    session = Session.load(tmp_path / "cell")

    def written(number: int, barrier: Barrier) -> Path:
        barrier.wait()
        found = run(session)
        found = replace(found, calibration=replace(found.calibration, created=CREATED))
        barrier.wait()
        write_outputs(tmp_path / str(number), session, found)
        return tmp_path / str(number)

    single = written(threads, Barrier(1))
    before = settings()
    barrier = Barrier(threads)
    with ThreadPoolExecutor(threads) as pool:
        folders = list(pool.map(lambda number: written(number, barrier), range(threads)))
    assert settings() == before
    evidence = read_evidence(single / "recording.rrd")
    for folder in folders:
        for name in ("calibration.json", "report.html"):
            # The report's commands name the folder.
            texts = [(of / name).read_text("utf-8").replace(str(of), "") for of in (folder, single)]
            assert texts[0] == texts[1]
        assert_same_evidence(read_evidence(folder / "recording.rrd"), evidence)


@pytest.mark.slow
def test_threads_change_no_digit(tmp_path, monkeypatch):
    write_session(simulate(CellOptions(views=6, seed=2)), tmp_path / "cell")
    counts = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, threads):
            counts.append(threads)
            super().__init__(threads)

    monkeypatch.setattr(concurrent.futures, "ThreadPoolExecutor", Pool)
    one, three = (
        replace(calibrate(tmp_path / "cell", threads=name), created=CREATED) for name in (1, 3)
    )
    assert counts == [1, 3]
    assert to_document(one) == to_document(three)
    raised(DataError, "but must be at least 1", calibrate, tmp_path / "cell", threads=0)


def test_a_shared_setting_is_made_by_the_first_and_undone_by_the_last():
    log = []

    @contextmanager
    def setting():
        log.append("made")
        yield
        log.append("undone")

    shared = SharedSetting(setting)
    for _ in range(2):
        log.clear()
        with ExitStack() as first, shared.held():
            first.enter_context(shared.held())
            assert log == ["made"]
        assert log == ["made", "undone"]


def test_dynamics_are_identified_on_one_thread(monkeypatch):
    # On a busy machine two of them took a hundred seconds for what one does in four.
    within = []

    def look(*_):
        within.extend(settings()[1])
        raise DataError("Enough is seen.")

    monkeypatch.setattr(dynamics, "select_arm", look)
    with threadpool_limits(2, user_api="blas"):
        before = settings()
        raised(DataError, "Enough", dynamics.identify_session, None)
        assert settings() == before
    assert within
    assert {count for _, count in within} == {1}
