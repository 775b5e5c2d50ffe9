"""Closed-form hand-eye solvers: starts for the joint fit, and a second opinion on it.

`SOLVERS` holds those for general motion; `lone_axis` is for rotation about one axis. All take (m,
4, 4) robot poses `R_i` and `cam_from_target` poses `C_i` and solve `R_i @ X @ C_i = Z`; see
`closed_form.handeye`. Motion too poor to determine X gives a finite but poor solution here; it is
refused later, where the Fisher information is known.
"""

from collections.abc import Mapping
from types import MappingProxyType

from visioncal.estimation.closed_form.daniilidis import daniilidis
from visioncal.estimation.closed_form.handeye import HandEye, Solver
from visioncal.estimation.closed_form.horaud import horaud
from visioncal.estimation.closed_form.kronecker import andreff, li, shah
from visioncal.estimation.closed_form.lone_axis import lone_axis
from visioncal.estimation.closed_form.park import park
from visioncal.estimation.closed_form.tsai import tsai

SOLVERS: Mapping[str, Solver] = MappingProxyType(
    {
        "tsai": tsai,
        "park": park,
        "horaud": horaud,
        "daniilidis": daniilidis,
        "andreff": andreff,
        "shah": shah,
        "li": li,
    }
)

__all__ = ["SOLVERS", "HandEye", "Solver", "lone_axis"]
