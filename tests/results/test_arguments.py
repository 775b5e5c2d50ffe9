"""Public functions given what they do not take: refused by name, never from inside."""

import inspect
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from support.picks import calibration_of

import visioncal
from visioncal.core.errors import DataError, VisioncalError
from visioncal.simulation import CellOptions, simulate, write_session
from visioncal.vision.boards.imaging import decode_image

BOARD = "charuco_9x6_30mm"
METHODS = {
    "Session": ("load", "from_arrays", "from_corners"),
    "Calibration": ("load",),
    "CalibratedArm": ("of",),
    "Plane": ("horizontal", "of_frame", "through"),
    "Loads": ("alike",),
}


@dataclass(frozen=True, eq=False)
class Bench:
    """A cell, and what functions take of it."""

    session: visioncal.Session
    calibration: visioncal.Calibration
    image: np.ndarray
    pose: np.ndarray
    folder: Path

    @property
    def foreign(self):
        """What people hand over by mistake."""
        files = [None, BOARD, self.folder / "views.csv", {"a": 1}, 3.5, [1], object()]
        in_colour = np.dstack([self.image] * 3)
        return [*files, self.session, self.calibration, self.image.astype(float), in_colour]

    @property
    def sound(self):
        """Arguments by name; what is not here is given as the wrong one is."""
        return {
            "session": self.session,
            "calibration": self.calibration,
            "a": self.calibration,
            "b": self.calibration,
            "px": [[640.0, 400.0]],
            "plane": visioncal.Plane.horizontal(0.0),
            "base_from_flange": self.pose,
            "seen": self.image,
            "target": BOARD,
            "sights": [visioncal.Sight("1", self.image, self.pose)],
            "parent": "base",
            "kind": "fixture",
        }


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench") / "session"
    cell = simulate(CellOptions(views=4, seed=2))
    write_session(cell, folder)
    session = visioncal.Session.load(folder)
    image = decode_image(session.images.read(session.views[0].image))
    pose = session.views[0].base_from_flange().as_matrix()
    return Bench(session, calibration_of(cell), image, pose, folder)


def public_functions():
    for name in visioncal.__all__:
        thing = getattr(visioncal, name)
        if callable(thing) and not inspect.isclass(thing):
            yield thing
        for method in METHODS.get(name, ()):
            yield getattr(thing, method)


def is_refused(function, given):
    try:
        function(**given)
    except VisioncalError:
        return True
    return False


@pytest.mark.slow
def test_nothing_public_fails_from_inside(bench, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused = 0
    for function in public_functions():
        parameters = inspect.signature(function).parameters
        needed = [
            name for name, of in parameters.items() if of.default is of.empty and of.kind != 4
        ]
        for wrong in parameters:
            for value in bench.foreign:
                given = {name: bench.sound.get(name, value) for name in needed} | {wrong: value}
                refused += is_refused(function, given)
    # Most of what is tried is wrong; without a check it would not get here.
    assert refused > 500


def test_pictures_of_16_bits_are_taken_where_they_are_stored(bench):
    deep = 257 * bench.image.astype(np.uint16)
    taken = visioncal.Session.from_arrays([deep], bench.pose[None], BOARD)
    shallow = visioncal.Session.from_arrays([bench.image], bench.pose[None], BOARD)
    assert taken.views[0].image == shallow.views[0].image
    with pytest.raises(DataError, match="seen is an array of uint16"):
        visioncal.locate_target(bench.calibration, deep, BOARD, bench.pose)
