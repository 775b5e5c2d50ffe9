"""Causes of doubts: how likely each is, what competes, and what stands on top."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from samples import made_up
from scipy.special import chdtrc
from test_need import NEED
from test_verdict import SOUND, changed, directions, left_out

from visioncal.calibration.stages import causes as ranking
from visioncal.calibration.stages.causes import EVIDENCE, with_misread
from visioncal.calibration.stages.judge import judge
from visioncal.calibration.stages.need import Picks
from visioncal.cli.pointing import told_of
from visioncal.results import Cause, Rms, Verdict
from visioncal.results.verdicts import read_verdict, verdict_document

EXCHANGED = "Views 3 and 4 are exchanged: the image of each fits the pose in the other's row."
POSTURE = "Residuals follow the arm's posture (likelihood ratio 45, noise stays under 15.1)"
DRIFT = "Residuals drift with time: from the first stop to the last, base or target moved."
SIZE = (
    "By the robot's motion the board is 0.47 % larger than stated (sigma 0.06 %): squares of "
    "36.36 mm, which is not what is stated (to within 0.08 %)."
)


def chi2_chance(square: float) -> float:
    return float(chdtrc(1.0, square))


def ids(verdict: Verdict) -> list[str]:
    return [it.cause for it in verdict.causes]


def test_a_good_result_has_no_causes() -> None:
    assert judge(SOUND).causes == ()


def test_exchanged_rows_come_first_with_what_is_left_without_them() -> None:
    verdict = judge(changed(SOUND, warnings=(DRIFT, EXCHANGED), stops=8))
    assert ids(verdict)[0] == "exchanged_views"
    first = verdict.causes[0]
    assert first.probability > 0.9999
    assert first.without_it == (
        "Without them, views that are left out in turn agree to 0.11 mm and 0.011 deg."
    )
    assert "visioncal calibrate SESSION" in first.do
    assert verdict.causes == tuple(sorted(verdict.causes, key=lambda it: -it.probability))


@pytest.mark.parametrize(
    ("warnings", "chances"),
    [
        ((DRIFT,), (1e-4,)),
        # Those that give figures are weighed by them: twice a gain of 45, and 4.7 sigmas.
        ((POSTURE, DRIFT), (chi2_chance(45.0), 1e-4)),
        ((SIZE, DRIFT), (chi2_chance(22.09), 1e-4)),
    ],
)
def test_explanations_of_one_misfit_share_it(warnings, chances) -> None:
    """By the bound of Sellke, Bayarri and Berger on what a chance says, none of them among them."""
    verdict = judge(changed(SOUND, warnings=warnings, away_mm=1.0))
    odds = {text: -1.0 / (np.e * p * np.log(p)) for text, p in zip(warnings, chances, strict=True)}
    found = {it.sentence: it.probability for it in verdict.causes}
    for text in warnings:
        assert found[text] == pytest.approx(odds[text] / (1.0 + sum(odds.values())))
    (unexplained,) = (it for it in verdict.causes if it.cause == "unexplained")
    assert unexplained.probability == pytest.approx(1.0 / (1.0 + sum(odds.values())))
    assert sum(it.probability for it in verdict.causes) == pytest.approx(1.0)


def test_what_nothing_explains_is_the_cause_itself() -> None:
    (only,) = judge(changed(SOUND, away_mm=1.0)).causes
    assert (only.cause, only.probability) == ("unexplained", 1.0)
    assert "convert SESSION FIXED --guess" in only.do


@pytest.mark.parametrize(
    ("views", "cause"), [(range(12, 20), "something_moved"), ((6, 9), "wrong_views")]
)
def test_views_that_are_left_out_are_a_cause(views, cause: str) -> None:
    assert ids(judge(left_out(views)))[0] == cause


@pytest.mark.parametrize("need", [None, NEED])
def test_errors_that_are_too_large_come_from_their_sources(need) -> None:
    large, small = (np.diag(np.repeat([1e-6, it], 3) ** 2)[None] for it in (4e-4, 3e-4))
    picks = (Picks("cam", "robot", {"calibration": small, "look": large}, np.inf, 0.5),)
    found = replace(SOUND, need=need, picks=picks, worst=directions(2e-3, 0, 0, 0))
    verdict = judge(found)
    assert ids(verdict) == ["robot_noise", "calibration"]
    assert [it.probability for it in verdict.causes] == pytest.approx([0.64, 0.36])
    without = f"Without it 95 % of picks land within {0.3 * np.sqrt(7.815):.2f} mm"
    assert verdict.causes[0].without_it.startswith(without)
    assert ("within what is needed" in verdict.causes[0].without_it) == (need is not None)
    assert "visioncal plan SESSION --add 5" in verdict.causes[1].do
    # What can be had without them is no cause of a doubt about something else.
    met = replace(found, need=None, worst=directions(1e-4), warnings=(DRIFT,))
    assert ids(judge(met)) == ["moved_slowly"]


def test_poses_that_are_misread_explain_the_rest() -> None:
    before = judge(changed(SOUND, warnings=(DRIFT,)))
    after = with_misread(before, "The quaternions are w, x, y, z.")
    assert ids(after) == ["misread_poses", "moved_slowly"]
    assert sum(it.probability for it in after.causes) <= 1.0
    assert after.reasons == ("The quaternions are w, x, y, z.", *before.reasons)


def test_three_stand_on_top_and_nothing_is_said_twice() -> None:
    reasons = ("A is wrong. Look at A.", "B is odd.", "C is odd.", "D is odd.", "A note.")
    odd = (0.9, 0.8, 0.7, 0.1)
    causes = tuple(
        Cause(it[0].lower(), p, it.split(". ")[0], "Without it all is well.")
        for it, p in zip(reasons[:4], odd, strict=True)
    )
    lines = Verdict("check", reasons, causes=causes).lines
    assert lines[0] == "Most likely (90 %): A is wrong. Look at A. Without it all is well."
    assert lines[1].startswith("Then (80 %): B is odd.")
    assert lines[3:] == ("D is odd.", "A note.")
    sized = Verdict(
        "bad", ("Only so many land.",), causes=(Cause("noise", 0.6, "It is.", "", "Do."),)
    )
    assert sized.lines == ("Only so many land.", "Most likely (60 %): It is. Do.")
    assert Verdict("good", ("Fine.",)).lines == ("Fine.",)


def test_causes_are_kept_and_name_the_session(tmp_path: Path) -> None:
    verdict = judge(changed(SOUND, warnings=(EXCHANGED,), stops=8))
    assert read_verdict(verdict_document(verdict)) == verdict
    named = told_of(replace(made_up(2).calibration, verdict=verdict), tmp_path / "my cell").verdict
    assert f"visioncal calibrate '{tmp_path}/my cell'" in named.causes[0].do


def test_what_stages_say_is_what_the_ranking_listens_for() -> None:
    """A sentence that is worded anew would silently be a remark."""
    package = Path(ranking.__file__).parents[1]
    said = re.sub(
        r'"\s*\n\s*f?"', "", "\n".join(it.read_text("utf-8") for it in package.rglob("*.py")
                                       if it.name != "causes.py")
    )  # fmt: skip
    for words, cause in ranking._SAID.items():
        assert cause in EVIDENCE
        for part in words.split("|"):
            text = re.sub(r"[()]|\.\*.*", "", part).strip()
            assert text in said, part


def _scattered() -> Verdict:
    return judge(changed(SOUND, held_out=Rms(30.0, 0.011), rms=Rms(29.0, 0.01)))


def test_scatter_without_any_finding_is_unexplained() -> None:
    assert ids(_scattered()) == ["unexplained"]
