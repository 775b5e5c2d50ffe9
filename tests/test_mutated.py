"""Broken inputs, a few of the thousands that `benchmarks/mutated.py` draws."""

import pytest
from support.marks import slow
from support.mutants import READINGS, missing_commands, unknown_inputs, walk

# Inputs that are made within a second, and commands that end soon on them.
QUICK = {
    "pairs", "pairs.rrd", "out", "touches.csv", "features.csv", "points.csv", "drawing.csv",
    "frames.json", "policy.toml", "arm.toml", "target.toml", "photo.png", "plan", "tracked",
    "foreign/kuka_csv", "foreign/visp", "foreign/views_npz",
}  # fmt: skip
READ = [it for it in READINGS if it.input in QUICK and "_out]" not in it.words]
SOUND = 3


def test_every_command_that_reads_is_called():
    assert not missing_commands()
    assert not unknown_inputs()


@pytest.mark.parametrize("count", [12, slow(40)])
def test_broken_inputs_end_in_a_result_or_a_clear_refusal(tmp_path, count):
    ended = list(walk(range(-SOUND, count), tmp_path, readings=READ))
    assert len(ended) == SOUND + count
    assert [str(it) for it in ended if it.faults] == []
    assert all(it.status == it.reading.sound for it in ended if it.number < 0)
    # Some changes are none, such as a row in another place; most are not survived.
    assert count / 4 < sum(it.status == 2 for it in ended) < count
    commands = {it.reading.command for it in ended}
    assert count < 40 or commands > {
        "calibrate",
        "convert",
        "export",
        "fixture",
        "plan",
        "report",
        "tcp",
    }
