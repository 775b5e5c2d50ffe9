"""Public functions given what they do not take: refused by name, never from inside."""

import inspect

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


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """What functions take, by the arguments' names; what is not here is given as the wrong one."""
    folder = tmp_path_factory.mktemp("sound") / "session"
    cell = simulate(CellOptions(views=4, seed=2))
    write_session(cell, folder)
    session, calibration = visioncal.Session.load(folder), calibration_of(cell)
    image = decode_image(session.images.read(session.views[0].image))
    pose = session.views[0].base_from_flange().as_matrix()
    return {
        "session": session,
        "calibration": calibration,
        "a": calibration,
        "b": calibration,
        "px": [[640.0, 400.0]],
        "plane": visioncal.Plane.horizontal(0.0),
        "base_from_flange": pose,
        "seen": image,
        "target": BOARD,
        "sights": [visioncal.Sight("1", image, pose)],
        "parent": "base",
        "kind": "fixture",
    }


def public_functions():
    for name in visioncal.__all__:
        thing = getattr(visioncal, name)
        if callable(thing) and not inspect.isclass(thing):
            yield thing
        for method in METHODS.get(name, ()):
            yield getattr(thing, method)


@pytest.mark.slow
def test_nothing_public_fails_from_inside(sound, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # What people hand over by mistake.
    foreign = [None, BOARD, tmp_path / "views.csv", {"a": 1}, 3.5, [1], object()]
    foreign += [sound["session"], sound["calibration"], sound["seen"].astype(float)]
    foreign.append(np.dstack([sound["seen"]] * 3))
    refused = 0
    for function in public_functions():
        parameters = inspect.signature(function).parameters
        needed = [
            name for name, of in parameters.items() if of.default is of.empty and of.kind != 4
        ]
        for wrong in parameters:
            for value in foreign:
                try:
                    function(**{name: sound.get(name, value) for name in needed} | {wrong: value})
                except VisioncalError:
                    refused += 1
    # Most of what is tried is wrong; without a check it would not get here.
    assert refused > 500


def test_pictures_of_16_bits_are_taken_where_they_are_stored(sound):
    image, pose = sound["seen"], sound["base_from_flange"]
    deep, shallow = (
        visioncal.Session.from_arrays([picture], pose[None], BOARD)
        for picture in (257 * image.astype(np.uint16), image)
    )
    assert deep.views[0].image == shallow.views[0].image
    with pytest.raises(DataError, match="seen is an array of uint16"):
        visioncal.locate_target(sound["calibration"], 257 * image.astype(np.uint16), BOARD, pose)
