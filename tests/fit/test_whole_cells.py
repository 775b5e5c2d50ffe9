"""Cells of several arms, cameras and boards by the one likelihood."""

import numpy as np
from scipy.stats import chi2
from support.whole_cells import OPTIONS, recorded

from visioncal.core.transforms import invert, log
from visioncal.fit.solve import solve
from visioncal.model import read_cell
from visioncal.simulation import simulate


def test_a_cell_of_two_arms_is_found_as_surely_as_it_says():
    simulated = simulate(OPTIONS)
    session = recorded(simulated)
    cell = read_cell(session, session.corners)
    assert cell.bodies == (("flange_a", "flange_b"),)
    fit = solve(cell).fit
    true = simulated.transforms
    base = true["cell_from_base_a"]
    for name in ("base_b", "cam_left", "cam_hand", "target_floor", "target_plate_a"):
        parent = cell.tree.branches[name].parent
        edge = true[f"{parent}_from_{name}"]
        edge = invert(base) @ edge if parent == "cell" else edge
        away = log(invert(edge) @ fit.edge(name))
        square = away @ np.linalg.solve(fit.covariance(("edge", name)), away)
        # One of a thousand sound cells has one of its five edges beyond this.
        assert square < chi2.isf(2e-4, 6), name
    # Seen from each other, an arm's hand and its own plate are not moved by the other arm.
    found = fit.predict("flange_a", "cam_hand", cell.moments.take(np.arange(1)))
    assert np.allclose(found.calibration[0], fit.covariance(("edge", "cam_hand")))
    assert not found.noise.any()


def test_arms_that_no_sighting_connects_are_eliminated_apart():
    simulated = simulate(OPTIONS)
    session = recorded(simulated)
    cell = read_cell(session, session.corners)
    own = [s for s in cell.sightings if s.pair == ("cam_left", "target_plate_b")]
    own += [s for s in cell.sightings if s.pair == ("cam_left", "target_plate_a")]
    apart = cell.with_sightings(own)
    assert sorted(apart.bodies) == [("flange_a",), ("flange_b",)]
    fit = solve(apart).fit
    assert [body.width for body in fit.mixed.bodies] == [6, 6]
    assert fit.used.mean() > 0.9
