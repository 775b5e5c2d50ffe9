"""Grids of circles: their centres and not those of ellipses, and which way up they are."""

from dataclasses import replace

import numpy as np
import pytest
from support.boards import circles
from support.marks import slow
from support.rendered import Shot, photograph

from visioncal.calibration.run import run
from visioncal.core.errors import DataError
from visioncal.core.transforms import invert, log
from visioncal.session import Session
from visioncal.simulation import (
    BOARDS,
    CAMERAS,
    CellOptions,
    prepare_scene,
    render,
    simulate,
    write_session,
)
from visioncal.vision.boards import DetectedCorners, NotFound, find_target
from visioncal.vision.targets import (
    corner_positions,
    rotations,
    target_document,
    target_from_document,
)

SHIFTED, EVEN = circles(4, 7, asymmetric=True, diameter_m=0.014), circles(6, 5)
SHOT = Shot(square_px=24, noise=2)


def numbered(seen, truth):
    """The centres as found, in the numbering of the truth: an even grid may be turned."""
    away = [np.abs(value - truth).max() for value in (seen.px, seen.px[::-1])]
    return seen.px if away[0] < away[1] else seen.px[::-1]


def test_circles_are_ordered_as_opencvs():
    places = corner_positions(SHIFTED) / SHIFTED.square_m
    expected = [(2 * j + i % 2, i, 0) for i in range(7) for j in range(4)]
    np.testing.assert_allclose(places, expected, atol=1e-12)
    assert target_from_document(target_document(SHIFTED), "board") == SHIFTED


@pytest.mark.parametrize(
    ("target", "count"),
    [(SHIFTED, 1), (circles(4, 6, asymmetric=True), 2), (EVEN, 2), (circles(5, 5), 4)],
)
def test_the_turns_are_those_that_leave_the_page_as_it_is(target, count):
    turns = rotations(target)
    assert len(turns) == count
    assert all(sorted(turn) == list(range(len(turn))) for turn in turns)


def test_circles_that_touch_are_refused():
    with pytest.raises(DataError, match=r"diameter_m is 0\.018; less than 0\.85 of the distance"):
        target_from_document(target_document(EVEN) | {"diameter_m": 0.018}, "mine")


# Errors are rms of a coordinate [px]; the template's own noise is half of what is allowed. Those of
# an ellipse's centre would be 0.1 and more in the tilted and the bent picture.
@pytest.mark.parametrize("target", [SHIFTED, EVEN])
@pytest.mark.parametrize(
    ("shot", "most_px"),
    [
        (SHOT, 0.008),
        slow(replace(SHOT, disc_px=3), 0.015),
        (replace(SHOT, tilt_deg=60, square_px=40), 0.01),
        slow(replace(SHOT, bend=0.15, ink_px=1), 0.01),
        (replace(SHOT, bayer=True), 0.025),
    ],
)
def test_centres_are_as_exact_as_the_image(target, shot, most_px):
    image, truth = photograph(target, shot, 1)
    seen = find_target(image, target)
    assert isinstance(seen, DetectedCorners), seen
    assert len(seen.ids) == len(truth)
    error = numbered(seen, truth) - truth
    assert np.sqrt(np.mean(error**2)) < most_px
    # Nothing that all centres share: their mean is as good as their number allows.
    assert np.abs(error.mean(axis=0)).max() < 4 * most_px / np.sqrt(len(error))


@pytest.mark.parametrize("table", [slow(30), slow(220)])
def test_light_circles_on_dark_are_as_exact(table):
    """A board printed in negative lies on a dark or a light table."""
    shot = Shot(square_px=60, uneven=0.3)
    for seed, target in enumerate((SHIFTED, EVEN)):
        picture, px = photograph(target, shot, seed)
        negative = np.pad(255 - picture, 200, constant_values=table)
        found = find_target(negative, target)
        assert isinstance(found, DetectedCorners)
        # As for dark circles of such a picture below: twice the template's own noise.
        assert np.sqrt(np.mean((numbered(found, px + 200) - px - 200) ** 2)) < 0.012


def test_centres_are_exact_where_a_fisheye_sees_them_slanted():
    # 0.11 m before a board of 0.24 m it looks at circles from up to 66 degrees aside.
    cell = simulate(
        CellOptions(target=BOARDS["symmetric-circles"], camera=CAMERAS["fisheye"], views=12, seed=1)
    )
    truth = cell.exact_corners[2].px
    seen = find_target(render(prepare_scene(cell), 2), cell.options.target)
    error = numbered(seen, truth) - truth
    assert np.sqrt(np.mean(error**2)) < 0.015


@pytest.mark.parametrize("change", [{"columns": 5}, {"asymmetric": False}])
def test_another_page_is_refused(change):
    found = find_target(photograph(SHIFTED, SHOT, 2)[0], replace(SHIFTED, **change))
    assert isinstance(found, NotFound)
    assert "circles is seen" in found.reason


@pytest.mark.parametrize(
    ("target", "mount"),
    [
        (BOARDS["circles"], "eye-to-hand"),
        slow(BOARDS["symmetric-circles"], "eye-in-hand"),
        slow(BOARDS["circles"], "eye-in-hand"),
        slow(BOARDS["symmetric-circles"], "eye-to-hand"),
    ],
)
def test_a_cell_is_calibrated_with_it(tmp_path, mount, target):
    cell = simulate(CellOptions(target=target, views=12, mount=mount, seed=5))
    write_session(cell, tmp_path / "s")
    result = run(Session.load(tmp_path / "s")).calibration
    # Of centres to 0.004 px the lens's last digits may be a point to settle.
    assert result.verdict.status in ("good", "check")
    assert sum(view.used for view in result.views) >= 11
    # An even grid has two frames.
    errors = []
    for turn in (np.eye(4), TURNED if not target.asymmetric else np.eye(4)):
        edges = {
            name: true @ turn if name.endswith("target") else true
            for name, true in cell.transforms.items()
        }
        error = np.concatenate(
            [log(invert(result.edges[edge].matrix) @ edges[edge]) for edge in edges]
        )
        errors.append(error @ np.linalg.solve(result.joint_covariance, error))
    # Twelve values, to one case in a thousand.
    assert min(errors) < 32.9


TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])
TURNED[:2, 3] = corner_positions(BOARDS["symmetric-circles"])[-1, :2]
