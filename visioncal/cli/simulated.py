"""Which options of `visioncal simulate` fit which kind of session."""

from collections.abc import Mapping
from typing import Literal, TypeAlias

import typer

from visioncal.core.errors import DataError

Read: TypeAlias = Literal["point", "points", "probe"]

# What a cell of one robot takes, whatever is recorded of it.
_SINGLE = frozenset(
    (
        *("mount", "views", "robot", "camera", "board", "robot_sigma_mm", "robot_sigma_mrad"),
        *("arm_sigma_mm", "arm_sigma_mrad", "wrong_views", "board_scale", "with_intrinsics"),
        *("images", "stiffness_knm", "payload_kg", "recording", "camera_moved_mm", "seed"),
    )
)
_ARM = frozenset(("robot_sigma_mm", "robot_sigma_mrad", "arm_sigma_mm", "arm_sigma_mrad"))
# What a whole cell takes along, which are kinds of their own without one.
_ALONG = frozenset(("instrument", "torques"))
_TAKES: Mapping[str, frozenset[str]] = {
    "": _SINGLE | {"touches", "second_board"},
    "sweep": _SINGLE | {"clock_offset_ms", "readout_ms"},
    "warm_up": _SINGLE | {"currents"},
    "cell": _ARM
    | _ALONG
    | {"views", "wrong_views", "images", "seed", "recording", "camera_moved_mm", "touches"},
    "instrument": _ARM | {"views", "robot", "stiffness_knm", "payload_kg", "seed"},
    "torques": frozenset(("robot", "payload_kg", "currents", "seed")),
}


def given_for(context: typer.Context) -> frozenset[str]:
    """The parameters that the user gave, all of which fit the kind of session asked for.

    Raises:
        DataError: Two kinds are asked for, or an option has no use for that kind.
    """
    sources = {name: context.get_parameter_source(name) for name in context.params}
    given = frozenset(name for name, it in sources.items() if it and it.name == "COMMANDLINE")
    kinds = [it for it in _TAKES if context.params.get(it)]
    if "cell" in kinds:
        kinds = [it for it in kinds if it not in _ALONG]
    if len(kinds) > 1:
        named = [_option(it) for it in kinds]
        raise DataError(
            f"{' and '.join(named)}: each makes a session of its own kind.",
            culprits=named,
            next_step="Give one of them, and make the others into folders of their own.",
        )
    kind = kinds[0] if kinds else ""
    takes = _TAKES[kind]
    if kind == "cell" and context.params.get("torques"):
        takes = takes | {"currents", "payload_kg"}
    for unfit in sorted(given - takes - {"folder", kind}):
        fit = [_option(it) for it, taken in _TAKES.items() if unfit in taken]
        raise DataError(
            f"{_option(unfit)} goes with {' or '.join(fit)}, not with {_option(kind)}.",
            culprits=[_option(unfit)],
            next_step="Leave it out."
            if kind != "cell"
            else "Leave it out; what a whole cell is made of is said by a file of your own.",
        )
    return given


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}" if name else "a plain cell of one robot"
