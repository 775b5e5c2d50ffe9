"""Measured points of the cell with their covariance."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray
from visioncal.estimation.problem_parts import Noise
from visioncal.frames.touches import TouchRows, check_lengths, flange_poses, refuse_copies
from visioncal.results import Calibration, Edge, Frame, Verdict
from visioncal.robot import Robot

NO_TOOL = (
    "Find the tip with visioncal tcp first, and name its file with --tool; or say --tool none, "
    "where the controller's tool was active and the poses are of the tip itself."
)


@dataclass(frozen=True, eq=False)
class Tool:
    """Tool that points were touched with."""

    name: str  # The transform's name, as `flange_from_gripper`.
    edge: Edge  # The transform.
    oriented: bool  # Whether its rotation was measured.
    verdict: Verdict  # Its verdict.

    @classmethod
    def among(cls, frames: Mapping[str, Frame], source: str, name: str | None) -> "Tool":
        """Selects a tool among frames by its name or its transform's; the only one where None.

        Raises:
            DataError: There is none of that name, or no name is given and there is not one tool.
        """
        tools = {word: frame for word, frame in frames.items() if word.startswith("flange_from_")}
        if name is None and len(tools) == 1:
            name = next(iter(tools))
        if name is None or not tools:
            state = f"has {len(tools)} tools: {some_of(list(tools))}" if tools else "has no tool"
            raise DataError(
                f"{source} {state}; the one that the points were touched with is needed.",
                culprits=list(tools) or [source],
                next_step=f"Say --tool {next(iter(tools))}, or the like." if tools else NO_TOOL,
            )
        full = name if name in tools else f"flange_from_{name}"
        if full not in tools:
            raise DataError(
                f"{source} has no tool {name!r}; it has {some_of(list(tools))}.",
                culprits=[name],
                next_step=did_you_mean(full, tools),
            )
        frame = tools[full]
        return cls(full, frame.edge, frame.oriented, frame.verdict)


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """Measured points, n in all, with their covariance."""

    source: str  # What they were read from, for the record.
    labels: tuple[str, ...]  # (n,) the measurements' names, such as the rows' view numbers.
    places: tuple[str, ...]  # (n,) their rows, `touches.csv, line 3`; empty where there are none.
    names: tuple[str, ...]  # (n,) names of the points; empty where unknown.
    points: FloatArray  # (n, 3) in the base [m].
    independent: FloatArray  # (n, 3, 3) covariance of each by its independent errors [m^2].
    common: FloatArray  # (3 n, 3 n) covariance by common errors, such as the tip's [m^2].
    # (n, 3) unit directions in the base to where the tool came from; NaN where unknown.
    outward: FloatArray

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def scattered(self) -> FloatArray:
        """(n, 3, 3) covariance of the points relative to each other.

        The independent part and the common part about its mean: an equal shift of all points does
        not show in the residuals of a fit.
        """
        count = len(self)
        centring = np.kron(np.eye(count) - 1.0 / count, np.eye(3))
        uneven = (centring @ self.common @ centring).reshape(count, 3, count, 3)
        at = np.arange(count)
        return np.asarray(self.independent + uneven[at, :, at, :])

    def carried(self, by_points: FloatArray, noise_m: FloatArray) -> FloatArray:
        """(p, p) covariance of a result with the (n, p, 3) Jacobian `by_points` by each point.

        `noise_m` is the (n,) additional noise of each per axis [m].
        """
        independent = self.independent + noise_m[:, None, None] ** 2 * np.eye(3)
        jacobian = np.concatenate(list(by_points), axis=1)
        return np.asarray(jacobian @ (block_diag(*independent) + self.common) @ jacobian.T)


def touched_points(
    rows: TouchRows,
    tool: Tool | None,
    noise: Noise,
    robot: Robot | None = None,
    calibration: Calibration | None = None,
) -> MeasuredPoints:
    """Computes the touched points from the flange's poses and the tool.

    Without a tool, the poses are of the tip itself. `robot` is the model for joint angles where the
    calibration has none; `noise` is that of the flange, per axis.

    Raises:
        DataError: A row has no pose, or the same one as another.
    """
    if tool is None:
        # Positions suffice for the tip itself.
        poses, tip = rows.base_from_flange, np.zeros(3)
        known = np.isfinite(poses[:, :3, 3]).all(axis=1)
        missing = [rows.places[index] for index in np.flatnonzero(~known)]
        if missing:
            raise DataError(
                f"{some_of(missing)}: no position of the tip. With --tool none that is what the "
                "rows have to hold; joint angles lead to the flange alone.",
                culprits=missing,
                next_step="Fill in x_m, y_m, z_m, or name the tool with --tool.",
            )
        check_lengths(rows)
        covariance, axis = np.zeros((3, 3)), np.array([0.0, 0.0, 1.0])
    else:
        poses, tip = flange_poses(rows, robot, calibration), tool.edge.matrix[:3, 3]
        tool_rotation = tool.edge.matrix[:3, :3]
        covariance = tool_rotation @ tool.edge.covariance[3:, 3:] @ tool_rotation.T
        # A tool whose rotation was not measured points more or less along the flange's z.
        axis = tool_rotation[:, 2] if tool.oriented else np.array([0.0, 0.0, 1.0])
    refuse_copies(poses, rows.places)
    turns = poses[:, :3, :3]
    turn_sq, shift_sq = noise.robots[0] ** 2
    lever = shift_sq * np.eye(3) + turn_sq * skew(tip) @ skew(tip).T
    rotations = np.where(np.isfinite(turns), turns, np.eye(3))
    flat = np.concatenate(list(rotations), axis=0)
    return MeasuredPoints(
        rows.source,
        rows.labels,
        rows.places,
        tuple(point.strip() for point in rows.points),
        rotations @ tip + poses[:, :3, 3],
        rotations @ lever @ np.swapaxes(rotations, 1, 2),
        flat @ covariance @ flat.T,
        -(turns @ axis),
    )
