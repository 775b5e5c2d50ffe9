"""Options that have no use beside others."""

from collections.abc import Mapping

from visioncal.core.errors import DataError
from visioncal.core.files import some_of


def refuse_given(options: Mapping[str, object], why: str, next_step: str = "Leave it out.") -> None:
    """Refuses options that have no use here.

    Args:
        options: By their names; None for those that were not given.
        why: They have none, in words.
        next_step: What to do instead.

    Raises:
        DataError: One is given.
    """
    given = [name for name, value in options.items() if value is not None]
    if given:
        raise DataError(f"{some_of(given)}: {why}.", culprits=given, next_step=next_step)
