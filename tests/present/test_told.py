"""Pages and notes say what they said: their words, kept in tests/data/told.json.

`python tests/present/test_told.py` writes them anew; read the difference before it is committed.
"""

import json
import re
from dataclasses import replace
from decimal import Decimal
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from support.aligned_cells import made_up_cell, with_cell
from support.arm_documents import calibrated, levels
from support.findings import sick, with_contradiction, with_findings
from support.samples import fixture_frame, made_up, tool_frame, with_frames

from visioncal.core.types import Target
from visioncal.present.recording.notes import verdict_markdown, view_markdown
from visioncal.present.report.page import render
from visioncal.results import (
    Finding,
    Moved,
    Remedy,
    Rms,
    RobotResult,
    UnconnectedFrame,
    Verdict,
    ViewResult,
)
from visioncal.results.arm import ArmLevel, ArmResult

KEPT = Path(__file__).parents[1] / "data" / "told.json"
# Of figures their descriptions are compared.
DRAWS = False


def bad(sample):
    """Two used views far from the others, views that share a reason, and five findings."""
    views = [
        replace(view, residual_mm=9.5) if view.view in (1, 4) else view
        for view in sample.calibration.views
    ]
    for number in (0, 2, 5):
        views[number] = replace(views[number], used=False, reason="blurred")
    tilted = Remedy("Add views tilted by 20 degrees.", "visioncal plan SESSION --add 5")
    found = (
        Finding("wrong_views", "View 1 is wrong.", Remedy("Look at it."), (1,), 0.9),
        Finding("weak_motion", "Its z is weakly determined.", tilted),
        Finding("lens", "The lens is another.", Remedy("Measure it."), probability=0.3),
        Finding("place", "Its y is weakly determined.", tilted),
        Finding("note", "It was cold."),
    )
    return replace(sample.calibration, views=tuple(views), verdict=Verdict("bad", found))


def by_park(sample):
    """The answer of a closed form, without a hold-out and with one view."""
    park = sample.calibration.solvers["park"].matrices
    edges = {
        name: replace(edge, matrix=park[name]) for name, edge in sample.calibration.edges.items()
    }
    return replace(sample.calibration, edges=edges)


def poor(sample):
    """One used view, no residuals, no solvers."""
    views = tuple(
        replace(view, residual_mm=0.0, residual_deg=None, rms_px=None)
        for view in sample.calibration.views[:1]
    )
    return replace(sample.calibration, views=views, rms=Rms(0.0, 0.0), solvers={})


def exact(sample):
    documents = sick()
    documents["uncertainty"]["budget_mm"] = {"poses": 0.0, "total": 0.0}
    documents["uncertainty"]["spectrum"] = [0.0] * 12
    documents["board"]["shape"]["bow_xy"] = 3e-4
    return with_findings(sample, documents)


def moved(cell):
    """A cell in which a camera moved, a frame is untied, and an arm was calibrated."""
    former, of_top = "cam_top_until_stop_4", {"seer": "cam_top", "seen": "target_plate"}
    joint = replace(
        cell,
        edges={**cell.edges, f"cell_from_{former}": cell.tree.edge_of("cam_top")},
        joint_covariance=np.pad(cell.joint_covariance, (0, 6)),
        views=(
            ViewResult(0, True, residual_mm=3.0, residual_deg=0.1, **of_top, stop=0),
            ViewResult(2, False, "disagrees", residual_mm=90.0, **of_top, stop=2),
            ViewResult(3, False, "blurred", seer="cam_hand", seen="target_plate", stop=2),
        ),
    )
    levels = tuple(
        ArmLevel(level=name, unknowns=6, rms_mm=mm, held_out_mm=mm, likelihood_ratio=0.0)
        for name, mm in (("nominal", 0.31), ("offsets", 0.17))
    )
    return with_cell(
        joint,
        tree={**cell.cell.tree, former: "cell"},
        moved=(Moved("cam_top", former, 4, 5, 0.58, 0.03),),
        untied=(UnconnectedFrame("cam_<far>", "Let it see target_plate."),),
        robots={"a": RobotResult(arm=ArmResult(level="offsets", levels=levels))},
    )


