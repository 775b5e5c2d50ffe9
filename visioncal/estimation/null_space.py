"""Null space of an arm's parameters, in words: of any stops, and of given ones."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.number_format import listed
from visioncal.core.types import FloatArray
from visioncal.estimation.identifiability import LEAST_SHARE, Jacobians, right_vectors
from visioncal.estimation.parameters import Parameter
from visioncal.robot import Robot, parallel_axes

# Entries of a null direction below this share of its largest are rounding.
_NOTHING = 1e-6
# Least share of the largest for a parameter to be named, and most named.
_NAMED_SHARE, _MOST_NAMED = 0.5, 3
_WORDS = {
    "theta": "offset",
    "d": "length d",
    "a": "length a",
    "alpha": "twist alpha",
    "beta": "twist beta",
    "ratio": "gear ratio",
    "sine": "eccentricity (sine)",
    "cosine": "eccentricity (cosine)",
}


@dataclass(frozen=True, eq=False)
class Null:
    """Changes of a table's parameters that no stops of the arm can determine."""

    # (r, k) in reduced row echelon form: only a few parameters are nonzero in each.
    directions: FloatArray
    frames: FloatArray  # (12, r) compensating changes of the base frame and of the carried frame.


def null_of(jacobian: Jacobians) -> Null:
    """Null space of a table's parameters, by Jacobians at postures all over the workspace."""
    _, free = jacobian.free()
    sizes, vectors = right_vectors(free)
    directions = _echelon(vectors[sizes <= LEAST_SHARE * sizes[0]])
    frames = np.linalg.lstsq(jacobian.frames, jacobian.arm @ directions.T, rcond=LEAST_SHARE)[0]
    return Null(directions, np.asarray(frames))


def _echelon(rows: FloatArray) -> FloatArray:
    """Reduced row echelon form of (r, k) independent rows, largest pivots first."""
    rows = rows.copy()
    for pivot in range(len(rows)):
        magnitudes = np.abs(rows[pivot:])
        row, column = divmod(int(np.argmax(magnitudes)), magnitudes.shape[1])
        rows[[pivot, pivot + row]] = rows[[pivot + row, pivot]]
        rows[pivot] /= rows[pivot, column]
        others = np.arange(len(rows)) != pivot
        rows[others] -= np.outer(rows[others, column], rows[pivot])
    return np.where(np.abs(rows) < _NOTHING, 0.0, rows)


def imitated(numbers: Jacobians, arm: Jacobians, directions: FloatArray) -> FloatArray:
    """Least changes (k, n) of a table's parameters equivalent to (p, n) errors of the arm.

    The Jacobians by the parameters and by the arm's errors are at the same postures.
    """
    (_, by_numbers), (_, by_arm) = numbers.free(), arm.free()
    return np.asarray(np.linalg.lstsq(by_numbers, by_arm @ directions, rcond=LEAST_SHARE)[0])


def null_words(null: Null, parameters: Sequence[Parameter], robot: Robot) -> Iterator[str]:
    """Yields what no stops can determine, group by group of parameters."""
    for rows in _connected(null.directions):
        involved = np.flatnonzero(null.directions[rows].any(axis=0)).tolist()
        parameters_named = [parameters[index] for index in involved]
        if len(parameters_named) == 1:
            frame = _frame(null.frames[:, rows[0]])
            yield f"{_thing(parameters_named[0], robot)} cannot be separated from the {frame} frame"
        elif len(rows) < len(parameters_named) - 1:
            left = len(parameters_named) - len(rows)
            yield f"of {_listed(parameters_named, robot)} only {left} combinations are determined"
        elif _is_sum(null.directions[rows][:, involved], parameters_named):
            yield f"{_summed(parameters_named, robot)}: only their sum is determined"
        else:
            yield f"{_listed(parameters_named, robot)}: only one combination of them is determined"


def _connected(directions: FloatArray) -> Iterator[list[int]]:
    """Groups rows with parameters in common, in the order of their first parameters."""
    groups: list[tuple[list[int], set[int]]] = []
    for row, numbers in enumerate(directions):
        rows, columns = [row], set(np.flatnonzero(numbers).tolist())
        for group in [group for group in groups if group[1] & columns]:
            rows, columns = [*group[0], *rows], group[1] | columns
            groups.remove(group)
        groups.append((rows, columns))
    for rows, _ in sorted(groups, key=lambda pair: min(pair[1])):
        yield rows


def _is_sum(directions: FloatArray, named: Sequence[Parameter]) -> bool:
    """Whether the null directions preserve the sum of parameters of one kind."""
    is_one_kind = len({parameter.kind for parameter in named}) == 1
    return is_one_kind and bool(np.abs(directions.sum(axis=1)).max() < _NOTHING)


def _frame(frames: FloatArray) -> str:
    """The end of the arm whose frame compensates a change."""
    base, tool = np.linalg.norm(frames.reshape(2, 6), axis=1)
    return "tool" if tool > base else "base"


def _summed(named: Sequence[Parameter], robot: Robot) -> str:
    joints = [parameter.joint for parameter in named]
    numbers = ", ".join(str(joint + 1) for joint in joints)
    between = parallel_axes(robot)[joints[0] : joints[-1]]
    why = " (parallel axes)" if between.all() else ""
    return f"the {_plural(named[0])} of joints {numbers}{why}"


def _plural(parameter: Parameter) -> str:
    first, *rest = _WORDS[parameter.kind].split(" ")
    return " ".join([f"{first}s", *rest])


def _thing(parameter: Parameter, robot: Robot) -> str:
    return f"the {_WORDS[parameter.kind]} of {joint_words(parameter.joint, robot)}"


def joint_words(joint: int, robot: Robot) -> str:
    """A joint by its number and its name."""
    return f"joint {joint + 1} ({robot.joint_names[joint]})"


def _listed(named: Sequence[Parameter], robot: Robot) -> str:
    return listed([_thing(parameter, robot) for parameter in named])


def dominant_words(changes: FloatArray, parameters: Sequence[Parameter], robot: Robot) -> str:
    """Names the parameters with the largest (k, n) changes of a table, in units of their size."""
    sizes = np.linalg.norm(changes, axis=1)
    largest = np.argsort(-sizes, kind="stable")[:_MOST_NAMED].tolist()
    kept = sorted(index for index in largest if sizes[index] >= _NAMED_SHARE * sizes.max())
    words = [_thing(parameters[index], robot) for index in kept]
    return listed([*words, "others"] if len(words) < changes.shape[1] else words)
