"""Commands that are printed as advice are run word for word, as a reader would paste them."""

from dataclasses import replace

import numpy as np
import pytest
from support.advice import failures, printed_commands
from support.commands import turned_poses, visioncal, write_poses
from support.fuzz.broken_sessions import BROKEN, broken_session, edit_rows
from support.marks import slow
from support.whole_cells import OPTIONS, recorded

from visioncal.cli import dynamics
from visioncal.core.transforms import invert
from visioncal.dynamics.excitation import ExcitationRequest
from visioncal.session import Session
from visioncal.simulation import CellOptions, simulate, write_session
from visioncal.simulation.dynamics import exercise_session, real_dynamics, record, slow_sweep

# Of each kind of advice one; the others are slow.
QUICK = ("two rows exchanged",)
# Read as they are, as tests of tables show: what is then printed is that of semicolons.
ALIKE = ("decimal commas", "a byte-order mark", "empty rows")


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder that the commands are typed in: some write beside it."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "name",
    [name if name in QUICK else slow(name) for name in BROKEN if name not in ALIKE],
)
def test_of_broken_sessions(place, name):
    broken_session(place / "session", BROKEN[name])
    said = [
        visioncal(*pair) for pair in (("doctor", "session"), ("calibrate", "session", "-o", "out"))
    ]
    assert {done.status for done in said} <= {0, 2, 3}
    # What both print is run once.
    assert list(failures("".join(done.said for done in said))) == []


@pytest.mark.slow
def test_of_poor_motion_with_a_modelled_arm(place):
    poor = CellOptions(seed=4, tilt_rad=(0.0, 0.1), views=8)
    write_session(simulate(poor), place / "session")
    done = visioncal("calibrate", "session", "-o", "out", "--need-mm", "0.02")
    assert "visioncal plan session --add 5" in done.said
    assert list(failures(done.said)) == []


WRONG_PLACES = {
    "a session's table for a result": (
        ("export", "session/views.csv", "--to", "ros"),
        "session/views.csv begins with 'view,",
        "nothing need be changed",
    ),
    "a result for a session": (("convert", "out", "copy"), "no session, but a result", "recording"),
    "no folder": (("calibrate", "session", "-o", ""), "-o is empty", "variable"),
    "no folder, as one word": (("plan", "session", "--out="), "--out is empty", "variable"),
    "touches for a drawing": (
        ("fixture", "session/views.csv", "--cad", "session/views.csv", "--tool", "none"),
        "views.csv has rotations",
        "Name the touches first",
    ),
    "no arm": (("simulate", "x", "--robot", "foo"), "ur10e, generic-6r-1800 are", "Name one"),
    "readings to plan for": (("plan", "tracker", "--add", "3"), "is of an instrument", "30 deg"),
    "readings to look in": (
        ("locate", "tracker", "-c", "tracked"),
        "is of an instrument",
        "visioncal verify",
    ),
}


@pytest.mark.parametrize("name", WRONG_PLACES)
def test_of_what_is_given_in_the_wrong_place(place, name):
    words, said, advised = WRONG_PLACES[name]
    write_session(simulate(CellOptions(views=8, seed=4)), place / "session", images=False)
    if "out" in words:
        for file in ("calibration.json", "recording.rrd"):
            (place / "out" / file).parent.mkdir(exist_ok=True)
            (place / "out" / file).touch()
    if "tracker" in words:
        assert visioncal("simulate", "tracker", "--instrument", "point").status == 0
    if "tracked" in words:
        assert visioncal("calibrate", "tracker", "-o", "tracked").status == 0
    done = visioncal(*words)
    assert done.status == 2
    assert said in done.said
    assert advised in done.said
    assert list(failures(done.said)) == []


