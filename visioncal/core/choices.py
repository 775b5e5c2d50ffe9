"""Names to choose among, in files and in options; help lists them without waiting for numpy."""

from typing import Literal, TypeAlias

# The joint fit, or one of the closed forms.
SolverName: TypeAlias = Literal[
    "joint", "tsai", "park", "horaud", "daniilidis", "andreff", "shah", "li"
]
# What a recording keeps of the images of its session, beside their digests.
ImagesKept: TypeAlias = Literal["full", "thumbnail", "none"]
# How a table of joints is meant.
Convention: TypeAlias = Literal["standard", "modified", "hayati"]
CONVENTIONS: tuple[Convention, ...] = ("standard", "modified", "hayati")
