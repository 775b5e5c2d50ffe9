"""Distances between simple solids, and a UR5e's links as tubes: plain geometry of its own."""

import itertools

import numpy as np

from visioncal.simulation.arms import DhArm, link_frames

# The UR5e's links as tubes: how thick they are, and how far beside the joints' axes they run [m].
UR5E_RADIUS_M = (0.07, 0.06, 0.055, 0.05, 0.05, 0.05)
UR5E_ASIDE_M = (0.0, 0.138, 0.007, 0.0, 0.0, 0.0)
# Links that could meet: neighbours share a joint, and of the others those are near by design.
UR5E_PAIRS = ((0, 2), (0, 3), (0, 4), (0, 5), (1, 3), (1, 4), (1, 5))


def tubes(arm: DhArm, joints: np.ndarray) -> list[np.ndarray]:
    """For each link the (m, 4, 3) knots of its tube in the base frame, at (m, n) joints [m]."""
    frames = link_frames(arm, joints)
    found = []
    for link, aside in enumerate(UR5E_ASIDE_M):
        start, end = frames[:, link, :3, 3], frames[:, link + 1, :3, 3]
        offset = aside * frames[:, link, :3, 2]
        found.append(np.stack([start, start + offset, end + offset, end], axis=1))
    return found


def lines(knots: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The (m, 3) ends of the lines between (m, k, 3) knots, but for lines without length."""
    pairs = [(knots[:, at], knots[:, at + 1]) for at in range(knots.shape[1] - 1)]
    return [(p, q) for p, q in pairs if np.abs(p - q).max() > 0.0]


def lines_apart(p: np.ndarray, q: np.ndarray, r: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Distances (m,) between the lines p-q and r-s, each (m, 3).

    The squared distance is convex in both parameters; its minimum over one is known, so that a
    search over the other is left.
    """

    def apart(share: np.ndarray) -> np.ndarray:
        return point_to_line(p + share[:, None] * (q - p), r, s)

    return least(apart, len(p))


def point_to_line(point: np.ndarray, r: np.ndarray, s: np.ndarray) -> np.ndarray:
    along = s - r
    size = np.maximum(np.sum(along * along, axis=1), 1e-18)
    share = np.clip(np.sum((point - r) * along, axis=1) / size, 0.0, 1.0)
    return np.linalg.norm(point - r - share[:, None] * along, axis=1)


def line_to_box(
    p: np.ndarray, q: np.ndarray, base_from_box: np.ndarray, size: np.ndarray
) -> np.ndarray:
    """Distances (m,) between lines p-q and a box, whose pose is (4, 4) or (m, 4, 4)."""
    rotation, centre = base_from_box[..., :3, :3], base_from_box[..., :3, 3]

    def apart(share: np.ndarray) -> np.ndarray:
        point = p + share[:, None] * (q - p) - centre
        inside = np.einsum("...ji,...j->...i", rotation, point)
        return np.linalg.norm(np.maximum(np.abs(inside) - 0.5 * size, 0.0), axis=1)

    return least(apart, len(p))


def least(apart, count: int) -> np.ndarray:
    """The minimum (count,) of a convex function over shares from 0 to 1, by golden sections."""
    ratio = 0.5 * (np.sqrt(5.0) - 1.0)
    low, high = np.zeros(count), np.ones(count)
    for _ in range(32):
        a, b = high - ratio * (high - low), low + ratio * (high - low)
        left = apart(a) < apart(b)
        high, low = np.where(left, b, high), np.where(left, low, a)
    return np.min(
        [apart(0.5 * (low + high)), apart(np.zeros(count)), apart(np.ones(count))], axis=0
    )


def corners(base_from_box: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(..., 8, 3) corners of boxes at (..., 4, 4)."""
    unit = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    turned = np.swapaxes(base_from_box[..., :3, :3], -1, -2)
    return (unit * size) @ turned + base_from_box[..., None, :3, 3]


def clearances(
    arm: DhArm,
    joints: np.ndarray,
    floor_m: float | None,
    boxes: list[tuple[np.ndarray, np.ndarray]],
) -> np.ndarray:
    """Least distances (m,) of the UR5e's tubes from one another, the floor and boxes [m]."""
    found = tubes(arm, joints)
    apart = [
        lines_apart(*one, *other) - UR5E_RADIUS_M[a] - UR5E_RADIUS_M[b]
        for a, b in UR5E_PAIRS
        for one in lines(found[a])
        for other in lines(found[b])
    ]
    for link in range(1, len(found)):
        if floor_m is not None:
            apart.append(found[link][:, :, 2].min(axis=1) - floor_m - UR5E_RADIUS_M[link])
        for pose, size in boxes:
            for p, q in lines(found[link]):
                apart.append(line_to_box(p, q, pose, size) - UR5E_RADIUS_M[link])
    return np.min(apart, axis=0)
