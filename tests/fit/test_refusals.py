"""Cells that leave something open: refused, never by a traceback."""

from dataclasses import replace

import numpy as np
import pytest
from support.marks import seeds
from support.refusals import raised
from support.small_cells import TABLE, made
from support.whole_cells import OPTIONS, recorded

from visioncal.core.errors import ConvergenceError, DataError, DegenerateError
from visioncal.core.transforms import exp, invert
from visioncal.core.types import Camera
from visioncal.fit.solve import solve
from visioncal.fit.start import start_of
from visioncal.model import Arm, MeasuredPose, Moments, read_cell
from visioncal.model.arm import even_progress
from visioncal.simulation import simulate


def held(cell, first=0):
    """The cell whose sightings are predicted only, from one on."""
    sightings = [replace(one, is_held=at >= first) for at, one in enumerate(cell.sightings)]
    return cell.with_sightings(sightings)


@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("given", [True, False])
def test_cells_with_too_few_sightings_are_refused(given, cameras):
    cell = made(stops=8, cameras=cameras, given=given).cell
    for count in (0, 1, 2):
        # The first error of a lens of which nothing is stated is about the lens.
        kind = DegenerateError if given or not count else DataError
        caught = raised(
            kind,
            "determined" if kind is DegenerateError else "views?",
            solve,
            cell.only(range(count)),
        )
        assert "Add" in caught.next_step
        assert caught.culprits
        if count:
            raised(kind, "determined|views?", solve, held(cell, count))
    raised(DegenerateError, "not determined", solve, held(cell))


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        ((0.0, 0.0, 0.4), "cam's offset along flange's z is not determined at all"),
        ((0.0, 0.0, 0.0), "cam's offset from flange is not determined at all"),
    ],
)
def test_motion_that_leaves_a_direction_open_is_refused_by_its_name(turn, words):
    small, rng = made(stops=10), np.random.default_rng(8)
    robot = small.robot[0] @ exp(rng.normal(size=(10, 6)) * [*turn, 0.1, 0.1, 0.1])
    seen = invert(robot @ small.edges["cam"]) @ small.edges["target"]
    views = [
        replace(one, evidence=MeasuredPose(at, (1e-4, 1e-4)))
        for one, at in zip(small.cell.sightings, seen, strict=True)
    ]
    arms = {"flange": Arm("flange", robot)}
    cell = replace(small.cell, arms=arms, moments=Moments.of(arms, even_progress(10)))
    caught = raised(DegenerateError, words, solve, cell.with_sightings(views))
    assert "tilted by 20 to 40 degrees" in caught.next_step


def test_cells_of_which_a_part_is_tied_to_nothing_are_refused():
    session = recorded(simulate(OPTIONS))
    cell = read_cell(session, session.corners)
    floor = [
        at for at, one in enumerate(cell.sightings) if one.pair == ("cam_left", "target_floor")
    ]
    raised(DegenerateError, "determined", solve, cell.only(floor))
    # No number of sightings may end in a traceback.
    for count in (1, 3, 6, 9):
        raised(DegenerateError, "determined", solve, cell.only(range(count)))


@pytest.mark.parametrize("draws", seeds(1, 4))
def test_a_lens_that_starts_far_off_ends_in_no_traceback(monkeypatch, draws):
    """As found where views of few corners mislead the closed form of focal lengths."""
    refused = list[str]()
    for focal in (60.0, 350.0, 3e4):
        for seed in draws:
            small = made(seed, stops=12, given=False)
            matrix = np.array([focal, focal, 900.0, 200.0])
            wild = Camera("brown", TABLE.resolution, matrix, np.zeros(5))
            monkeypatch.setattr(
                "visioncal.fit.start.start_lenses", lambda *_, lens=wild: {"cam": lens}
            )
            try:
                solve(small.cell)
            except (ConvergenceError, DegenerateError) as error:
                refused.append(error.next_step)
    assert refused
    assert all(refused)


def test_every_view_is_in_the_cell_or_reported_as_absent():
    small = made(stops=10)
    sightings = list(small.cell.sightings)
    line = sightings[3].corners.take(np.arange(len(sightings[3].corners.ids)) < 5)
    sightings[3] = replace(sightings[3], evidence=line)
    cell = solve(small.cell.with_sightings(sightings)).start.cell
    assert [one.view for one in cell.sightings] == [0, 1, 2, 4, 5, 6, 7, 8, 9]
    assert "in one row of the target" in cell.absent[3]


@pytest.mark.parametrize("draws", seeds(1, 6))
def test_a_lens_is_found_beside_views_of_one_row(draws):
    for seed in draws:
        small = made(seed, stops=24, given=False)
        sightings = list(small.cell.sightings)
        for at in range(0, 24, 2):
            # All but one in a row: they have many homographies.
            corners = sightings[at].corners
            kept = np.isin(corners.ids, [0, 1, 2, 5])
            sightings[at] = replace(sightings[at], evidence=corners.take(kept))
        lens = start_of(small.cell.with_sightings(sightings)).lenses["cam"]
        assert lens.matrix[:2] == pytest.approx(TABLE.matrix[:2], rel=0.05)
