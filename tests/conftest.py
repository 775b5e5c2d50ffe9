"""Fixtures that several tests share."""

from dataclasses import replace
from pathlib import Path

import pytest

from visioncal.simulation import CellOptions, simulate, write_session

DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real measurements, which lies beside a checkout and is never part of it."""
    if not DATA.is_dir():
        pytest.skip("the folder of real measurements is not here (../shared/data)")
    return DATA


@pytest.fixture(scope="session")
def rendered(tmp_path_factory) -> Path:
    """A rendered session of 12 views without intrinsics, its truth beside it. Read only."""
    folder = tmp_path_factory.mktemp("rendered sessions, größer") / "cell"
    options = replace(CellOptions(), views=12, state_intrinsics=False, seed=11)
    return write_session(simulate(options), folder)
