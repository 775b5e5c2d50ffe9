"""Broken inputs, a few of the thousands that `benchmarks/mutated.py` draws."""

import pytest
from support.fuzz.mutants import READINGS, missing_commands, unknown_inputs, walk

# No figure is looked at.
DRAWS = False
# Inputs that are made within a second, and commands that end soon on them.
QUICK = {
    "pairs", "pairs.rrd", "out", "touches.csv", "features.csv", "points.csv", "drawing.csv",
    "frames.json", "arm.toml", "target.toml", "photo.png", "plan", "tracked",
    "foreign/kuka_csv", "foreign/visp", "foreign/views_npz",
}  # fmt: skip
READ = [reading for reading in READINGS if reading.input in QUICK and "_out]" not in reading.words]
SOUND, COUNT = 3, 40


def test_every_command_that_reads_is_called():
    assert not missing_commands()
    assert not unknown_inputs()


@pytest.mark.slow
def test_broken_inputs_end_in_a_result_or_a_clear_refusal(tmp_path):
    ended = list(walk(range(-SOUND, COUNT), tmp_path, readings=READ))
    assert len(ended) == SOUND + COUNT
    assert [str(item) for item in ended if item.faults] == []
    assert all(item.status == item.reading.sound for item in ended if item.number < 0)
    # Some changes are none, such as a row in another place; most are not survived.
    assert COUNT / 4 < sum(item.status == 2 for item in ended) < COUNT
    assert {item.reading.command for item in ended} > {
        "calibrate", "convert", "export", "fixture", "plan", "show", "tcp"
    }  # fmt: skip
