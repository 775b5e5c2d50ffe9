"""Transforms that can be exported: of a calibration, a file of frames, or a cell."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import Mount
from visioncal.results import Calibration, CameraResult, Edge, Frame, FrameFile, Verdict
from visioncal.results.conditions import Condition

Source: TypeAlias = Calibration | FrameFile
Kind: TypeAlias = Literal["tool", "fixture"]

# Name of the camera's or the instrument's transform by its mount.
HAND_EYE: Mapping[Mount, str] = {
    "eye-in-hand": "flange_from_cam",
    "eye-to-hand": "base_from_cam",
    "instrument": "base_from_instrument",
}
# Parent frames by our names: flange, flange_2, ...
_PARENTS: Mapping[Kind, re.Pattern[str]] = {
    "tool": re.compile(r"flange(_\w+)?", re.ASCII),
    "fixture": re.compile(r"base(_\w+)?", re.ASCII),
}
WORST_FIRST = ("bad", "check", "good")
_COMMANDS: Mapping[Kind, str] = {"tool": "visioncal tcp", "fixture": "visioncal fixture"}


@dataclass(frozen=True, eq=False)
class Placement:
    """One transform of a source."""

    edge: Edge  # `parent_from_child`.
    origin: str
    verdict: Verdict
    oriented: bool = True  # Whether its rotation was measured.
    rotation_of: str = ""  # The frame whose rotation was copied otherwise; empty for its parent's.
    conditions: tuple[Condition, ...] = ()  # Under which it holds.


@dataclass(frozen=True, eq=False)
class Placements:
    """All transforms of a source, and its camera."""

    by_name: Mapping[str, Placement]
    frames: tuple[str, ...]  # Names of the tools' and fixtures' transforms.
    words: str  # The kind of source, for messages.
    mount: Mount | None  # How the camera is mounted; None where there is no calibration.
    lens: CameraResult | None
    # The result of a cell, which relates any two of its frames; None for other sources.
    cell: Calibration | None = None
    lenses: Mapping[str, CameraResult] = field(default_factory=dict)  # Its cameras by frame.

    def find(self, name: str) -> tuple[Placement, tuple[str, str]]:
        """Finds a transform by its name, with our names of its parent and child.

        Raises:
            DataError: There is none, or it depends on a robot's pose.
        """
        ends = ends_of(name)
        if name in self.by_name and all(ends):
            return self.by_name[name], ends
        if self.cell is not None and all(ends):
            return _between(self.cell, *ends), ends
        inverse = f"{ends[1]}_from_{ends[0]}"
        hint = did_you_mean(name, self.by_name)
        if inverse in self.by_name:
            hint = f"Ask for --edge {inverse} --inverse."
        raise DataError(
            f"There is no transform {name!r}; {self.words} has {', '.join(self.by_name)}.",
            culprits=[name],
            next_step=hint,
        )

    def default(self) -> str:
        """Name of the default transform.

        Raises:
            DataError: The source is a file of several frames, or a cell.
        """
        if self.mount is not None:
            return HAND_EYE[self.mount]
        if len(self.frames) == 1 and self.cell is None:
            return self.frames[0]
        if self.cell is not None:
            frames = list(self.cell.tree.parents)
            # Transforms of the cell itself never depend on a robot's pose.
            example = next((name for name in self.by_name if "_from_cam" in name), "")
            example = example or list(self.by_name)[-1]
            raise DataError(
                f"{self.words.capitalize()} has {', '.join(frames)}: which is meant is not said.",
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
        """Name of the only tool or fixture.

        Raises:
            DataError: There is none, or there are several.
        """
        names = [frame for frame in self.frames if is_kind(frame, kind)]
        if len(names) == 1:
            return names[0]
        if names:
            raise DataError(
                f"{self.words.capitalize()} has {len(names)} {kind}s: {', '.join(names)}.",
                culprits=names,
                next_step="Name one with --edge.",
            )
        others = [name for name in self.by_name if is_kind(name, kind)]
        choose = f", or name another transform: --edge {others[0]}" if others else ""
        raise DataError(
            f"{self.words.capitalize()} has no {kind}; it has {', '.join(self.by_name)}.",
            next_step=f"Find one with {_COMMANDS[kind]}{choose}.",
        )


def ends_of(name: str) -> tuple[str, str]:
    """Names of a transform's parent and child; empty where the name has none."""
    parent, _, child = name.partition("_from_")
    return parent, child


def is_kind(name: str, kind: Kind) -> bool:
    """Whether a transform is a pose on the flange, or in the base."""
    return _PARENTS[kind].fullmatch(ends_of(name)[0]) is not None


def placements(source: Source, camera: str | None = None) -> Placements:
    """Lists the transforms of a source; `camera` selects one of a cell, by name or frame.

    Raises:
        DataError: There is no such camera, or the source is no cell.
    """
    frames = {name: _of_frame(frame) for name, frame in source.frames.items()}
    cell = source.cell if isinstance(source, Calibration) else None
    if cell is None and camera is not None:
        raise DataError(
            "Which camera is meant is said of a whole cell alone, and this is none.",
            culprits=["--camera"],
            next_step="Leave it out.",
        )
    if isinstance(source, FrameFile):
        return Placements(frames, tuple(frames), "this file of frames", None, None)
    if cell is None:
        origin = f"calibrated by visioncal from {source.session_name!r}, {source.created}"
        holds = source.conditions
        edges = {
            name: Placement(edge, origin, source.verdict, edge.oriented, conditions=holds)
            for name, edge in source.edges.items()
        }
        by_name = edges | {name: replace(one, conditions=holds) for name, one in frames.items()}
        words = "this calibration"
        return Placements(by_name, tuple(frames), words, source.mount, source.camera)
    # The reference and the cell are one frame; two frames would split the tree.
    tree, lenses = source.tree, cell.lenses
    edges = {
        f"{parent}_from_{name}": _in_cell(source, tree.edge_of(name))
        for name, parent in tree.parents.items()
        if name not in tree.flanges
    }
    lens = next(iter(lenses.values())) if len(lenses) == 1 else None
    if camera is not None:
        frame = next((name for name in (camera, f"cam_{camera}") if name in lenses), None)
        if frame is None:
            raise DataError(
                f"There is no camera {camera!r}; this cell has {', '.join(lenses) or 'none'}.",
                culprits=["--camera"],
                next_step=did_you_mean(camera, list(lenses)),
            )
        lens = lenses[frame]
    return Placements(edges | frames, tuple(frames), "this cell", None, lens, source, lenses)


def _in_cell(source: Calibration, edge: Edge) -> Placement:
    origin = f"aligned by visioncal from {source.session_name!r}, {source.created}"
    return Placement(edge, origin, source.verdict, conditions=source.conditions)


def _between(source: Calibration, first: str, second: str) -> Placement:
    """Relates two frames of a cell, with the worst verdict of the cell and their placements."""
    tree = source.tree
    placement = _in_cell(source, tree.between(first, second))
    for parent, frame in filter(None, (tree.placement(first), tree.placement(second))):
        if WORST_FIRST.index(frame.verdict.status) < WORST_FIRST.index(placement.verdict.status):
            placement = replace(placement, verdict=frame.verdict)
        origin = f"{placement.origin}; {_of_frame(frame).origin}"
        placement = replace(placement, origin=origin)
        if not frame.oriented:
            placement = replace(placement, oriented=False, rotation_of=parent)
    return placement


def _of_frame(frame: Frame) -> Placement:
    origin = f"calibrated by visioncal from {frame.source!r}, {frame.created}: {frame.method}"
    return Placement(frame.edge, origin, frame.verdict, frame.oriented)