def shown():
    """Results of many kinds, each with its session and evidence where these are shown, too."""
    sample, poses, cell = made_up(), made_up(5, images=False), made_up_cell(5)
    marker = Target("marker", "marker", 1, 1, 0.1, 1e-4, dictionary="DICT_4X4_50", marker_id=7)
    yield "sample", sample.calibration, sample
    yield "result alone", sample.calibration, None
    yield "poses", poses.calibration, poses
    marked = replace(poses, session=replace(poses.session, target=marker))
    yield "marker, exact", exact(poses), marked
    yield "bad", bad(sample), sample
    yield "park", by_park(sample), None
    yield "one view", poor(sample), sample
    yield "contradiction", with_contradiction(sample), sample
    yield "sick", with_findings(sample, sick()), sample
    yield "tools", (framed := with_frames(sample)).calibration, framed
    bare = replace(tool_frame(), observations=(), details={}, verdict=Verdict("good"))
    unknown = tuple(replace(at, residual_mm=None) for at in tool_frame().observations)
    frames = {"flange_from_bare": bare, "fixture": replace(fixture_frame(), observations=unknown)}
    yield "bare tools", replace(sample.calibration, frames=frames), None
    arm = calibrated()
    for name, document in (
        ("arm", arm),
        ("arm as stated", {"level": "nominal", "levels": levels()[:1]}),
    ):
        yield name, with_findings(sample, {"kinematics": document}), sample
    yield "cell", cell, None
    yield "cell that moved", moved(cell), None


FIGURE = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?")


def words_of(html):
    """What a page says; of its figures, their descriptions, and of its session no digest.

    The digest follows the last bits of simulated poses, and so the processor's kernels.
    """
    unkept = (
        r"<style>.*?</style>|(?<=<dt>software</dt>)<dd>.*?</dd>|(?<=<dt>sha256</dt>)<dd>.*?</dd>"
    )
    html = re.sub(unkept, "", html, flags=re.S)
    html = re.sub(r'<svg[^>]*aria-label="([^"]*)".*?</svg>', r"[\1]", html, flags=re.S)
    html = re.sub(r'<tr[^>]* class="([a-z-]+)">', r"\n\1: ", html)
    html = re.sub(r"</?(?:span|code|b|t[dh]|d[td])\b[^>]*>(?:\s*<dd>)?", " ", html)
    lines = re.sub(r"<[^>]*>", "\n", html).splitlines()
    return [unescape(" ".join(line.split())) for line in lines if line.strip()]


def lines_of_pages():
    """Lines of all pages and notes."""
    lines: dict[str, list[str]] = {}
    for name, calibration, sample in shown():
        session, evidence = (sample.session, sample.evidence) if sample else (None, ())
        page = render(calibration, session, evidence)
        assert calibration.session_sha256 in page
        lines[f"report: {name}"] = words_of(page)
        lines[f"verdict: {name}"] = verdict_markdown(calibration).splitlines()
        if name == "bad":
            lines["views"] = [*map(view_markdown, calibration.views)]
    return lines


@pytest.fixture(scope="module")
def now():
    return lines_of_pages()


@pytest.mark.parametrize("name", json.loads(KEPT.read_text("utf-8")) if KEPT.exists() else [])
def test_pages_and_notes_keep_their_words(name, now):
    kept = json.loads(KEPT.read_text("utf-8"))[name]
    assert [FIGURE.sub("0", line) for line in now[name]] == [FIGURE.sub("0", line) for line in kept]
    # A figure that is rounded for print may end on the neighbouring digit with other last bits.
    for found, before in zip(now[name], kept, strict=True):
        figures = [[Decimal(figure) for figure in FIGURE.findall(line)] for line in (found, before)]
        for figure, expected in zip(*figures, strict=True):
            last = Decimal(1).scaleb(int(expected.as_tuple().exponent))
            assert abs(figure - expected) <= last, (found, before)


if __name__ == "__main__":
    KEPT.write_text(json.dumps(lines_of_pages(), indent=0, ensure_ascii=False) + "\n", "utf-8")
