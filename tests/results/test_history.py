"""A site's history: what is there once, what cannot be written, and its years' steps and drifts."""

import json
import multiprocessing
import os
import resource
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal
from support.commands import visioncal
from support.marks import seeds
from support.site import CREEP_M, NOW, SIGMA_M, acts

from visioncal.cli.console import EXIT_BAD
from visioncal.core.choices import SITE_FILE
from visioncal.core.errors import DataError
from visioncal.core.transforms import exp
from visioncal.results import history as module
from visioncal.results import years
from visioncal.results.edge import Edge
from visioncal.results.history import Entry, History
from visioncal.results.years import courses, find_changes
from visioncal.simulation import CellOptions, simulate, write_session

FORK = multiprocessing.get_context("fork")


def entry(number=0, **changed):
    edge = Edge(np.eye(4), 1e-8 * np.eye(6))
    at = f"2026-01-01T00:00:{number % 60:02}+00:00"
    facts = {"cell": "cell 1", "at": at, "kind": "calibrated", "status": "good"}
    facts |= {"reason": f"no. {number}", "edges": {"flange_from_cam": edge}}
    return Entry(**facts | changed)


def writer(path, first, count, acknowledged):
    """Appends entries, each twice as after a lost answer, and notes what was acknowledged."""
    with acknowledged.open("a") as notes:
        for number in range(first, first + count):
            one = entry(number, session=f"session {number}")
            History(path).append(one)
            notes.write(f"{one.id}\n")
            notes.flush()
            if number % 7 == 0:
                History(path).append(one)


