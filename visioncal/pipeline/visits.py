"""Which views belong to one visit of a posture: robots come back to a few of them for hours."""

from collections.abc import Mapping, Sequence

from visioncal.session import View
from visioncal.session.observations import LONG_S, still_since
from visioncal.types import FloatArray


def visits(views: Sequence[View], poses: Mapping[int, FloatArray]) -> dict[int, object]:
    """What tells the stops of views apart, by view.

    That is the number of their stop; or else their pose, of which one reading counts while the
    robot stands still, with the first view of the visit where it came back to that pose later.

    Args:
        views: The session's, in its order.
        poses: (4, 4) what the robot reported, by view.
    """
    told: dict[int, object] = {it.number: it.stop for it in views}
    unnamed = [it for it in views if it.stop is None and it.number in poses]
    since = still_since(unnamed)
    last: dict[bytes, tuple[float, object]] = {}
    for view in unnamed:
        key, visit = poses[since[view.number]].tobytes(), None
        if view.stamp_s is not None:
            before, visit = last.get(key, (view.stamp_s, None))
            if abs(view.stamp_s - before) > LONG_S:
                visit = view.number
            last[key] = (view.stamp_s, visit)
        told[view.number] = (key, visit)
    return told