@pytest.mark.slow
def test_of_verify(place):
    whole = Session.load(write_session(simulate(CellOptions(views=20, seed=5)), place / "all"))
    replace(whole, views=whole.views[:15]).save(place / "fit")
    assert visioncal("calibrate", "fit", "-o", "out").status == 0
    for name, last, change in (
        ("few", 18, lambda row: row),
        ("knocked", 20, lambda row: row | {"x_m": str(float(row["x_m"]) + 0.01)}),
    ):
        replace(whole, views=whole.views[15:last]).save(place / name)
        edit_rows(place / name, lambda rows, change=change: [*map(change, rows)])
        done = visioncal("verify", name, "--against", "out")
        assert printed_commands(done.said), name
        assert list(failures(done.said)) == []


def test_of_a_tool(place):
    rng = np.random.default_rng(3)
    above, tip = np.eye(3), np.array([0.02, 0.01, 0.15])
    tips = np.tile([0.4, 0.1, 0.2], (8, 1)) + rng.normal(scale=1e-4, size=(8, 3))
    poses = turned_poses(rng, tips, tip, above)
    write_poses(place / "inverse.csv", invert(poses))
    write_poses(place / "touches.csv", poses)
    for words in (
        ("tcp", "inverse.csv", "-o", "frames.json"),
        ("tcp", "touches.csv", "-o", "frames.json", "--force", "--touch-noise-mm", "0.01"),
    ):
        done = visioncal(*words)
        assert done.status == 0
        assert printed_commands(done.said), done.said
        assert list(failures(done.said)) == []


def test_of_a_fixture(place):
    assert visioncal("simulate", "cell", "--touches", "--no-images").status == 0
    assert visioncal("calibrate", "cell", "-o", "out").status == 0
    assert visioncal("tcp", "cell/touches.csv", "-c", "out", "--name", "gripper").status == 0
    points = (place / "cell/points.csv").read_text("utf-8").splitlines()
    view, name, x, *others = points[4].split(",")
    points[4] = ",".join((view, name, str(float(x) + 0.004), *others))
    (place / "missed.csv").write_text("\n".join(points), "utf-8")
    asked = ("fixture", "cell/points.csv", "--cad", "cell/cad.csv", "-c", "out")
    for words in (
        ("fixture", "missed.csv", *asked[2:], "--name", "jig"),
        (*asked, "--name", "tray", "--touch-noise-mm", "0.005"),
        (*asked, "--name", "bin", "--touch-noise-mm=0.005"),
    ):
        done = visioncal(*words)
        assert done.status == 0
        (again,) = printed_commands(done.said)
        # The advice's value stands behind what was typed, and counts.
        assert ("--touch-noise-mm" in again) == ("--touch-noise" in words[-1] + words[-2])
        # That of a value as one word is that of two.
        if "bin" not in words:
            assert list(failures(done.said)) == []


@pytest.mark.slow
def test_of_a_whole_cell(place):
    recorded(simulate(OPTIONS)).save(place / "cell")

    def pushed(row):
        is_there = (row["stop"], row["robot"]) == ("5", "a")
        return row | ({"x_m": str(float(row["x_m"]) + 0.03)} if is_there else {})

    edit_rows(place / "cell", lambda rows: [*map(pushed, rows)])
    done = visioncal("calibrate", "cell", "-o", "out")
    assert done.status == 0
    assert printed_commands(done.said), done.said
    assert list(failures(done.said)) == []


@pytest.mark.slow
def test_of_dynamics(place, monkeypatch):
    # The motion that is planned need not be a good one: a short search will do.
    monkeypatch.setattr(
        dynamics,
        "ExcitationRequest",
        lambda *words, **more: replace(ExcitationRequest(*words, **more), starts=1, steps=3),
    )
    rng = np.random.default_rng(2)
    built = real_dynamics("ur5e", rng)
    streams = {"sweeps": record(built, slow_sweep(6, rng, seconds=30.0), rng)}
    exercise_session("ur5e", streams).save(place / "session")
    done = visioncal("dynamics", "identify", "session", "-o", "out")
    assert done.status == 0
    assert "visioncal dynamics plan ur5e -o motions" in printed_commands(done.said)
    assert list(failures(done.said)) == []
