"""OpenCV's matrices, from the mapping that its three text formats have in common."""

import math
import re

from visioncal.core.documents.bounds import MAX_VALUES
from visioncal.core.documents.values import as_numbers, mapping, number
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray

_MOST_AXES = 8


def matrix_from(value: object, where: str) -> FloatArray:
    """Builds a matrix from rows, cols (or sizes), dt and data.

    Args:
        value: The mapping; `data` is a list of numbers.
        where: Where it stands, for messages.

    Returns:
        (rows, cols) numbers, (rows, cols, channels) where dt names several channels, or an array
        of the stated sizes.

    Raises:
        DataError: A field is missing, or the data are not as many as the size asks for.
    """
    content = mapping(value, where)
    data = as_numbers(content.get("data"), f"{where}: data").reshape(-1)
    if "sizes" in content:
        sides = as_numbers(content["sizes"], f"{where}: sizes").reshape(-1).tolist()
    else:
        sides = [number(content.get(it), f"{where}: {it}") for it in ("rows", "cols")]
    kind = re.fullmatch(r"([0-9]*)[ucwsifdh]", str(content.get("dt", "d")))
    if kind is None:
        raise DataError(
            f"{where}: dt is {content.get('dt')!r}; one of OpenCV's types is needed, such as d.",
            culprits=[where],
        )
    if kind[1] and int(kind[1][:3]) > 1:
        sides.append(float(kind[1][:3]))
    whole = len(sides) <= _MOST_AXES and all(0 <= it <= MAX_VALUES and it % 1 == 0 for it in sides)
    shape = [int(it) for it in sides] if whole else []
    # A side of none hides the others from the count.
    if not whole or math.prod(max(it, 1) for it in shape) > MAX_VALUES:
        words = " x ".join(f"{it:g}" for it in sides[:_MOST_AXES])
        raise DataError(f"{where}: a matrix of {words} is none that is read.", culprits=[where])
    if math.prod(shape) != len(data):
        words = " x ".join(map(str, shape))
        raise DataError(
            f"{where}: the matrix has {len(data)} numbers; {words} are needed.", culprits=[where]
        )
    return data.reshape(shape)
