"""Parameters of a joint table that an arm's errors change."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.estimation.arm import LEVER_M
from visioncal.estimation.armmodel import ArmModel
from visioncal.robot import FUNCTION_NAMES, DHTable
from visioncal.robot.jacobians import ROW_NAMES, table_jacobian

_LENGTHS = ("d", "a")
_ROW = len(ROW_NAMES)


@dataclass(frozen=True)
class Parameter:
    """A free parameter of a joint table."""

    joint: int  # Its row, from 0.
    kind: str  # `theta`, `d`, `a`, `alpha`, `beta`, or `ratio`, `sine`, `cosine` of its function.
    link: int  # Its link: 0 for X_0, i for Z_i X_i.

    @property
    def is_length(self) -> bool:
        """Whether it is in metres."""
        return self.kind in _LENGTHS

    @property
    def name(self) -> str:
        """Its name with its unit."""
        if self.kind == "ratio":
            return self.kind
        return f"{self.kind}_{'m' if self.is_length else 'rad'}"

    @property
    def unit(self) -> float:
        """Equivalent of a radian."""
        return LEVER_M if self.is_length else 1.0

    @property
    def place(self) -> int:
        """Its index among the parameters of a row and its joint's function."""
        if self.kind in ROW_NAMES:
            return ROW_NAMES.index(self.kind)
        return _ROW + FUNCTION_NAMES.index(self.kind)

    def value(self, table: DHTable) -> float:
        """Its value [rad, m or 1]."""
        if self.place >= _ROW:
            return float(table.functions[self.joint, self.place - _ROW])
        if self.kind in ("theta", "d"):
            return float({"theta": table.theta_rad, "d": table.d_m}[self.kind][self.joint])
        across = {"a": table.a_m, "alpha": table.alpha_rad, "beta": table.beta_rad}
        return float(across[self.kind][self.link])


def free_parameters(model: ArmModel, table: DHTable) -> Iterator[Parameter]:
    """Yields the parameters of a table that a model's errors change, joint by joint."""
    placements, functions = model.changes(np.ones(len(model.values)))
    for joint in range(len(table)):
        link = joint if table.convention == "modified" else joint + 1
        if placements.any():
            yield Parameter(joint, "theta", joint + 1)
            # beta replaces d between parallel axes.
            if not table.parallel[joint + 1]:
                yield Parameter(joint, "d", joint + 1)
            yield Parameter(joint, "a", link)
            yield Parameter(joint, "alpha", link)
            if table.parallel[link]:
                yield Parameter(joint, "beta", link)
        elif functions[joint, 0]:
            yield Parameter(joint, "d" if table.prismatic[joint] else "theta", joint + 1)
        for place in range(1, len(FUNCTION_NAMES)):
            if functions[joint, place]:
                yield Parameter(joint, FUNCTION_NAMES[place], joint + 1)


def parameter_moves(model: ArmModel, table: DHTable, parameters: Sequence[Parameter]) -> FloatArray:
    """Jacobian (k, p) of a table's parameters by the arm's errors; `table_of(model.bare, ...)`.

    It is zero where the convention fixes a parameter and the base or the flange changes instead.
    """
    steps = [model.changes(row) for row in np.eye(len(model.values))]
    placements, functions = (np.array(pair) for pair in zip(*steps, strict=True))
    rows = table_jacobian(model.bare, table, placements, functions)
    moves = np.zeros((len(parameters), len(steps)))
    for row, parameter in enumerate(parameters):
        if parameter.place >= _ROW:
            moves[row] = functions[:, parameter.joint, parameter.place - _ROW]
        elif parameter.link:
            moves[row] = rows[:, parameter.link - 1, parameter.place]
    return moves
