"""Fixtures that several tests share."""

import gc
import os

# A test a core: threads of theirs would only wait for one another. Read as libraries are loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from markupsafe import Markup, escape
from support.result_schema import faults_below
from support.searched import SEARCHES

from visioncal.live.drivers import ur, ur_net
from visioncal.simulation import CAMERAS, CellOptions, simulate, write_session

DATA = Path(__file__).parents[2] / "shared" / "data"
# Whose tests read a report's words, if anything: figures are described and not drawn, which takes
# most of the time of writing a result. A module that looks at them says `DRAWS = True`.
UNDRAWN = {
    "calibration", "cli", "core", "dynamics", "frames", "interchange", "live", "results", "session",
    "simulation", "tests",
}  # fmt: skip

# The same examples everywhere, and none fails because a computer is busy.
settings.register_profile(
    "steady", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("steady")


# Modules and tests stay: to look for garbage among them takes a third of the collection's time.
gc.disable()


def pytest_collection_finish():
    """Leaves what was collected out of what is looked through for garbage."""
    gc.freeze()
    # Fits leave few cycles, and to look for them takes a twentieth of their time.
    gc.set_threshold(20_000)
    gc.enable()


@pytest.fixture
def strict_rerun():
    """Turns rerun's warnings, which it prints and forgets, into errors."""
    import rerun as rr

    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real measurements, which lies beside a checkout and is never part of it."""
    if not DATA.is_dir():
        pytest.skip("the folder of real measurements is not here (../shared/data)")
    return DATA


@pytest.fixture(scope="session")
def rendered(tmp_path_factory) -> Path:
    """A rendered session of 12 views without intrinsics, its truth beside it. Read only.

    Its pictures have a quarter of the pixels: to draw, store and search them takes most of a test.
    """
    folder = tmp_path_factory.mktemp("rendered sessions, größer") / "cell"
    wide = CAMERAS["wide"]
    small = replace(wide, resolution=(640, 400), matrix=wide.matrix / 2)
    options = CellOptions(camera=small, blur_px=0.5, views=12, state_intrinsics=False, seed=11)
    return write_session(simulate(options), folder)


@pytest.fixture(scope="session", autouse=True)
def files_are_written_later():
    """Leaves it to the system when files are on the disk, as no test cuts the power.

    Waiting for the disk takes a tenth of the time of tests that write many files.
    """
    with pytest.MonkeyPatch.context() as patch:
        # Of a file that is open.
        patch.setattr(os, "fsync", os.fstat)
        yield


@pytest.fixture(scope="session", autouse=True)
def calibrations_are_as_their_schema_says(tmp_path_factory):
    """Checks the files that tests wrote, when the last of them has run."""
    yield
    assert faults_below(tmp_path_factory.getbasetemp()) == []


class Undrawn:
    """Takes every call and every attribute of a figure and its axes, and draws nothing."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __call__(self, *_, **__):
        """Whatever a method would return."""
        return self

    def __getitem__(self, _):
        return self

    def subplots(self, rows, columns, **_):
        """Axes (rows, columns) that draw nothing either."""
        return np.full((rows, columns), self)


@pytest.fixture(scope="module", autouse=True)
def figures(request):
    """Leaves out matplotlib where no test looks at a figure."""
    if getattr(request.module, "DRAWS", request.path.parent.name not in UNDRAWN):
        yield
        return

    def described(_, words):
        return Markup(f'<svg role="img" aria-label="{escape(words)}"></svg>')

    with pytest.MonkeyPatch.context() as patch:
        plotting = "visioncal.present.report.plotting"
        patch.setattr(f"{plotting}.Figure", lambda *_, **__: Undrawn())
        patch.setattr(f"{plotting}._svg", described)
        yield


@pytest.fixture(scope="module", autouse=True)
def searches(request):
    """Searches a picture once where its search is not the subject."""
    with pytest.MonkeyPatch.context() as patch:
        if getattr(request.module, "SEARCHES_ONCE", request.path.parent.name != "vision"):
            for module, name, found in SEARCHES:
                patch.setattr(module, name, found)
        yield


@pytest.fixture
def patient(monkeypatch) -> None:
    """Lets a UR's driver wait for a simulated controller as long as a busy computer makes it."""
    for module, names in ((ur, "_CALL _BEGIN _SILENCE"), (ur_net, "_CONNECT _ANSWER")):
        for name in names.split():
            monkeypatch.setattr(module, f"{name}_S", 10.0)
    monkeypatch.setattr(ur_net.Dashboard.__init__, "__defaults__", (10.0,))
    monkeypatch.setattr(ur, "_LEAST_HZ", 0.1)
