"""The verdict: each doubt by itself, with the sentence that tells of it."""

import numpy as np
import pytest
from support.sound_findings import SOUND, changed, directions, views

from visioncal.calibration.suspects.judge import judge
from visioncal.core.number_format import figure
from visioncal.core.types import Rejection
from visioncal.core.verdict import remarks
from visioncal.results import Rms

LOST = [Rejection(at, "blurred: very") for at in range(30, 40)]


def test_noise_that_chance_makes_of_a_good_arms_is_no_doubt():
    """Coarse poses leave it open: doubt is about what it is at the least."""
    loud = {"noise_mm": 0.1, "noise_deg": 0.025}
    assert judge(changed(SOUND, **loud, lower_bounds=(0.05, 0.012))).status == "good"
    assert judge(changed(SOUND, **loud, lower_bounds=(0.05, 0.021))).status == "check"


@pytest.mark.parametrize(
    ("changes", "status", "words"),
    [
        ({"held_out": Rms(3.0, 0.011), "rms": Rms(2.9, 0.01)}, "check", "by 3 mm (doubt begins"),
        ({"held_out": Rms(30.0, 0.011), "rms": Rms(29.0, 0.01)}, "bad", "by 30 mm"),
        ({"held_out": Rms(0.11, 0.5), "rms": Rms(0.1, 0.45)}, "check", "by 0.5 deg"),
        ({"held_out": Rms(0.11, 3.0), "rms": Rms(0.1, 2.9)}, "bad", "by 3 deg"),
        ({"held_out": Rms(0.2, 0.011)}, "check", "fit 2.0 times worse than views in the fit"),
        ({"held_out": Rms(0.5, 0.011)}, "bad", "fit 5.0 times worse"),
        ({"held_out": Rms(0.11, 0.02)}, "check", "fit 2.0 times worse"),
        ({"holdout": Rms(2.0, 0.01)}, "check", "holds back are missed by 2 mm"),
        ({"holdout": Rms(0.1, 0.4)}, "check", "0.4 deg, 36 times worse"),
        (
            {"worst": directions(2e-3, 0, 0, 0)},
            "check",
            "the direction 0 (2 mm)",
        ),
        ({"worst": directions(4e-3, 0, 0, 0)}, "bad", "the direction 0 (4 mm)"),
        (
            {"worst": directions(0, 3e-3, 0, 0)},
            "check",
            "the direction 1 (0.17 deg)",
        ),
        (
            {"worst": directions(0, 0, 2e-3, 0)},
            "check",
            "the direction 2 (2 mm)",
        ),
        ({"noise_mm": 1.0}, "check", "take a flange that is off by 1 mm and 0.0057 deg"),
        ({"noise_deg": 0.029}, "check", "0.029 deg from stop to stop"),
        ({"stops": 8}, "check", "Only 8 stops are used"),
        ({"stops": 4, "views": views(4)}, "bad", "Only 4 views are used"),
        ({"stops": 1, "views": views(1)}, "bad", "Only 1 view is used"),
        (
            {"lost": LOST},
            "check",
            "10 of 30 views are not used. The first but for outliers: view 30, blurred",
        ),
        ({"lost": LOST * 4}, "bad", "40 of 60 views"),
        ({"pixel_px": 1.0}, "check", "Corners deviate by 1 px"),
        ({"pixel_px": 4.0}, "bad", "Corners deviate by 4 px"),
        (
            {"warnings": remarks(("The board is upside down.",))},
            "check",
            "The board is upside down.",
        ),
    ],
)
def test_each_doubt_has_its_sentence(changes, status, words):
    verdict = judge(changed(SOUND, **changes))
    assert verdict.status == status
    assert len(verdict.reasons) == 1
    assert words in verdict.reasons[0]


@pytest.mark.parametrize(
    "changes",
    [
        {"holdout": Rms(0.2, 0.02)},
        {"lost": LOST[:3]},
        {"pixel_px": None},
        {"noise_mm": None},
        # Exact data: held-out and in-sample scatter are both rounding.
        {"rms": Rms(1e-10, 1e-11), "held_out": Rms(9e-10, 9e-11)},
    ],
)
def test_what_is_ordinary_raises_no_doubt(changes):
    assert judge(changed(SOUND, **changes)).status == "good"


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (0.0, "0"),
        (2.1e-13, "under 0.001"),
        (-1e-9, "under 0.001"),
        (0.0214, "0.021"),
        (0.0996, "0.1"),
        (2.96, "3"),
        (1234.6, "1235"),
        (-273.4, "-273"),
        (np.inf, "inf"),
    ],
)
def test_figures_have_no_exponents(value, words):
    assert figure(value) == words


def test_a_scatter_that_settles_it_is_not_blamed_on_the_motion():
    wild = changed(
        SOUND,
        held_out=Rms(80.0, 5.0),
        rms=Rms(75.0, 4.8),
        worst=directions(0.02, 0.02, 0.02, 0.02),
    )
    verdict = judge(wild)
    assert verdict.status == "bad"
    assert not any("weakly determined" in reason for reason in verdict.reasons)
    assert "units or conventions" in verdict.reasons[0]


def test_what_a_sensors_noise_makes_is_not_unexplained():
    """A small board far away scatters by 0.36 deg where its pixels do."""
    seen = {"held_out": Rms(0.1, 0.36), "rms": Rms(0.1, 0.35)}
    assert judge(changed(SOUND, **seen, noise=Rms(0.1, 0.33))).status == "good"
    # Half as much again is beyond chance.
    verdict = judge(changed(SOUND, **seen, noise=Rms(0.1, 0.2)))
    assert verdict.findings[0].kind == "unexplained"


def test_what_settles_it_comes_first():
    verdict = judge(changed(SOUND, pixel_px=4.0, warnings=remarks(("Something.",)), stops=8))
    assert verdict.reasons[0].startswith("Corners deviate")
    assert len(verdict.reasons) == 3
