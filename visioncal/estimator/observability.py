"""What the motion can tell about the two unknown edges, and what it leaves open, in words."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.errors import DegenerateError
from visioncal.estimator.closure import Closure, Noise, closure_information
from visioncal.estimator.linalg import covariance, spectrum
from visioncal.transforms import invert
from visioncal.types import FloatArray, Mount

# Under this scaled eigenvalue ratio a direction is not determined by the motion at all.
_NULL_RATIO = 1e-8
# Over these predicted sigmas a result is of no use to anybody.
SIGMA_LIMIT_M, SIGMA_LIMIT_RAD = 5e-3, np.deg2rad(0.5)
# A direction this close to an axis is called by the axis.
_NEARLY_AXIS = 0.95
_FEWEST_VIEWS = 3


@dataclass(frozen=True)
class Direction:
    """The direction of an edge that is known worst.

    Attributes:
        words: What it is, such as `the camera's offset along the tool's z`.
        sigma: Its predicted standard deviation [m or rad].
        limit: The largest that is accepted, in the same unit.
        is_rotation: Whether it is an angle.
    """

    words: str
    sigma: float
    limit: float
    is_rotation: bool

    @property
    def figure(self) -> str:
        """The sigma and its limit with their unit."""
        unit, scale = ("deg", np.rad2deg(1.0)) if self.is_rotation else ("mm", 1e3)
        return f"{self.sigma * scale:.2g} {unit} (limit {self.limit * scale:.2g})"


def edge_names(mount: Mount) -> tuple[str, str]:
    """Names of the two unknown edges, in the order x, z."""
    if mount == "eye-in-hand":
        return "flange_from_cam", "base_from_target"
    return "base_from_cam", "flange_from_target"


def check_observability(
    data: Closure,
    x: FloatArray,
    z: FloatArray,
    noise: Noise,
    mount: Mount,
    common: FloatArray | None = None,
) -> tuple[Direction, ...]:
    """Refuses motion that leaves a direction open; otherwise tells the worst ones.

    Args:
        data: The used views.
        x: (4, 4) first edge.
        z: (4, 4) second edge.
        noise: Of the residuals.
        mount: Which tree it is.
        common: (12, 12) covariance that errors common to all views add.

    Returns:
        The worst direction of each edge, in translation and in rotation.

    Raises:
        DegenerateError: A direction is numerically null, or its predicted sigma is over the limit.
    """
    if len(data) < _FEWEST_VIEWS:
        raise DegenerateError(
            f"hand-eye: {len(data)} usable views; at least {_FEWEST_VIEWS} are needed, because two "
            f"share one axis of rotation and leave {_along(mount)} that axis open.",
            next_step=_advice(mount),
        )
    information = closure_information(data, x, z, noise)
    spread = spectrum(information)
    total = covariance(information) + (0.0 if common is None else common)
    worst = _worst_directions(total, x, z, mount)
    if spread.ratio < _NULL_RATIO:
        culprit = _null_direction(spread.vectors[:, 0], x, z, mount)
        raise DegenerateError(
            f"hand-eye: {culprit} is not determined at all (information ratio "
            f"{spread.ratio:.0e}, needs {_NULL_RATIO:.0e}): {_motion(data, mount)}.",
            culprits=[culprit],
            next_step=_advice(mount),
        )
    beyond = [it for it in worst if it.sigma > it.limit]
    if beyond:
        raise DegenerateError(
            f"hand-eye: {beyond[0].words} has a predicted sigma of {beyond[0].figure}: "
            f"{_motion(data, mount)}.",
            culprits=[it.words for it in beyond],
            next_step=_advice(mount),
        )
    return worst


def _worst_directions(
    spread: FloatArray, x: FloatArray, z: FloatArray, mount: Mount
) -> tuple[Direction, ...]:
    found = []
    for edge, transform in enumerate((x, z)):
        for is_rotation in (False, True):
            start = 6 * edge + (0 if is_rotation else 3)
            block = spread[start : start + 3, start : start + 3]
            values, vectors = np.linalg.eigh(block)
            limit = SIGMA_LIMIT_RAD if is_rotation else SIGMA_LIMIT_M
            words = _words(edge, transform[:3, :3] @ vectors[:, -1], mount, is_rotation)
            found.append(Direction(words, float(np.sqrt(values[-1])), float(limit), is_rotation))
    return tuple(found)


def _null_direction(vector: FloatArray, x: FloatArray, z: FloatArray, mount: Mount) -> str:
    """Names the part of a null direction that moves most; a radian counts as a metre."""
    parts = [vector[3:6], vector[:3], vector[9:], vector[6:9]]
    # The camera's own edge comes first: it is what the user asked for.
    sizes = np.linalg.norm(parts, axis=1) * [1.01, 1.0, 0.99, 0.98]
    at = int(np.argmax(sizes))
    edge, is_rotation = divmod(at, 2)
    part = parts[at] / np.linalg.norm(parts[at])
    return _words(edge, (x, z)[edge][:3, :3] @ part, mount, bool(is_rotation))


def _words(edge: int, direction: FloatArray, mount: Mount, is_rotation: bool) -> str:
    """Says which component of which edge a direction in the edge's parent frame is."""
    thing = "camera" if edge == 0 else "target"
    frame = _frame(mount) if edge == 0 else _other_frame(mount)
    quantity = "rotation about" if is_rotation else "offset along"
    return f"the {thing}'s {quantity} the {frame}'s {_axis(direction)}"


def _axis(direction: FloatArray) -> str:
    at = int(np.argmax(np.abs(direction)))
    if abs(direction[at]) > _NEARLY_AXIS:
        return "xyz"[at]
    signed = direction * np.sign(direction[at])
    return "direction ({:.2f}, {:.2f}, {:.2f})".format(*signed)


def _frame(mount: Mount) -> str:
    """The frame that the camera hangs on, in which the relative motions act."""
    return "tool" if mount == "eye-in-hand" else "base"


def _other_frame(mount: Mount) -> str:
    return "base" if mount == "eye-in-hand" else "tool"


def _along(mount: Mount) -> str:
    return f"the camera's offset from the {_frame(mount)} along"


def _motion(data: Closure, mount: Mount) -> str:
    """Says what is wrong with the motion."""
    i, j = np.triu_indices(len(data), 1)
    relative = invert(data.robot[j]) @ data.robot[i]
    turns = Rotation.from_matrix(relative[:, :3, :3]).as_rotvec()
    largest = np.rad2deg(np.linalg.norm(turns, axis=1).max())
    count = len(data)
    if largest < 0.5:
        return (
            f"the {count} used views differ in position only (largest rotation between two of "
            f"them: {largest:.2g} deg)"
        )
    main = np.linalg.svd(turns, full_matrices=False)[2][0]
    aside = np.rad2deg(np.linalg.norm(turns - np.outer(turns @ main, main), axis=1).max())
    if aside < 0.1 * largest:
        return (
            f"all {count} used views turn about the {_frame(mount)}'s {_axis(main)} to within "
            f"{aside:.2g} deg"
        )
    return (
        f"the {count} used views turn by at most {largest:.2g} deg, and by {aside:.2g} deg "
        "about a second axis"
    )


def _advice(mount: Mount) -> str:
    return (
        f"Add 3 or more views in which the flange is tilted by 20 to 40 degrees about different "
        f"axes, not only about one axis of the {_frame(mount)}."
    )
