"""The newest picture: which one is given, and what is told where none is."""

import queue
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from visioncal.core.errors import DriverError
from visioncal.live.drivers.newest import Arrival, Newest

# Longer than any picture takes that comes at all [s].
PATIENT_S = 20.0


class Scripted:
    """A source whose pictures, or failures, come when a test says so; a picture is its stamp."""

    def __init__(self):
        self.coming, self.taken, self.closed = queue.Queue(), [], threading.Event()

    def grab(self):
        """Waits for what comes next."""
        coming = self.coming.get()
        if isinstance(coming, Exception):
            raise coming
        self.last = coming
        return coming

    def take(self):
        """Gives the picture, and remembers that it was decoded."""
        self.taken.append(self.last.stamp_s)
        return self.last.stamp_s

    def interrupt(self):
        """Ends what waits."""
        self.coming.put(DriverError("interrupted"))

    def close(self):
        """Is told to the test."""
        self.closed.set()


@pytest.fixture
def source():
    return Scripted()


@pytest.fixture
def newest(source):
    made = Newest(source, "camera 0")
    yield made
    made.close()


def given(newest, source, moment_s, *stamps, before=(), timeout_s=PATIENT_S):
    """The picture that is given to a request, of those that came before it and those after."""
    with ThreadPoolExecutor(1) as pool:
        for stamp in before:
            source.coming.put(Arrival(stamp))
        if len(before):
            _until(lambda: newest._stamps_s and newest._stamps_s[-1] == before[-1])
        waiting = pool.submit(newest.after, moment_s, timeout_s)
        _until(lambda: newest._request not in (None, newest._first))
        for stamp in stamps:
            source.coming.put(stamp if isinstance(stamp, Arrival) else Arrival(stamp))
        return waiting.result()[1]


def _until(holds):
    waiting = threading.Event()
    while not holds():
        waiting.wait(0.001)


def test_the_first_picture_of_all_is_kept(newest, source):
    source.coming.put(Arrival(1.0))
    _until(lambda: source.taken)
    assert newest.first(PATIENT_S)[1] == 1.0


def test_what_was_under_way_when_it_was_asked_for_is_passed_by(newest, source):
    before = np.arange(0.0, 4.0, 0.1)
    assert given(newest, source, 4.05, 4.0, 4.1, 4.2, before=before) == 4.2
    # Only what is given is decoded.
    assert source.taken == [0.0, 4.2]


def test_a_burst_after_a_stall_had_waited_and_is_passed_by(newest, source):
    before = np.arange(0.0, 4.0, 0.1)
    burst = 7.0 + 0.01 * np.arange(30)
    assert given(newest, source, 4.05, *burst, 7.39, before=before) == 7.39


def test_where_a_driver_knows_the_times_they_decide(newest, source):
    old, fresh = Arrival(5.06, 5.04), Arrival(5.07, 5.051)
    assert given(newest, source, 5.05, old, fresh) == 5.07


def test_a_slow_camera_is_waited_for_by_its_own_pace(newest, source):
    # One picture a second; the limit alone would end the waiting at once.
    before = np.arange(0.0, 5.0)
    assert given(newest, source, 4.5, 5.0, 6.0, before=before, timeout_s=0.0) == 6.0


def test_for_how_long_nothing_came_is_told(newest):
    with pytest.raises(DriverError, match=r"camera 0 stalls: no picture has come for 0\.\d s"):
        newest.after(0.0, 0.01)


def test_pictures_that_all_come_late_are_told(newest, source):
    late = [Arrival(float64, float64 - 0.01) for float64 in np.arange(1.0, 2.0, 0.1)]
    with pytest.raises(DriverError, match=r"no fresh pictures: its last one came \d+\.\d s late"):
        given(newest, source, 1e9, *late, timeout_s=0.2)


def test_what_fails_in_the_thread_reaches_whoever_asks(newest, source):
    source.coming.put(ZeroDivisionError("a bug"))
    assert source.closed.wait(PATIENT_S)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError, match="a bug"):
            newest.after(0.0, PATIENT_S)


def test_what_fails_while_a_picture_is_decoded_reaches_whoever_asks(newest, source):
    def failing():
        raise DriverError("cannot be decoded")

    source.take = failing
    with pytest.raises(DriverError, match="cannot be decoded"):
        given(newest, source, 0.5, 1.0, 2.0)


def test_closing_ends_the_thread_and_lets_go_of_the_camera(newest, source):
    newest.close()
    newest.close()
    assert source.closed.is_set()
    assert not newest._thread.is_alive()
