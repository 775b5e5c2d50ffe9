"""The table of errors against the truth, as demo prints it."""

from dataclasses import replace

import numpy as np

from visioncal.calibration.run import calibrate
from visioncal.cli.summary import truth_rows
from visioncal.simulation import CellOptions, simulate
from visioncal.simulation.records import cell_session


def test_a_lens_that_is_held_has_no_ratio_of_error_and_sigma():
    found = calibrate(cell_session(simulate(CellOptions(views=12)), "cell", seen="corners"))
    held = replace(found.camera, covariance=np.zeros((9, 9)))
    edges = {name: edge.matrix for name, edge in found.edges.items()}
    rows = [*truth_rows(replace(found, camera=held), edges, held.camera)]
    assert [ratio for *_, ratio in rows][-4:] == ["", "", "", ""]
