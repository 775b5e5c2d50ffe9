"""Pictures that several tests search: searched once a process, as the answer is always the same."""

import hashlib
import pickle
from copy import deepcopy
from dataclasses import replace
from importlib import import_module

from visioncal.calibration.pipeline import mended_images
from visioncal.calibration.stages import other_board
from visioncal.core.types import Corners
from visioncal.verification import scene_audit
from visioncal.vision import detection
from visioncal.vision.boards.identify import identify
from visioncal.vision.boards.layout import decoded
from visioncal.vision.scene import register


def _once(search):
    kept = {}

    def found(*given):
        key = hashlib.sha256(pickle.dumps(given)).digest()
        if key not in kept:
            kept[key] = search(*given)
        return deepcopy(kept[key])

    return found


_corners_in, _identify = _once(detection.corners_in), _once(identify)


def corners_in(image, target, view=0):
    """Corners as `detection.corners_in` finds them, whichever view shows the picture."""
    found = _corners_in(image, target)
    return replace(found, view=view) if isinstance(found, Corners) else found


# What searches, by module and name.
SEARCHES = [
    (detection, "corners_in", corners_in),
    (other_board, "identify", _identify),
    (mended_images, "identify", _identify),
    # Packages offer functions of the modules' names.
    (import_module("visioncal.interchange.formats.assemble"), "identify", _identify),
    (import_module("visioncal.vision.boards.identify"), "decoded", _once(decoded)),
    (scene_audit, "register", _once(register)),
]
