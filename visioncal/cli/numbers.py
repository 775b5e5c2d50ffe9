"""Options that hold several numbers with commas between."""

import math

from visioncal.core.errors import DataError


def numbers_in(words: str, option: str, form: str) -> tuple[float, ...]:
    """Reads an option of numbers.

    Args:
        words: What the user wrote: `12.5,-3,0`.
        option: The option's name, for messages.
        form: What is needed, as names with commas between: `x,y,z`.

    Raises:
        DataError: It is not as many finite numbers.
    """
    try:
        values = tuple(float(it) for it in words.split(","))
    except ValueError:
        values = ()
    if len(values) != len(form.split(",")) or not all(map(math.isfinite, values)):
        raise DataError(
            f"{option} is {words[:80]!r}; {form} is needed, numbers with commas between.",
            culprits=[option],
        )
    return values
