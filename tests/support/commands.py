"""Runs commands, in this process where that will do, and writes the tables that they read."""

import csv
import io
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import Rotation
from typer.core import TyperGroup
from typer.main import get_command

from visioncal.cli import progress
from visioncal.cli.app import app, main
from visioncal.cli.lazy import LazyGroup
from visioncal.core.types import FloatArray
from visioncal.session.columns import POSE


@dataclass(frozen=True)
class Done:
    """How a command ended, and what it said."""

    status: int
    out: str
    err: str

    @property
    def said(self) -> str:
        """Results and messages, as a terminal shows them."""
        return self.out + self.err

    def good(self) -> Self:
        """Itself, which has to have ended well."""
        assert self.status == 0, self.said
        return self

    def refused(self, *words: str) -> Self:
        """Itself, which has to have ended with status 2 and a message that holds these words."""
        assert self.status == 2, self.said
        for expected in words:
            assert expected in self.err or expected in " ".join(self.err.split()), self.err
        return self


# A wide terminal, so that messages are not folded.
_WIDE = 300


def visioncal(*arguments: object, columns: int = _WIDE) -> Done:
    """Runs a command in this process."""
    out, err, status = io.StringIO(), io.StringIO(), 0
    words = ["visioncal", *map(str, arguments)]
    with (
        patch.object(sys, "argv", words),
        patch.dict(os.environ, {"COLUMNS": str(columns)}),
        # However long a machine takes, what a command says is the same.
        patch.object(progress, "PAUSE_S", 3600.0),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as stop:
            status = int(stop.code or 0)
    return Done(status, out.getvalue(), err.getvalue())


def every_command(group: Any = None, before: str = "") -> Iterator[tuple[str, Any]]:
    """All commands with their parameters, by the words that are typed for them."""
    group = group or get_command(app)
    for name, listed in group.commands.items():
        command = group.imported(name) if isinstance(group, LazyGroup) else listed
        if isinstance(command, TyperGroup):
            yield from every_command(command, f"{before}{name} ")
        else:
            yield f"{before}{name}", command


def write_poses(
    path: Path,
    poses: FloatArray,
    columns: dict[str, Sequence[object]] | None = None,
    names: Sequence[str] = POSE,
) -> Path:
    """Writes (n, 4, 4) poses as a table of touches, with other columns before them.

    Digits are those of a controller's: 0.1 um, and 1e-9 of a quaternion.
    """
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = [
        [*(f"{item:.7f}" for item in pose[:3, 3]), *(f"{item:.9f}" for item in turn)]
        for pose, turn in zip(poses, turns, strict=True)
    ]
    return write_table(path, names, rows, columns)


def write_table(
    path: Path,
    names: Sequence[str],
    rows: Sequence[Sequence[object]],
    columns: dict[str, Sequence[object]] | None = None,
) -> Path:
    more = columns or {}
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([*more, *names])
        for at, row in enumerate(rows):
            writer.writerow([*(group[at] for group in more.values()), *row])
    return path


def turned_poses(
    rng: np.random.Generator, tips: FloatArray, tip: FloatArray, above: FloatArray
) -> FloatArray:
    """Flange poses (n, 4, 4) that hold a tool's tip (3,) at (n, 3) points, tilted each its way.

    The flanges are above, by the z axis of a (3, 3) rotation, and point down.
    """
    lean = Rotation.from_rotvec(0.3 * rng.normal(size=(len(tips), 3)))
    turns = Rotation.from_matrix(above) * lean * Rotation.from_rotvec([np.pi, 0.0, 0.0])
    poses = np.tile(np.eye(4), (len(tips), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns.as_matrix(), tips - turns.apply(tip)
    return poses
