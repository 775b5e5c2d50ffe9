"""OpenCV's matrices, from the mapping that its three text formats have in common."""

import re

import numpy as np

from visioncal.documents.values import as_numbers, mapping, number
from visioncal.errors import DataError
from visioncal.types import FloatArray


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
        shape = [number(it, f"{where}: sizes") for it in _list(content["sizes"])]
    else:
        shape = [number(content.get(it), f"{where}: {it}") for it in ("rows", "cols")]
    kind = re.fullmatch(r"([0-9]*)[ucwsifdh]", str(content.get("dt", "d")))
    if kind is None:
        raise DataError(
            f"{where}: dt is {content.get('dt')!r}; one of OpenCV's types is needed, such as d.",
            culprits=[where],
        )
    if kind[1] and int(kind[1][:3]) > 1:
        shape.append(float(kind[1][:3]))
    if float(np.prod(shape)) != len(data) or any(it < 0 or it % 1 for it in shape):
        words = " x ".join(f"{it:g}" for it in shape)
        raise DataError(
            f"{where}: the matrix has {len(data)} numbers; {words} are needed.", culprits=[where]
        )
    return data.reshape([int(it) for it in shape])


def _list(value: object) -> list[object]:
    return value if isinstance(value, list) else [value]
