"""What every benchmark script shares: `--quick`, and RESULTS.md."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).with_name("benchmarks")))

import results


def test_a_quick_run_leaves_the_results_as_they_are(monkeypatch, tmp_path):
    file = tmp_path / "RESULTS.md"
    file.write_text("".join(f"<!-- begin {name} -->\n<!-- end {name} -->\n" for name in "ab"))
    for name in "ab":
        results.write_section(name, "python speed.py", "fast", file)
    before = file.read_text("utf-8")
    monkeypatch.setattr(results, "QUICK", True)
    results.write_section("a", "python speed.py", "slow", file)
    assert file.read_text("utf-8") == before
    assert results.few(200, 3) == 3
    monkeypatch.setattr(results, "QUICK", False)
    results.write_section("a", "python speed.py", "slow", file)
    assert file.read_text("utf-8") == before.replace("fast", "slow", 1)
    assert results.few(200, 3) == 200
