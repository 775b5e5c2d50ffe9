"""A session's poses read anew: what `convert --guess` writes, and when it writes nothing."""

import csv
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from visioncal.cli.app import app
from visioncal.formats import load_in_doubt
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate, write_session

POSE = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
JOINTS = tuple(f"q{at}_rad" for at in range(1, 7))


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    return write_session(simulate(CellOptions(views=12, seed=4)), tmp_path / "cell", images=False)


def rewritten(folder, change):
    """Changes the rows of views.csv, each a dictionary, in place."""
    file = folder / "views.csv"
    with file.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        rows, names = list(reader), reader.fieldnames
    change(rows)
    with file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, names)
        writer.writeheader()
        writer.writerows(rows)


def shifted(columns):
    def change(rows):
        before = [dict(row) for row in rows]
        for at, row in enumerate(rows):
            row.update({name: before[(at + 1) % len(rows)][name] for name in columns})

    return change


def in_millimetres(rows):
    for row in rows:
        row.update({name: repr(1e3 * float(row[name])) for name in POSE[:3]})


def guessed(source, dest, *more):
    return CliRunner().invoke(app, ["convert", str(source), str(dest), "--guess", *more])


def by_view(session, names):
    return {
        view.number: [view.numbers[name] for name in names]
        for view in session.views
        if names[0] in view.numbers
    }


def test_poses_and_joints_of_one_log_change_rows_together(cell, tmp_path):
    sound = Session.load(cell)
    rewritten(cell, shifted((*POSE, *JOINTS)))
    done = guessed(cell, tmp_path / "fixed", "--yes")
    assert done.exit_code == 0, done.stderr
    fixed = Session.load(tmp_path / "fixed")
    for names in (POSE, JOINTS):
        found, wanted = by_view(fixed, names), by_view(sound, names)
        # One row at the end has lost its partner; the rest are the numbers that were written.
        assert len(found) == len(wanted) - 1
        np.testing.assert_allclose(list(found.values()), [wanted[it] for it in found], atol=1e-15)


def test_joints_that_were_right_stay_where_they_are(cell, tmp_path):
    sound = Session.load(cell)
    rewritten(cell, shifted(POSE))
    assert guessed(cell, tmp_path / "fixed", "--yes").exit_code == 0
    fixed = Session.load(tmp_path / "fixed")
    assert by_view(fixed, JOINTS) == by_view(sound, JOINTS)


def test_nothing_is_written_without_a_word_of_the_user(cell, tmp_path):
    rewritten(cell, in_millimetres)
    done = guessed(cell, tmp_path / "fixed")
    assert done.exit_code != 0
    assert "the robot's positions in mm" in done.stderr
    assert not (tmp_path / "fixed").exists()


def test_a_sound_session_is_not_accused_and_stays_what_it_is(cell, tmp_path):
    done = guessed(cell, tmp_path / "same", "--yes")
    assert done.exit_code == 0, done.stderr
    assert "fit as declared" in done.stderr
    assert Session.load(tmp_path / "same").digest() == Session.load(cell).digest()


def test_a_board_in_millimetres_is_read_so_and_said(cell):
    board = 'kind = "charuco"\ncolumns = 9\nrows = 6\nsquare_m = 30\nmarker_m = 22\n'
    (cell / "board.toml").write_text(f'{board}dictionary = "DICT_5X5_100"\n', encoding="utf-8")
    declared = (cell / "session.toml").read_text(encoding="utf-8")
    (cell / "session.toml").write_text(f'target = "board.toml"\n{declared}', encoding="utf-8")
    session = load_in_doubt(cell)
    assert session.target is not None
    # A factor of a thousand, and its rounding.
    assert session.target.square_m == pytest.approx(0.030, rel=1e-15)
    assert session.target.marker_m == pytest.approx(0.022, rel=1e-15)
    assert any("board.toml can only be in millimetres" in it for it in session.warnings)
