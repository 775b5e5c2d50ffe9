"""What there is to export: a calibration's transforms with its frames, frames alone, or a cell."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import Mount
from visioncal.results import Calibration, CameraResult, Edge, Frame, FrameFile, Verdict

Source: TypeAlias = Calibration | FrameFile
Kind: TypeAlias = Literal["tool", "fixture"]

# The camera's or the instrument's transform.
HAND_EYE: Mapping[Mount, str] = {
    "eye-in-hand": "flange_from_cam",
    "eye-to-hand": "base_from_cam",
    "instrument": "base_from_instrument",
}
# The frame in which such a thing is placed, by our names: flange, flange_2, ...
_PARENTS: Mapping[Kind, re.Pattern[str]] = {
    "tool": re.compile(r"flange(_\w+)?", re.ASCII),
    "fixture": re.compile(r"base(_\w+)?", re.ASCII),
}
_WORST_FIRST = ("bad", "check", "good")
_COMMANDS: Mapping[Kind, str] = {"tool": "visioncal tcp", "fixture": "visioncal fixture"}


@dataclass(frozen=True, eq=False)
class Placement:
    """One transform of a source.

    Attributes:
        edge: `parent_from_child`.
        origin: Where it comes from, in one line.
        verdict: Whether to trust it.
        oriented: Whether its rotation was measured.
        turned_as: Whose rotation it has otherwise; empty for its parent's.
    """

    edge: Edge
    origin: str
    verdict: Verdict
    oriented: bool = True
    turned_as: str = ""


@dataclass(frozen=True, eq=False)
class Placements:
    """All transforms of a source, and what else is exported of it.

    Attributes:
        by_name: The transforms by name.
        frames: Which of them are tools' and fixtures' frames.
        words: What the source is, for messages.
        mount: How the camera is mounted; None where there is no calibration.
        lens: The camera, where there is one.
        cell: The result of the whole cell: it places any of its frames in any other.
        lenses: Its cameras by frame.
    """

    by_name: Mapping[str, Placement]
    frames: tuple[str, ...]
    words: str
    mount: Mount | None
    lens: CameraResult | None
    cell: Calibration | None = None
    lenses: Mapping[str, CameraResult] = field(default_factory=dict)

    def find(self, name: str) -> tuple[Placement, tuple[str, str]]:
        """Finds a transform by its name, with our names of its parent and child.

        Raises:
            DataError: There is none, or a robot's pose would be needed.
        """
        ends = ends_of(name)
        if name in self.by_name and all(ends):
            return self.by_name[name], ends
        if self.cell is not None and all(ends):
            return _between(self.cell, *ends), ends
        turned = f"{ends[1]}_from_{ends[0]}"
        hint = did_you_mean(name, self.by_name)
        if turned in self.by_name:
            hint = f"Ask for --edge {turned} --inverse."
        raise DataError(
            f"There is no transform {name!r}; {self.words} has {', '.join(self.by_name)}.",
            culprits=[name],
            next_step=hint,
        )

    def default(self) -> str:
        """Names the transform that is meant where none is named.

        Raises:
            DataError: The source has frames alone, and several.
        """
        if self.mount is not None:
            return HAND_EYE[self.mount]
        if len(self.frames) == 1 and self.cell is None:
            return self.frames[0]
        if self.cell is not None:
            known = list(self.cell.tree.parents)
            # No robot is between the ends of a transform that the cell itself has.
            example = next((name for name in self.by_name if "_from_cam" in name), "")
            example = example or list(self.by_name)[-1]
            raise DataError(
                f"{self.words.capitalize()} has {', '.join(known)}: which is meant is not said.",
                culprits=["--edge"],
                next_step=f"Name two of them, as --edge {example}; or all: --edge all.",
            )
        raise DataError(
            f"{self.words.capitalize()} has {', '.join(self.frames) or 'no frames'}: which one is "
            "meant is not said.",
            culprits=self.frames,
            next_step="Name one with --edge." if self.frames else "",
        )

    def only(self, kind: Kind) -> str:
        """Names the only tool or fixture.

        Raises:
            DataError: There is none, or there are several.
        """
        known = [frame for frame in self.frames if is_kind(frame, kind)]
        if len(known) == 1:
            return known[0]
        if known:
            raise DataError(
                f"{self.words.capitalize()} has {len(known)} {kind}s: {', '.join(known)}.",
                culprits=known,
                next_step="Name one with --edge.",
            )
        others = [name for name in self.by_name if is_kind(name, kind)]
        choose = f", or name another transform: --edge {others[0]}" if others else ""
        raise DataError(
            f"{self.words.capitalize()} has no {kind}; it has {', '.join(self.by_name)}.",
            next_step=f"Find one with {_COMMANDS[kind]}{choose}.",
        )


def ends_of(name: str) -> tuple[str, str]:
    """Gives our names of a transform's parent and child; empty where the name has none."""
    parent, _, child = name.partition("_from_")
    return parent, child