@pytest.mark.parametrize("count", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_acknowledged_entries_are_stored_once(tmp_path, count):
    """Of eight processes three are killed on the way, and start again from their first entry."""
    path, notes = tmp_path / SITE_FILE, [tmp_path / f"notes {at}" for at in range(8)]

    def started(at, most):
        numbers = (100_000 * at, most)
        process = FORK.Process(target=writer, args=(path, *numbers, notes[at]), daemon=True)
        process.start()
        return process

    victims = {at: started(at, 100_000) for at in (0, 3, 6)}
    running = [started(at, count) for at in range(8) if at not in victims]
    for at, process in victims.items():
        # An identity and the line's end are 17 characters.
        while not notes[at].exists() or notes[at].stat().st_size < 17 * (count // 4):
            assert process.is_alive(), "A writer failed; its error is printed above."
            time.sleep(0.002)
        process.kill()
        process.join()
        running.append(started(at, count))
    for process in running:
        process.join()
        assert process.exitcode == 0
    kept = [one.id for one in History(path).entries()]
    acknowledged = {line for file in notes for line in file.read_text().split()}
    assert len(acknowledged) >= 8 * count
    assert len(kept) == len({*kept})
    assert acknowledged <= {*kept}
    # What a killed process had written, and could not note any more.
    assert len(kept) <= len(acknowledged) + 3


def test_entries_are_only_appended(tmp_path):
    history = History(tmp_path / "history?.db")
    assert history.append(entry(1), entry(2, kind="verified", cell="cell 2", edges={})) == 2
    assert history.append(entry(1), entry(3)) == 1
    # The same words at the same time, of two other inputs.
    entries = [entry(4, edges={}, sha256=digest) for digest in "ab"]
    assert History(tmp_path / "both.db").append(*entries) == 2
    file = sqlite3.connect(history.path)
    assert file.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    for change in ("UPDATE entry SET cell = 'x'", "DELETE FROM entry"):
        with pytest.raises(sqlite3.IntegrityError, match="only appended"):
            file.execute(change)
    file.execute("REPLACE INTO entry SELECT id, at, 'x', kind, sha256, document FROM entry")
    file.close()
    assert [one.cell for one in history.entries()] == ["cell 1", "cell 2", "cell 1"]
    assert [one.reason for one in history.entries(cell="cell 2")] == ["no. 2"]
    assert [one.reason for one in history.entries(kind="calibrated")] == ["no. 1", "no. 3"]
    (found,) = history.entries(begin=entry(3).id[:10])
    assert found.edges["flange_from_cam"].covariance.tolist() == (1e-8 * np.eye(6)).tolist()


def test_files_of_other_versions_are_upgraded_or_refused(tmp_path, monkeypatch):
    """An older one is brought forward with its entries, a newer one is refused in words."""
    history = History(tmp_path / "history.db")
    history.append(entry(1))
    forms = (*module._FORMS, ("ALTER TABLE entry ADD COLUMN signed TEXT",))
    with monkeypatch.context() as newer:
        newer.setattr(module, "_FORMS", forms)
        assert [one.reason for one in history.entries()] == ["no. 1"]
        assert [one.reason for one in history.entries()] == ["no. 1"]
    with pytest.raises(DataError, match="is of form 2, and this version of visioncal knows 1"):
        history.append(entry(2))
    # What a newer version has noted in an entry stays.
    other = History(tmp_path / "other.db")
    other.append(replace(entry(1), further={"operator": "Ana"}))
    assert other.entries()[0].further == {"operator": "Ana"}


def refused(path, *words, reading=False):
    with pytest.raises(DataError) as caught:
        History(path).entries() if reading else History(path).append(entry())
    assert caught.value.next_step
    for expected in words:
        assert expected in caught.value.message, caught.value.message


def test_unusable_files_are_refused(tmp_path, monkeypatch):
    history = History(tmp_path / "history.db")
    history.append(entry(1))
    monkeypatch.setattr(module, "_PATIENCE_S", 0.1)
    file = sqlite3.connect(history.path, isolation_level=None)
    file.execute("BEGIN IMMEDIATE")
    refused(history.path, "is locked")
    # Readers do not wait for writers.
    assert len(history.entries()) == 1
    file.close()
    text, foreign = tmp_path / "notes.txt", tmp_path / "foreign.db"
    text.write_text("a history of the site, told in words, over a hundred bytes long" * 20)
    with closing(sqlite3.connect(foreign)) as other:
        other.execute("CREATE TABLE music (title TEXT)")
        other.commit()
    refused(text, "must be a history")
    refused(foreign, "of another program")
    refused(tmp_path, "is a folder")
    refused(tmp_path / "no" / "history.db", "its folder does not exist")
    refused(tmp_path / "none.db", "does not exist", reading=True)
    content = bytearray(history.path.read_bytes())
    content[4096:8192] = b"\xff" * 4096
    history.path.write_bytes(content)
    refused(history.path, "is damaged", reading=True)


def limited(path):
    """In a process of its own, whose files may not grow beyond a page of SQLite's."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
    refused(path, "the disk is full")


CHECK = {
    "calibration": {"session": "cell", "sha256": "ab"},
    "session": {"name": "later", "sha256": "cd"},
    "created": "2026-11-20T10:00:00+00:00",
    "status": "good",
    "sentences": ["It is valid."],
    "triggers": [],
    "misfit": 1.0,
    "p_value": 0.5,
}


@pytest.mark.parametrize(
    ("edited", "key"),
    [
        ({"status": "fine"}, "status"),
        ({"sentences": [3]}, "reason"),
        ({"misfit": "x"}, "figures.misfit"),
        ({"session": {"name": "later", "sha256": {}}}, "sha256"),
    ],
)
def test_a_check_of_other_types_spoils_no_history(edited, key, tmp_path):
    """What was entered stays: the history could not be read from then on."""
    path, check = tmp_path / SITE_FILE, tmp_path / "verify.json"
    check.write_text(json.dumps(CHECK))
    visioncal("history", path, "--add", check).good()
    check.write_text(json.dumps(CHECK | edited))
    visioncal("history", path, "--add", check).refused(f"verify.json: {key} is")
    assert [each.reason for each in History(path).entries()] == ["It is valid."]


def test_a_full_disk_takes_nothing_away(tmp_path):
    """The largest file that the system allows is that of the entries that are there."""
    history = History(tmp_path / "history.db")
    for number in range(20):
        history.append(entry(number))
    process = FORK.Process(target=limited, args=(history.path,))
    process.start()
    process.join()
    assert process.exitcode == 0
    assert len(history.entries()) == 20
    assert history.append(entry(20)) == 1


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody with fewer rights")
def test_a_history_in_a_read_only_folder_can_be_read():
    with tempfile.TemporaryDirectory() as folder:
        history = History(Path(folder) / "history.db")
        history.append(entry(1))
        Path(folder).chmod(0o555)
        history.path.chmod(0o444)
        os.seteuid(65534)
        try:
            assert len(history.entries()) == 1
            refused(history.path, "read-only")
        finally:
            os.seteuid(0)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A session below a site's folder."""
    folder = tmp_path_factory.mktemp("site")
    write_session(simulate(CellOptions(views=10)), folder / "line" / "monday", images=False)
    return folder


def test_commands_enter_what_they_did(site, tmp_path):
    """Into the file that is named, then into the one above the session; it costs no result."""
    session, out, file = site / "line" / "monday", tmp_path / "out", site / SITE_FILE
    bare = ("--no-report", "--no-recording", "-o", out)
    done = visioncal("calibrate", session, *bare, "--history", site / "no" / "x.db").good()
    assert (out / "calibration.json").exists()
    assert f"visioncal history {site / 'no' / 'x.db'} --add {out}" in done.err
    visioncal("calibrate", session, *bare, "--history", file, "--cell", "line 4").good()
    check = visioncal("verify", session, "--against", out, "-o", tmp_path / "check")
    (calibrated, verified) = History(file).entries()
    assert (calibrated.kind, calibrated.cell) == ("calibrated", "line 4")
    assert calibrated.source == str(session)
    # A check is of the cell of its calibration, without a word.
    assert (verified.kind, verified.cell) == ("verified", "line 4")
    assert (verified.status == "bad") == (check.status == EXIT_BAD)
    assert verified.against == calibrated.sha256
    # Old results come in by their folders, and those that are there do not come twice.
    again = visioncal("history", file, "--add", out, "--add", tmp_path / "check").good()
    assert "0 added, 2 existed already" in again.err
    added = visioncal("history", tmp_path / "new.db", "--cell", "line 5", "--add", out).good()
    assert "1 added" in added.err
    listed = visioncal("history", file).good().out
    assert visioncal("history", "--history", file).good().out == listed
    assert calibrated.id[:8] in listed
    assert "line 4" in listed
    shown = visioncal("history", file, "--show", verified.id[:6]).good().out
    assert f"against: {calibrated.sha256}" in shown
    visioncal("history", file, "--show", "xyz").refused("0 entries")
    visioncal("history", file, "--cell", "nobody").refused(
        "no cell named 'nobody'; the names are line 4"
    )
    whole = json.loads(visioncal("history", file, "--json").good().out)
    assert [one["id"] for one in whole] == [calibrated.id, verified.id]
    visioncal("history", file, "-o", tmp_path / "table.csv").good()
    assert calibrated.id in (tmp_path / "table.csv").read_text()
    visioncal("history", file, "-o", tmp_path / "table.csv").refused("--force")
    visioncal("history", file, "-o", tmp_path / "table.txt").refused(".csv")


@pytest.mark.slow
def test_a_failing_entry_is_a_warning(site, tmp_path):
    """In another process, as users call it: a text where the site's file would be."""
    (site / "line" / SITE_FILE).write_text("no database" * 100)
    words = ["calibrate", site / "line" / "monday", "-o", tmp_path / "out", "--no-report", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "visioncal", *map(str, words)],
        capture_output=True,
        text=True,
        check=True,
    )
    (site / "line" / SITE_FILE).unlink()
    assert "must be a history" in done.stderr
    assert json.loads(done.stdout)["schema"] == 2


def test_bayes_factors_are_those_of_dense_normal_distributions():
    """The evidence beside a change that was found, with the level's prior as it is, 1e4 units."""
    rng = np.random.default_rng(0)
    count, dimension = 6, 2
    roots = rng.normal(size=(count, dimension, dimension))
    covariances = roots @ roots.transpose(0, 2, 1) + np.eye(dimension)
    days = np.sort(rng.uniform(0.0, 700.0, count))
    shapes = np.array([(days - days[-1]) / 365.25, *np.tri(count)[:, 1:].T])
    values = rng.normal(size=(count, dimension)) + np.outer(shapes[2], [3.0, -2.0])
    gains, _ = years._Model(days, values, covariances).gains({0: 1.0})
    noise = np.zeros((count, dimension, count, dimension))
    noise[np.arange(count), :, np.arange(count)] = covariances + 1e-6 * np.eye(dimension)
    noise = noise.reshape(count * dimension, -1)

    def evidence(*changes):
        """Logarithm summed over the factor of the noise; changes are shapes with their sizes."""
        known = [(np.ones(count), 1e4), (shapes[0], 1.0), *changes]
        spread = sum(np.kron(size**2 * np.outer(x, x), np.eye(dimension)) for x, size in known)
        return np.logaddexp.reduce(
            [
                multivariate_normal.logpdf(values.ravel(), cov=factor * noise + spread) + weight
                for factor, weight in zip(years._INFLATIONS, years._LOG_INFLATIONS, strict=True)
            ]
        )

    for at, gain in enumerate(gains[1:], 1):
        by_size = [evidence((shapes[at], size)) for size in years._SIZES]
        expected = np.logaddexp.reduce(by_size) - np.log(len(by_size)) - evidence()
        # The level's precision of 1e-8 costs half of the digits.
        assert gain == pytest.approx(expected, abs=1e-5)


def world(seed, step_mm=0.0, drift_mm=0.0, looser=1.0):
    """24 entries in two years, with a step before the thirteenth."""
    rng = np.random.default_rng(seed)
    days = np.sort(rng.uniform(0.0, 730.0, 24))
    sigmas = np.array([1.5 * SIGMA_M] * 3 + [SIGMA_M] * 3)
    twists = looser * sigmas * rng.normal(size=(24, 6))
    twists[12:, 3] += 1e-3 * step_mm
    twists[:, 4] += 1e-3 * drift_mm * days / 365.25
    covariances = np.broadcast_to(np.diag(sigmas**2), (24, 6, 6))
    found = find_changes(days, twists, covariances, years._UNITS)
    drifts = [change for change in found if not change.at]
    return [change for change in found if change.at], next(iter(drifts), None)


@pytest.mark.parametrize("draws", seeds(20, 60))
def test_planted_changes_are_found_and_nothing_else(draws):
    quiet = [world(seed) for seed in draws]
    # Covariances that are too small by four look like no change, either.
    quiet += [world(seed, looser=2.0) for seed in draws]
    # One false alarm in a hundred years' courses would be a cell's in a site of fifty, each year.
    assert sum(bool(steps) or drift is not None for steps, drift in quiet) <= len(draws) // 60
    for seed in draws[: len(draws) // 3]:
        steps, drift = world(seed, step_mm=0.4)
        assert [step.at for step in steps] == [12]
        assert drift is None
        sigma = np.sqrt(steps[0].covariance[3, 3])
        # Four sigma, of twenty steps at most.
        assert abs(steps[0].vector[3] - 0.4e-3) < 4.0 * sigma
        steps, drift = world(seed, step_mm=0.5, drift_mm=0.5)
        assert [step.at for step in steps] == [12]
        assert abs(drift.vector[4] - 0.5e-3) < 4.0 * np.sqrt(drift.covariance[4, 4])
    (step,) = find_changes(
        np.array([0.0, 100.0]),
        np.array([np.zeros(6), [0, 0, 0, 1e-3, 0, 0]]),
        np.broadcast_to(SIGMA_M**2 * np.eye(6), (2, 6, 6)),
        years._UNITS,
    )
    # Two entries are enough for a step, and too few for a drift.
    assert step.at == 1
    assert step.vector[3] == pytest.approx(1e-3)


def test_a_course_is_in_the_axes_of_the_table():
    """Those of the parent: the child's are turned by 90 deg about z, and by 0.1 rad later."""
    covariance, turn = np.diag([1.0, 4.0, 9.0, 1.0, 4.0, 9.0]) * 1e-8, np.array([0.0, 0.1, 0.0])
    quarter = exp(np.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0]))
    later = exp(np.append(turn, np.zeros(3))) @ quarter
    later[:3, 3] = [0.3, 0.02, 0.0]
    named = [{"flange_from_cam": Edge(at, covariance)} for at in (quarter, later)]
    (course,) = courses([entry(at, edges=edges) for at, edges in enumerate(named)])
    columns = [one.columns for one in course.entries]
    moved = [
        columns[1][name] - columns[0][name] for name in map("flange_from_cam {}_m".format, "xyz")
    ]
    assert course.offsets[1] == pytest.approx([*turn, *moved])
    assert course.sigmas[0] == pytest.approx([2e-4, 1e-4, 3e-4] * 2)


@pytest.mark.slow
def test_the_time_of_a_miss_is_within_its_interval():
    # The need less 95 % of the latest entry itself, by the chi-square of three dimensions.
    inside, left_m = 0, 0.5e-3 - np.sqrt(chi2.ppf(0.95, 3)) * SIGMA_M
    for seed in range(40):
        jig = next(
            course
            for course in courses([*acts("creeping jig", seed)])
            if course.name == "base_from_jig"
        )
        true = jig.entries[-1].time + timedelta(days=365.25 * left_m / CREEP_M)
        likely, early, late = jig.missed(jig.drift, 0.5)
        assert NOW < early < likely < late
        inside += early <= true <= late
    # Of 40 intervals of 95 % fewer than 34 have the truth once in a thousand times.
    assert inside >= 34
