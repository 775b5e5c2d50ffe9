"""Faults of simulated recordings: reports that belong elsewhere, and images of other rows."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DataError
from visioncal.core.transforms import compose
from visioncal.core.types import FloatArray
from visioncal.session import frame_name
from visioncal.simulation.arms import DhArm, forward, inverse
from visioncal.simulation.cell import SimulatedCell, SimulatedSight
from visioncal.simulation.draws import RandomStream


def misreported(
    arm: DhArm, moved: FloatArray, count: int, rng: np.random.Generator
) -> tuple[FloatArray, tuple[int, ...]]:
    """Joints as reported: those moved to, but for some stops whose report belongs elsewhere.

    Args:
        arm: The nominal arm.
        moved: (s, n) joint angles moved to [rad].
        count: How many stops are reported 5 to 30 mm and 1 to 5 degrees away.
        rng: Source of randomness.

    Returns:
        (s, n) joint angles as reported [rad], and those stops, ascending.
    """
    chosen = np.sort(rng.permutation(len(moved))[:count])
    joints = moved.copy()
    for stop in chosen:
        for _ in range(20):
            turn, shift = rng.normal(size=(2, 3))
            turn *= np.deg2rad(rng.uniform(1.0, 5.0)) / np.linalg.norm(turn)
            shift *= rng.uniform(0.005, 0.030) / np.linalg.norm(shift)
            error = compose(Rotation.from_rotvec(turn).as_matrix(), shift)
            reach = inverse(arm, forward(arm, moved[stop, None]) @ error, moved[stop, None])
            if reach.solved[0]:
                joints[stop] = reach.joints[0]
                break
        else:
            raise DataError(f"simulation: no wrong report is in the arm's reach at stop {stop}.")
    return joints, tuple(chosen.tolist())


def with_faults(cell: SimulatedCell) -> SimulatedCell:
    """Exchanges images of rows, and takes some from other stops."""
    layout, rng = cell.layout, cell.options.stream(RandomStream.FAULTS)
    sights = list(cell.sights)
    groups: dict[tuple[str, str], list[int]] = {}
    for at, sight in enumerate(sights):
        if sight.stop >= 0 and _moves(cell, sight):
            groups.setdefault((sight.camera, sight.board), []).append(at)
    pools = [rng.permutation(group).tolist() for group in groups.values() if len(group) > 1]
    wrong: list[int] = []
    for _ in range(layout.swapped_rows):
        pool = _pool(pools, 2)
        first, second = pool.pop(), pool.pop()
        sights[first], sights[second] = (
            _showing(cell.sights[first], cell.sights[second]),
            _showing(cell.sights[second], cell.sights[first]),
        )
        wrong += [first, second]
    for _ in range(layout.stray_images):
        rng.shuffle(pools)
        pool = _pool(pools, 2)
        row = pool.pop()
        sights[row] = _showing(cell.sights[row], cell.sights[pool[0]])
        wrong.append(row)
    views = sorted(cell.sights[index].view for index in wrong)
    return replace(cell, sights=tuple(sights), wrong_views=tuple(views))


def _moves(cell: SimulatedCell, sight: SimulatedSight) -> bool:
    """Whether a board moves before a camera."""
    carriers = [
        cell.parents[frame_name("camera", sight.camera)],
        cell.parents[frame_name("target", sight.board)],
    ]
    return carriers[0] != carriers[1]


def _pool(pools: list[list[int]], least: int) -> list[int]:
    for pool in pools:
        if len(pool) >= least:
            return pool
    raise DataError("simulation: there are too few rows of one camera and board for such faults.")


def _showing(row: SimulatedSight, image: SimulatedSight) -> SimulatedSight:
    """A row with the image of another stop."""
    return replace(image.numbered(row.view), stop=row.stop)
