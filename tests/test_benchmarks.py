"""What every benchmark script shares: `--quick`, and RESULTS.md."""

import re
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).with_name("benchmarks")
sys.path.append(str(FOLDER))

import results  # noqa: E402

SCRIPTS = [path for path in sorted(FOLDER.glob("*.py")) if "__main__" in path.read_text("utf-8")]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda value: value.stem)
def test_every_benchmark_does_less_with_quick(script):
    assert re.search(r'"--quick"|\b(few|first|wished|QUICK)\b', script.read_text("utf-8"))


def test_a_quick_run_leaves_the_results_as_they_are(monkeypatch, tmp_path):
    file = tmp_path / "RESULTS.md"
    results.write_section("Speed", "python speed.py", "fast", file)
    results.write_section("Size", "python size.py", "small", file)
    before = file.read_text("utf-8")
    monkeypatch.setattr(results, "QUICK", True)
    monkeypatch.setattr(results, "WORDS", ())
    results.write_section("Speed", "python speed.py", "slow", file)
    assert file.read_text("utf-8") == before
    assert (results.few(200, 3), results.first("abc"), results.wished(20)) == (3, ["a"], 1)
    monkeypatch.setattr(results, "QUICK", False)
    results.write_section("Speed", "python speed.py", "slow", file)
    assert file.read_text("utf-8") == before.replace("fast", "slow")
    monkeypatch.setattr(results, "WORDS", ("7",))
    assert (results.few(200, 3), results.first("abc"), results.wished(20)) == (200, [*"abc"], 7)
