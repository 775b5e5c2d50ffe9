"""Calls that have to be refused."""

from collections.abc import Callable
from typing import Any

import pytest

from visioncal.core.errors import VisioncalError


def raised(
    kind: type[VisioncalError], words: str, call: Callable[..., Any], /, *arguments, **options
) -> VisioncalError:
    """The error that a call ends with: of this class, with words that match."""
    with pytest.raises(kind, match=words) as caught:
        call(*arguments, **options)
    return caught.value
