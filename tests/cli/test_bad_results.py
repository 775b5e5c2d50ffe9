"""A bad result says so by its exit status, and is carried on to a robot by force alone."""

import json

import pytest
from support.commands import visioncal

from visioncal.results import Calibration

# No cell of this kind reaches it: the probability of the need is zero.
NEED = ("--need-mm", "0.001")


@pytest.fixture(scope="module")
def bad(tmp_path_factory):
    """A session, and the output folder of its bad result."""
    folder = tmp_path_factory.mktemp("bad")
    simulated = visioncal("simulate", folder / "cell", "--no-images", "--views", 12, "--seed", 4)
    assert simulated.status == 0
    done = visioncal("calibrate", folder / "cell", "-o", folder / "out", *NEED)
    assert done.status == 3
    assert Calibration.load(folder / "out").verdict.status == "bad"
    return folder / "cell", folder / "out"


def test_calibrate_and_batch_end_with_status_3(bad, tmp_path):
    done = visioncal("calibrate", bad[0], "-o", tmp_path / "out", *NEED, "--json")
    assert done.status == 3
    assert json.loads(done.out)["verdict"]["status"] == "bad"
    assert visioncal("calibrate", bad[0], "-o", tmp_path / "out").status == 0
    drawn = ("--no-report", "--workers", 1)
    assert visioncal("batch", bad[0], "-o", tmp_path / "many", *NEED, *drawn).status == 3
    assert visioncal("batch", bad[0], "-o", tmp_path / "other", *drawn).status == 0


@pytest.mark.parametrize(
    "command",
    [
        "export {out} --to ur",
        "correct {session}/views.csv --against {out}",
        "locate {session} -c {out}",
        "locate -c {out} --pixel 640,400 --plane z=20 --pose 0.5,0.1,0.4,0,1,0,0",
    ],
)
def test_a_bad_result_is_used_by_force_alone(bad, command):
    words = command.format(session=bad[0], out=bad[1]).split()
    refused = visioncal(*words)
    assert refused.status == 3
    assert refused.out == ""
    assert "is bad" in refused.err
    assert "--force" in refused.err
    first, *others = Calibration.load(bad[1]).verdict.reasons
    assert first in refused.err
    assert not any(reason in refused.err for reason in others)
    machine = visioncal(*words, "--json") if words[0] != "export" else None
    if machine is not None:
        assert machine.status == 3
        assert json.loads(machine.out)["error"]["class"] == "VerdictError"
    forced = visioncal(*words, "--force")
    assert forced.status != 3
    if words[0] == "export":
        assert forced.status == 0, forced.err
        assert "is bad" in forced.err
