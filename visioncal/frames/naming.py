"""Transform names of tools and fixtures: `flange_from_gripper`, `base_from_jig_2`."""

import re
from typing import Literal, TypeAlias

from visioncal.core.errors import DataError

FrameKind: TypeAlias = Literal["tool", "fixture"]

PARENTS: dict[FrameKind, Literal["flange", "base"]] = {"tool": "flange", "fixture": "base"}
# Names of frames that every cell has.
_TAKEN = ("cell", "base", "flange", "cam", "target", "image", "instrument")
_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}", re.ASCII)


def transform_name(kind: FrameKind, name: str | None) -> str:
    """Transform name of a tool or a fixture, by the user's name for it or else the kind's.

    Raises:
        DataError: The name is invalid in a transform's name, or taken.
    """
    name = kind if name is None else name
    if not _NAME.fullmatch(name) or "_from_" in name:
        raise DataError(
            f"{name[:60]!r} cannot name a {kind}: up to 40 small letters, digits and _ are needed, "
            "a letter first.",
            culprits=[name[:60]],
            next_step=f"Give --name {kind}_2, or the like.",
        )
    if name in _TAKEN:
        raise DataError(
            f"{name!r} cannot name a {kind}: every cell has a frame of that name.",
            culprits=[name],
            next_step=f"Give --name {kind}_{name}, or the like.",
        )
    return f"{PARENTS[kind]}_from_{name}"
