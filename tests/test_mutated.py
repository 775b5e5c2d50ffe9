"""Broken inputs, a few of the thousands that `support.fuzz.mutants` draws."""

import re

import pytest
from support.fuzz.mutants import READINGS, missing_commands, walk

# Inputs that are made within a second, and commands that end soon on them.
QUICK = re.compile(
    r"(convert|diff|export|fixture|guard|tcp|show|verify) (?!.*(--page|\[[b-o]\w+_out)).*"
    r"\{(pairs|pairs_out|pairs.rrd|pairs/\w+.csv|pairs.jsonl|guard.json|frames.json|arm.toml|"
    r"foreign/[a-hk-z]\w+)\}"
)
# Every second one, so that each command is among them.
READ = [words for words in READINGS if QUICK.match(words)][::2]
SOUND, COUNT = 2, len(READ)


def test_every_command_that_reads_is_called():
    assert not missing_commands()


@pytest.mark.parametrize(
    ("readings", "count"),
    [(READ, COUNT), pytest.param(READINGS, 400, marks=pytest.mark.slow)],
    ids=["quick", "all"],
)
def test_broken_inputs_end_in_a_result_or_a_clear_refusal(readings, count, tmp_path):
    ended = list(walk(range(-SOUND, count), tmp_path, readings=readings))
    assert len(ended) == SOUND + count
    assert [item for item in ended if item.faults] == []
    assert all(item.status != 2 for item in ended if item.number < 0)
    # Some changes are none, such as a row in another place; most are not survived.
    assert count / 4 < sum(item.status == 2 for item in ended) < count
    assert {item.reading.split()[0] for item in ended} > {"convert", "export", "guard", "tcp"}
