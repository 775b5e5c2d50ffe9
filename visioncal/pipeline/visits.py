"""Which views belong to one visit of a posture: robots come back to a few of them for hours."""

from collections.abc import Mapping, Sequence

from visioncal.session import View
from visioncal.types import FloatArray

# Views of one pose that were taken farther apart than this are of different visits [s].
_APART_S = 120.0


def visits(views: Sequence[View], poses: Mapping[int, FloatArray]) -> dict[int, object]:
    """What tells the stops of views apart beside their poses, by view; None for nothing.

    That is the number of their stop; or, of a pose to which the robot came back later, the first
    view of that visit.

    Args:
        views: The session's, in its order.
        poses: (4, 4) what the robot reported, by view.
    """
    told: dict[int, object] = {}
    last: dict[bytes, tuple[float, object]] = {}
    for view in views:
        pose = poses.get(view.number)
        told[view.number] = view.stop
        if view.stop is not None or pose is None or view.stamp_s is None:
            continue
        before, visit = last.get(key := pose.tobytes(), (view.stamp_s, None))
        if abs(view.stamp_s - before) > _APART_S:
            visit = f"back at view {view.number}"
        last[key] = (view.stamp_s, visit)
        told[view.number] = visit
    return told
