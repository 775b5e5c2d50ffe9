"""Recordings of checks, guards and years: what they hold, read back from the file."""

import json
from datetime import UTC, datetime

import numpy as np
import pytest
from rerun.chunk import RrdReader
from support.commands import visioncal as command

from visioncal.present.recording.rrd_messages import scan
from visioncal.present.recording.timeline import Moment, record_looks, write_timeline


def logged(path) -> dict[str, list]:
    """Values by entity, in their order."""
    found: dict[str, list] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.split(":")[-1] in ("scalars", "text"):
                values = batch.column(name).to_pylist()
                found.setdefault(str(chunk.entity_path), []).extend(
                    part for each in values if each for part in each
                )
    return found


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cell")
    views = ("--no-images", "--views")
    command("simulate", folder / "cell", *views, 12).good()
    options = ("-o", folder / "out", "--history", folder / "site.db")
    command("calibrate", folder / "cell", *options).good()
    knocked = ("--recording", 1, "--camera-moved-mm", 3)
    command("simulate", folder / "later", *views, 6, *knocked).good()
    return folder


def test_a_failed_check_records_residuals_and_the_cause(cell):
    out = cell / "check"
    options = ("--against", cell / "out", "-o", out, "--history", cell / "site.db")
    assert command("verify", cell / "later", *options).status == 3
    document = json.loads((out / "verify.json").read_text())
    assert not document["passed"]
    found = logged(out / "recording.rrd")
    away = next(
        values for entity, values in found.items() if "residual" in entity and "mm" in entity
    )
    undone = next(
        values for entity, values in found.items() if "undone" in entity and "mm" in entity
    )
    # The camera was knocked by 3 mm; turned with its board, that is as far.
    assert len(away) == 6
    assert np.median(away) > 2.0 > 0.5 > np.median(undone)
    assert all("camera" in words for words in found["/log"])
    assert "does not hold any more" in found["/note"][0]
    assert (out / "recording.rrd").stat().st_size < 200_000

    command("history", cell / "site.db", "--recording", cell / "years.rrd").good()
    years = logged(cell / "years.rrd")
    assert [words.split(", ")[1].split(":")[0] for words in years["/log"]] == ["good", "bad"]
    command("history", cell / "site.db", "--recording", cell / "years.rrd").refused("years.rrd")


def test_a_guards_looks_show_when_it_raised_its_alarm(tmp_path):
    answers = [
        {"look": at + 1, "time_s": 60.0 * at, "holds": at < 3, "evidence": 0.4 * at}
        | ({"causes": [{"cause": "camera", "probability": 0.97}]} if at >= 3 else {})
        for at in range(5)
    ]
    record_looks(tmp_path / "looks.rrd", [*answers, {"acknowledged": True}], "guard")
    found = logged(tmp_path / "looks.rrd")
    assert found["/figures/evidence/evidence"] == pytest.approx([0.0, 0.4, 0.8, 1.2, 1.6])
    # One alarm, at its first look.
    assert found["/log"] == ["camera (97 %)"]


def test_dates_and_names_with_slashes_are_kept(tmp_path):
    moments = [
        Moment(datetime(2026, 1, day, tzinfo=UTC), {"cell 4/noise_mm": 0.1}) for day in (1, 2)
    ]
    write_timeline(tmp_path / "a.rrd", "a", moments, "note")
    scan(tmp_path / "a.rrd")
    assert [
        values for entity, values in logged(tmp_path / "a.rrd").items() if "noise" in entity
    ] == [[0.1, 0.1]]
