"""A browser for the pages."""

import pytest
from support.page import launched


@pytest.fixture(scope="module")
def browser():
    with launched() as chromium:
        yield chromium
