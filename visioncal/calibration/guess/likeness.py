"""Which of the readings that close the chain alike is that of a cell as cells are.

The inverse of the robot's poses, that of the camera's, and another mount exchange the unknown
edges: no residual distinguishes them, but what sits on the flange is near it, and a camera looks at
what is before it.
"""

import numpy as np

from visioncal.calibration.guess.given import Recording, Scored

# Of edges whose lengths differ by less either may be the one on the flange.
_CLEARLY = 1.5


def _is_before(recording: Recording, scored: Scored) -> bool:
    """Whether the target is before the camera."""
    camera = scored.hypothesis.camera.poses(recording.camera)
    return bool(np.median(camera[scored.rows, 2, 3]) > 0.0)


def flange_and_cell_m(scored: Scored) -> tuple[float, float]:
    """Lengths of the unknown edge on the flange and of the one at the base [m]."""
    edges = (scored.fit.x, scored.fit.z)
    on_flange, at_base = edges if scored.hypothesis.mount == "eye-in-hand" else edges[::-1]
    return float(np.linalg.norm(on_flange[:3, 3])), float(np.linalg.norm(at_base[:3, 3]))


def likeness(recording: Recording, scored: Scored) -> tuple[bool, bool]:
    """A key by which likely cells come last."""
    on_flange_m, at_base_m = flange_and_cell_m(scored)
    return _is_before(recording, scored), on_flange_m < at_base_m


def is_far_likelier(recording: Recording, scored: Scored, other: Scored) -> bool:
    """Whether a reading is that of a cell and another, with its edges exchanged, is not."""
    before, other_before = _is_before(recording, scored), _is_before(recording, other)
    if before != other_before:
        return before
    on_flange_m, at_base_m = flange_and_cell_m(scored)
    other_on_flange_m, other_at_base_m = flange_and_cell_m(other)
    return _CLEARLY * on_flange_m < at_base_m and other_on_flange_m > other_at_base_m
