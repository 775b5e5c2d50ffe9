"""Time by which others are called silent, and how a stall of this computer is left out of it."""

from visioncal.live.drivers.protocols import Stopwatch


def test_what_a_stall_takes_is_left_out():
    times = iter([100.0, 100.05, 100.1, 107.0, 107.05, 200.0, 200.1])
    watch = Stopwatch(lambda: next(times))
    # Two steps as they are, the stall as 0.2 s.
    assert [round(watch.read(), 6) for _ in range(4)] == [0.05, 0.1, 0.3, 0.35]
    watch.restart()
    assert round(watch.read(), 6) == 0.1
