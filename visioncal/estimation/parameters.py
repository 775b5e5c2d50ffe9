"""Parameters of a joint table that an arm's errors change."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.transforms import LEVER_M
from visioncal.core.types import FloatArray
from visioncal.robot.arm_model import ArmModel
from visioncal.robot.chain import FUNCTION_NAMES
from visioncal.robot.conversion import table_of
from visioncal.robot.tables import DHTable

_LENGTHS = ("d", "a")
# Steps of differences [rad]: common normals of nearly parallel axes, which Hayati's form does
# without, run away with the inverse square of the angle.
_STEPS = {"hayati": 1e-7, "standard": 1e-9, "modified": 1e-9}


@dataclass(frozen=True)
class Parameter:
    """A free parameter of a joint table."""

    joint: int  # Its row, from 0.
    kind: str  # `theta`, `d`, `a`, `alpha`, `beta`, or `ratio`, `sine`, `cosine` of its function.
    link: int  # Its link: 0 for X_0, i for Z_i X_i.

    @property
    def is_length(self) -> bool:
        """Whether the parameter is in metres."""
        return self.kind in _LENGTHS

    @property
    def name(self) -> str:
        """Name of the parameter with its unit."""
        if self.kind == "ratio":
            return self.kind
        return f"{self.kind}_{'m' if self.is_length else 'rad'}"

    @property
    def unit(self) -> float:
        """The parameter's unit that compares with a radian."""
        return LEVER_M if self.is_length else 1.0

    def value(self, table: DHTable) -> float:
        """Value of the parameter [rad, m or 1]."""
        if self.kind in FUNCTION_NAMES:
            return float(table.functions[self.joint, FUNCTION_NAMES.index(self.kind)])
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


def parameter_moves(model: ArmModel, like: DHTable, parameters: Sequence[Parameter]) -> FloatArray:
    """Jacobian (k, p) of parameters of the arm's table by its errors, by central differences.

    It is zero where the convention fixes a parameter and the base or the flange changes instead.
    `like` is the nominal arm's table; see `table_of`.
    """
    step, moves = _STEPS[like.convention], np.zeros((len(parameters), len(model.values)))
    for at, row in enumerate(step * np.eye(len(model.values))):
        if not any(change.any() for change in model.changes(row)):
            continue
        ends = []
        for values in (model.values + row, model.values - row):
            # A description, and to read it, would take half of the time.
            chain = model.nominal.chain_with(*model.changes(values), model.harmonics)
            arm = replace(model.nominal, chain=chain)
            table = table_of(arm, like.convention, like=like)
            ends.append(np.array([parameter.value(table) for parameter in parameters]))
        moves[:, at] = (ends[0] - ends[1]) / (2.0 * step)
    return moves
