"""Many sessions at once: what a worker gives, what its death costs, and what is kept."""

import csv
import html
import os
import re
import signal
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace

import pytest
from pyarrow import parquet
from support.commands import visioncal

from visioncal.calibration.run import run
from visioncal.core.errors import DataError
from visioncal.interchange.batch import Options, batch, jobs_of
from visioncal.interchange.batch import run as batch_run
from visioncal.interchange.batch.run import work
from visioncal.interchange.outputs import RECORDING, REPORT
from visioncal.results import Calibration, to_document
from visioncal.results.compare import compare
from visioncal.simulation import CellOptions, simulate, write_session

BARE = (REPORT, RECORDING)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Four sound sessions of two robots, one folder without a session, one with a broken table."""
    folder = tmp_path_factory.mktemp("fleet")
    for seed in range(4):
        cell = simulate(CellOptions(views=10, seed=seed))
        write_session(cell, folder / f"robot_{seed % 2}" / f"week_{seed // 2}", images=False)
    (folder / "empty").mkdir()
    broken = write_session(simulate(CellOptions(views=10)), folder / "broken", images=False)
    table = broken / "views.csv"
    table.write_text(table.read_text().replace("0.", "zero.", 1))
    return folder


@pytest.fixture
def in_this_process(monkeypatch):
    """Works in this process: what its workers are does not matter."""
    monkeypatch.setattr(batch_run, "rows_of", lambda jobs, *_: map(work, jobs))


def facts(found):
    return to_document(replace(found, created=""))


def expect_results_of_calibrate(fleet, out, rows):
    done = {row.name: row for row in rows if row.state == "done"}
    assert sorted(done) == [f"robot_{name}/week_{at}" for name in (0, 1) for at in (0, 1)]
    for name, row in done.items():
        expected = run(fleet / name).calibration
        verdict = expected.verdict.with_paths(fleet / name, out.absolute() / name)
        found = Calibration.load(out / name)
        assert facts(found) == facts(replace(expected, verdict=verdict))
        assert (row.entry.figures["residual_mm"], row.entry.figures["used"]) == (found.rms.mm, 10)
    failed = {row.name: row for row in rows if row.state == "failed"}
    assert sorted(failed) == ["broken", "empty"]
    assert "session.toml does not exist" in failed["empty"].words
    assert "zero." in failed["broken"].words
    assert {value.error for value in failed.values()} == {"DataError"}


@pytest.mark.slow
def test_results_are_those_of_calibrate_and_errors_are_rows(fleet, tmp_path):
    steps = []
    found = batch(
        fleet / "*", tmp_path, workers=2, without=BARE, progress=lambda *step: steps.append(step)
    )
    assert steps == [("batch", done, 6) for done in range(7)]
    expect_results_of_calibrate(fleet, tmp_path, found.rows)
    table = parquet.read_table(found.table).to_pylist()
    assert [value["name"] for value in table] == [row.name for row in found.rows]
    assert {value["residual_mm"] for value in table} == {
        row.entry and row.entry.figures["residual_mm"] for row in found.rows
    }
    page = found.page.read_text()
    assert all(page.count(f'<th scope="row">{end}') == 1 for end in ("broken<", "empty<"))
    assert all(row.words in html.unescape(page) for row in found.rows)


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_finished_sessions_are_kept_by_another_batch(fleet, tmp_path):
    found = batch(fleet / "robot_*/week_1", tmp_path, without=BARE)

    def of(name):
        return (tmp_path / name / "calibration.json").stat().st_mtime_ns

    before = {row.name: of(row.name) for row in found.rows}
    (tmp_path / "robot_1/week_1/calibration.json").unlink()
    again = batch(fleet / "robot_*/week_1", tmp_path, without=BARE)
    states = {row.name: row.state for row in again.rows}
    assert states.pop("robot_1/week_1") == "done"
    assert set(states.values()) == {"kept"}
    assert all(of(name) == before[name] for name in states)
    # Other facts are another session, and other options are other results.
    table = fleet / "robot_0/week_1/views.csv"
    whole = table.read_text()
    table.write_text("\n".join(whole.splitlines()[:-1]) + "\n")
    (row,) = batch(fleet / "robot_0/week_1", tmp_path / "robot_0", without=BARE).rows
    table.write_text(whole)
    assert (row.state, row.entry.figures["views"]) == ("done", 9)
    (row_with_need,) = batch(
        fleet / "robot_1/week_1", tmp_path / "robot_1", without=BARE, need_mm=1.0
    ).rows
    assert row_with_need.state == "done"


def fatal(job):
    """Works, but dies on one session, and on another one the first time."""
    once = job.folder.parent / "died"
    if job.name == "robot_1/week_0" or (job.name == "robot_0/week_0" and not once.exists()):
        once.parent.mkdir(parents=True, exist_ok=True)
        once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return work(job)


@pytest.mark.slow
def test_a_worker_that_dies_loses_nothing(fleet, tmp_path, monkeypatch):
    monkeypatch.setattr(batch_run, "work", fatal)
    rows = batch([fleet / "robot_0", fleet / "robot_1"], tmp_path, workers=2, without=BARE).rows
    states = {row.name: row.state for row in rows}
    assert states == {
        "robot_0/week_0": "done",
        "robot_0/week_1": "done",
        "robot_1/week_0": "failed",
        "robot_1/week_1": "done",
    }
    (lost,) = (row for row in rows if row.state == "failed")
    assert lost.error == "WorkerDied"
    assert "died twice" in lost.words


def test_sessions_are_found_and_named(fleet, tmp_path):
    jobs = jobs_of([fleet / "robot_0", str(fleet / "robot_1" / "*_1")], tmp_path, Options())
    assert [job.name for job in jobs] == ["robot_0/week_0", "robot_0/week_1", "robot_1/week_1"]
    assert jobs[2].folder == tmp_path / "robot_1" / "week_1"
    (only,) = jobs_of([fleet / "robot_0" / "week_0"], tmp_path, Options())
    assert only.name == "week_0"
    (missing,) = jobs_of([tmp_path / "missing"], tmp_path, Options())
    assert missing.name == "missing"
    for others in ([], [fleet / "robot_0"]):
        with pytest.raises(DataError, match=r"none_\*: there is no session"):
            jobs_of([*others, str(tmp_path / "*" / "none_*")], tmp_path, Options())
    (tmp_path / "both").mkdir()
    (tmp_path / "both.rrd").touch()
    with pytest.raises(DataError, match="two sessions are called both"):
        jobs_of([str(tmp_path / "both*")], tmp_path, Options())


@pytest.mark.usefixtures("in_this_process")
def test_the_command_says_what_became_of_the_sessions(fleet, tmp_path):
    new = tmp_path / "new"
    done = visioncal("batch", fleet / "robot_0", "-o", new, "--workers", 1).good()
    assert "2 sessions: 2 good" in done.out
    assert (new / "week_1" / "report.html").exists()
    nothing = visioncal("batch", fleet / "empty", "-o", tmp_path / "nothing").refused()
    assert "session.toml does not exist" in nothing.out

    # The same session agrees with its result to rounding; the cell of another seed is elsewhere.
    words = ("batch", fleet / "robot_0", "-o", new, "--against", new / "week_0")
    printed = visioncal(*words).good().out
    first, second = (re.search(rf"{name} +good +(.*)", printed)[1] for name in ("week_0", "week_1"))
    assert first.strip() == "nothing beyond noise"
    assert second.startswith("flange_from_cam by ")
    rows = [*csv.DictReader((new / "against.csv").read_text().splitlines())]
    apart = compare(*(Calibration.load(new / name) for name in ("week_0", "week_1")))
    found = [row for row in rows if row["session"] == "week_1"]
    assert [row["transform"] for row in found] == [edge.name for edge in apart.edges]
    for row, edge in zip(found, apart.edges, strict=True):
        assert float(row["moved_mm"]) == pytest.approx(edge.moved_mm, rel=1e-5)
        assert row["changed"] == ("yes" if edge.is_change else "no")
    refused = visioncal("batch", fleet / "robot_0", "-o", new, "--against", tmp_path / "none")
    refused.refused("does not exist")


@contextmanager
def cluster(workers):
    """A Dask cluster of programs of their own, with the process ids of scheduler and workers."""
    distributed = pytest.importorskip("distributed")
    from distributed.deploy.subprocess import SubprocessCluster

    with SubprocessCluster(
        n_workers=workers,
        threads_per_worker=1,
        dashboard_address=None,
        worker_kwargs={"memory_limit": 0, "dashboard": False},
    ) as made:
        assert made.scheduler_address.startswith("tcp://127.0.0.1:")
        with distributed.Client(made, set_as_default=False) as client:
            client.wait_for_workers(workers)
            pids = [*client.run(os.getpid).values()]
            yield made.scheduler_address, client.run_on_scheduler(os.getpid), pids


@pytest.mark.slow
def test_a_scheduler_and_its_workers_do_the_same(fleet, tmp_path):
    """Of two workers one is killed when the first row is there."""
    with cluster(2) as (address, _, pids):

        def killing(_, done, __):
            if done == 1:
                os.kill(pids[0], signal.SIGKILL)

        found = batch(fleet / "*", tmp_path, scheduler=address, without=BARE, progress=killing)
    expect_results_of_calibrate(fleet, tmp_path, found.rows)
    with pytest.raises(DataError, match=r"no scheduler answers at tcp://127.0.0.1:1"):
        batch(fleet / "*", tmp_path / "other", scheduler="tcp://127.0.0.1:1")


def test_a_lost_scheduler_leaves_what_is_finished(fleet, tmp_path, monkeypatch):
    """Dask cancels what it cannot ask for any more."""

    class Lost(ThreadPoolExecutor):
        def submit(self, function, job):
            future = super().submit(function, job)
            if not job.name.endswith("week_0"):
                future = Future()
                future.cancel()
                future.set_running_or_notify_cancel()
            return future

    monkeypatch.setattr(batch_run, "_cluster", lambda _: Lost(1))
    done = visioncal(
        "batch", fleet / "robot_0", "-o", tmp_path, "--scheduler", "tcp://x:1"
    ).refused("1 of 2 sessions")
    assert "1 good, 1 failed" in done.out
    assert "went away" in (tmp_path / "index.html").read_text()
    states = {
        row["name"]: row["state"]
        for row in parquet.read_table(tmp_path / "batch.parquet").to_pylist()
    }
    assert states == {"week_0": "done", "week_1": "failed"}