def is_kind(name: str, kind: Kind) -> bool:
    """Tells whether a transform places something on the flange, or in the base."""
    return _PARENTS[kind].fullmatch(ends_of(name)[0]) is not None


def placements(source: Source, camera: str | None = None) -> Placements:
    """Lists what a source has.

    Args:
        source: A calibration, or frames alone.
        camera: Which of a whole cell's cameras is meant: its name or its frame.

    Raises:
        DataError: There is no such camera, or the source is of one camera.
    """
    if isinstance(source, Calibration) and source.cell is not None:
        return _of_cell(source, source.cell.lenses, camera)
    if camera is not None:
        raise DataError(
            "Which camera is meant is said of a whole cell alone, and this is none.",
            culprits=["--camera"],
            next_step="Leave it out.",
        )
    frames = {name: _of_frame(frame) for name, frame in source.frames.items()}
    if isinstance(source, FrameFile):
        return Placements(frames, tuple(frames), "this file of frames", None, None)
    origin = f"calibrated by visioncal from {source.session_name!r}, {source.created}"
    edges = {
        name: Placement(edge, origin, source.verdict, edge.oriented)
        for name, edge in source.edges.items()
    }
    return Placements(
        {**edges, **frames}, tuple(frames), "this calibration", source.mount, source.camera
    )


def _of_cell(
    source: Calibration, lenses: Mapping[str, CameraResult], camera: str | None
) -> Placements:
    # The reference and the cell are one frame: without it, the tree would be in two.
    tree = source.tree
    edges = {
        f"{on}_from_{name}": _in_cell(source, tree.edge_of(name))
        for name, on in tree.parents.items()
        if name not in tree.flanges
    }
    lens = None
    if camera is not None or len(lenses) == 1:
        lens = lenses[_camera(lenses, camera)]
    frames = {name: _of_frame(frame) for name, frame in source.frames.items()}
    by_name = {**edges, **frames}
    return Placements(by_name, tuple(frames), "this cell", None, lens, source, lenses)


def _camera(lenses: Mapping[str, CameraResult], camera: str | None) -> str:
    known = list(lenses)
    if camera is None:
        return known[0]
    for frame in (camera, f"cam_{camera}"):
        if frame in lenses:
            return frame
    raise DataError(
        f"There is no camera {camera!r}; this cell has {', '.join(known) or 'none'}.",
        culprits=["--camera"],
        next_step=did_you_mean(camera, known),
    )


def _in_cell(source: Calibration, edge: Edge) -> Placement:
    origin = f"aligned by visioncal from {source.session_name!r}, {source.created}"
    return Placement(edge, origin, source.verdict)


def _between(source: Calibration, first: str, second: str) -> Placement:
    """Any frame in any other; trusted as the cell is, and the tool or the fixture that it has."""
    tree = source.tree
    whole = _in_cell(source, tree.between(first, second))
    for parent, frame in filter(None, (tree.placement(first), tree.placement(second))):
        if _WORST_FIRST.index(frame.verdict.status) < _WORST_FIRST.index(whole.verdict.status):
            whole = replace(whole, verdict=frame.verdict)
        origin = f"{whole.origin}; {_of_frame(frame).origin}"
        whole = replace(whole, origin=origin)
        if not frame.oriented:
            whole = replace(whole, oriented=False, turned_as=parent)
    return whole


def _of_frame(frame: Frame) -> Placement:
    origin = f"calibrated by visioncal from {frame.source!r}, {frame.created}: {frame.method}"
    return Placement(frame.edge, origin, frame.verdict, frame.oriented)
