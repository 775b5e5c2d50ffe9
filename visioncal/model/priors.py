"""Priors `[prior.A_from_B]` of session.toml on a cell's frames, as sightings of B by A."""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose
from visioncal.model.sightings import Evidence, MeasuredPlace, MeasuredPose, Sighting
from visioncal.session.document import Declaration, PriorTable
from visioncal.session.tree import Tree, check_prior


def stated_sightings(
    declaration: Declaration, tree: Tree, sightings: Sequence[Sighting]
) -> Iterator[Sighting]:
    """A sighting of each component that is stated: one that the views contradict goes alone.

    They are of the last stop, where effects of time are zero. Edges that no other sighting passes
    have none; nor has, in sessions without names, a prior of anything but fixed frames.

    Raises:
        DataError: A frame is unknown, or a robot moves one of the two relative to the other.
    """
    passed = {step.frame for s in sightings for step in tree.path(*s.pair)}
    stop, number = max((s.stop for s in sightings), default=0), 0
    for name, table in declaration.prior.items():
        try:
            first, second = _fixed_frames(name, tree)
        except DataError:
            if declaration.has_names:
                raise
            continue
        if passed.issuperset(step.frame for step in tree.path(first, second)):
            for evidence in _components(table):
                number -= 1
                yield Sighting(number, stop, first, second, evidence)


def _components(table: PriorTable) -> Iterator[Evidence]:
    for axis, value in enumerate((table.x_m, table.y_m, table.z_m)):
        if value is not None:
            yield MeasuredPlace(value * np.eye(3)[axis], table.sigma_m, (axis,))
    if table.quaternion_xyzw is not None:
        turn = Rotation.from_quat(table.quaternion_xyzw).as_matrix()
        yield MeasuredPose(compose(turn, np.zeros(3)), (table.sigma_rad, np.inf))


def _fixed_frames(prior: str, tree: Tree) -> tuple[str, str]:
    """Both frames of a prior."""
    words, found = prior.partition("_from_"), []
    for name in (words[0], words[2]):
        # Of one of a kind, the kind is enough.
        kind = "point" if name == "probe" else name
        matches = [frame for frame in tree.branches if f"{frame}_".startswith(f"{kind}_")]
        found.append(matches[0] if name not in tree.branches and len(matches) == 1 else name)
    check_prior(prior, found[0], found[1], tree)
    return found[0], found[1]
