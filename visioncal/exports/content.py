"""What is exported of a calibration: one transform with its frames, the lens, and their worth."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from visioncal.calibration import Calibration, CameraResult, Edge, VerdictStatus
from visioncal.errors import DataError
from visioncal.files import did_you_mean
from visioncal.transforms import adjoint, invert
from visioncal.types import FloatArray, Mount

# Such a name needs no quotes in YAML, XML, Python or a shell, and is no option of a command.
_FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_/.\-]*", re.ASCII)

# The camera's transform.
HAND_EYE: Mapping[Mount, str] = {"eye-in-hand": "flange_from_cam", "eye-to-hand": "base_from_cam"}


@dataclass(frozen=True)
class Selection:
    """What to export; what is None is left to the format.

    Attributes:
        edge: A transform of the calibration by name; None for the camera's.
        inverse: Whether its inverse is wanted.
        parent: What to call the frame in which the pose is given.
        child: What to call the frame whose pose it is; the camera, in a format of lenses.
    """

    edge: str | None = None
    inverse: bool = False
    parent: str | None = None
    child: str | None = None


@dataclass(frozen=True, eq=False)
class Content:
    """What a format writes.

    Attributes:
        name: Which transform of the calibration it is.
        edge: `parent_from_child`: its translation and rotation are the child's pose in the parent.
        parent: Name of the parent's frame, as its readers know it.
        child: Name of the child's frame likewise.
        frames: Our own names of parent and child.
        mount: How the camera is mounted.
        lens: The camera, where the calibration has one.
        origin: Where the result comes from, in one line.
        verdict: Whether the calibration can be trusted.
    """

    name: str
    edge: Edge
    parent: str
    child: str
    frames: tuple[str, str]
    mount: Mount
    lens: CameraResult | None
    origin: str
    verdict: VerdictStatus

    @property
    def matrix(self) -> FloatArray:
        """(4, 4) `parent_from_child` [m]."""
        return self.edge.matrix

    @property
    def worth(self) -> str:
        """The verdict and the sigma of the transform, in one line."""
        edge = self.edge
        return f"verdict {self.verdict}; sigma {edge.sigma_mm:.2g} mm and {edge.sigma_deg:.2g} deg"

    @property
    def direction(self) -> str:
        """What the transform does, in one line."""
        return f"{self.name}, the pose of {self.child} in {self.parent}: p_parent = R p_child + t"


def select(calibration: Calibration, selection: Selection, names: Mapping[str, str]) -> Content:
    """Picks what is to be exported.

    Args:
        calibration: The result.
        selection: What is asked for.
        names: What the format calls our frames, by our names.

    Raises:
        DataError: There is no such transform, or a frame's name cannot be written safely.
    """
    name = HAND_EYE[calibration.mount] if selection.edge is None else selection.edge
    edge, frames = _edge(calibration, name)
    if selection.inverse:
        edge, frames = _inverted(edge), (frames[1], frames[0])
        name = f"inverse of {name}"
    parent, child = (
        _frame(names.get(frame, frame) if chosen is None else chosen)
        for frame, chosen in zip(frames, (selection.parent, selection.child), strict=True)
    )
    if parent == child:
        raise DataError(
            f"parent and child are both named {parent!r}, but a transform joins two frames.",
            culprits=[parent],
            next_step="Give them different names with --parent and --child.",
        )
    return Content(
        name,
        edge,
        parent,
        child,
        frames,
        calibration.mount,
        calibration.camera,
        f"calibrated by visioncal from {calibration.session_name!r}, {calibration.created}",
        calibration.verdict.status,
    )


def _edge(calibration: Calibration, name: str) -> tuple[Edge, tuple[str, str]]:
    parent, _, child = name.partition("_from_")
    if name in calibration.edges and parent and child:
        return calibration.edges[name], (parent, child)
    turned = f"{child}_from_{parent}"
    hint = did_you_mean(name, calibration.edges)
    if turned in calibration.edges:
        hint = f"Ask for --edge {turned} --inverse."
    raise DataError(
        f"There is no transform {name!r}; this calibration has {', '.join(calibration.edges)}.",
        culprits=[name],
        next_step=hint,
    )


def _inverted(edge: Edge) -> Edge:
    # (T exp(x))^-1 = T^-1 exp(-adjoint(T) x): the lever arm turns rotation into translation.
    carried = adjoint(edge.matrix)
    return Edge(invert(edge.matrix), np.asarray(carried @ edge.covariance @ carried.T))


def _frame(name: str) -> str:
    if _FRAME.fullmatch(name):
        return name
    raise DataError(
        f"{name!r} cannot be a frame's name: letters, digits and _ / - . are needed, the first a "
        "letter, a digit or _.",
        culprits=[name],
        next_step="Choose other names with --parent and --child.",
    )
