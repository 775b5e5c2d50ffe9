"""Points of the cell as they were measured, with what is known of their errors."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.transforms import skew
from visioncal.core.types import FloatArray
from visioncal.estimation.parts import Noise
from visioncal.frames.touches import TouchRows, check_lengths, flange_poses, refuse_copies
from visioncal.results import Calibration, Edge, Frame, Verdict
from visioncal.robot import Robot

NO_TOOL = (
    "Find the tip with visioncal tcp first, and name its file with --tool; or say --tool none, "
    "where the controller's tool was active and the poses are of the tip itself."
)


@dataclass(frozen=True, eq=False)
class Tool:
    """The tool that points were touched with.

    Attributes:
        name: The transform's, as `flange_from_gripper`.
        edge: That transform.
        oriented: Whether its rotation was measured.
        verdict: Whether to trust it.
    """

    name: str
    edge: Edge
    oriented: bool
    verdict: Verdict

    @classmethod
    def among(cls, frames: Mapping[str, Frame], source: str, name: str | None) -> "Tool":
        """Finds a tool among frames.

        Args:
            frames: By the transforms that place them.
            source: Where they stand, for messages.
            name: The tool's, or its transform's; the only tool where None.

        Raises:
            DataError: There is none of that name, or which one is meant is not said.
        """
        tools = {word: frame for word, frame in frames.items() if word.startswith("flange_from_")}
        if name is None and len(tools) == 1:
            name = next(iter(tools))
        if name is None or not tools:
            there = f"has {len(tools)} tools: {some_of(list(tools))}" if tools else "has no tool"
            raise DataError(
                f"{source} {there}; the one that the points were touched with is needed.",
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
    """n points, by whatever they were measured.

    Attributes:
        source: What they were read from, for the record.
        labels: (n,) the measurements' own names, such as the rows' view numbers.
        places: (n,) where each stands, `touches.csv, line 3`; empty where that says nothing.
        names: (n,) which point each is of; empty where nobody says.
        points: (n, 3) in the base [m].
        independent: (n, 3, 3) covariance of each by what is its own [m^2].
        common: (3 n, 3 n) covariance of all by what they share, such as the tip's [m^2].
        outward: (n, 3) unit directions in the base to where the tool came from; NaN where unknown.
    """

    source: str
    labels: tuple[str, ...]
    places: tuple[str, ...]
    names: tuple[str, ...]
    points: FloatArray
    independent: FloatArray
    common: FloatArray
    outward: FloatArray

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def scattered(self) -> FloatArray:
        """(n, 3, 3) covariance by which points scatter: their own, and what they share unevenly.

        What all share alike moves the whole set, and no fit to it shows that.
        """
        count = len(self)
        centring = np.kron(np.eye(count) - 1.0 / count, np.eye(3))
        uneven = (centring @ self.common @ centring).reshape(count, 3, count, 3)
        at = np.arange(count)
        return np.asarray(self.independent + uneven[at, :, at, :])

    def carried(self, by_points: FloatArray, noise_m: FloatArray) -> FloatArray:
        """Carries all that is known of the points' errors to an answer.

        Args:
            by_points: (n, p, 3) how the answer moves with each point.
            noise_m: (n,) noise of each per axis, beyond what is known [m].

        Returns:
            (p, p) the answer's covariance.
        """
        own = self.independent + noise_m[:, None, None] ** 2 * np.eye(3)
        slope = np.concatenate(list(by_points), axis=1)
        return np.asarray(slope @ (block_diag(*own) + self.common) @ slope.T)


def touched_points(
    rows: TouchRows,
    tool: Tool | None,
    noise: Noise,
    robot: Robot | None = None,
    calibration: Calibration | None = None,
) -> MeasuredPoints:
    """Finds where the tip was.

    Args:
        rows: The touches.
        tool: On the flange; None where the poses are of the tip itself.
        noise: Errors of the flange, per axis.
        robot: A model for joint angles, where the calibration has none; without a tool there is no
            use for one.
        calibration: What is known of the same robot.

    Raises:
        DataError: A row has no pose, or the same one as another.
    """
    if tool is None:
        poses, away = _tip_poses(rows), np.zeros(3)
        covariance, axis = np.zeros((3, 3)), np.array([0.0, 0.0, 1.0])
    else:
        poses, away = flange_poses(rows, robot, calibration), tool.edge.matrix[:3, 3]
        turn = tool.edge.matrix[:3, :3]
        covariance = turn @ tool.edge.covariance[3:, 3:] @ turn.T
        # A tool whose rotation was not measured points more or less along the flange's z.
        axis = turn[:, 2] if tool.oriented else np.array([0.0, 0.0, 1.0])
    refuse_copies(poses, rows.places)
    turns = poses[:, :3, :3]
    turn_sq, shift_sq = noise.robots[0] ** 2
    lever = shift_sq * np.eye(3) + turn_sq * skew(away) @ skew(away).T
    there = np.where(np.isfinite(turns), turns, np.eye(3))
    flat = np.concatenate(list(there), axis=0)
    return MeasuredPoints(
        rows.source,
        rows.labels,
        rows.places,
        tuple(point.strip() for point in rows.points),
        there @ away + poses[:, :3, 3],
        there @ lever @ np.swapaxes(there, 1, 2),
        flat @ covariance @ flat.T,
        -(turns @ axis),
    )


def _tip_poses(rows: TouchRows) -> FloatArray:
    """The poses (n, 4, 4) of the tip itself, of which positions are enough."""
    missing = [
        rows.places[index]
        for index in np.flatnonzero(~np.isfinite(rows.base_from_flange[:, :3, 3]).all(axis=1))
    ]
    if missing:
        raise DataError(
            f"{some_of(missing)}: no position of the tip. With --tool none that is what the rows "
            "have to hold; joint angles lead to the flange alone.",
            culprits=missing,
            next_step="Fill in x_m, y_m, z_m, or name the tool with --tool.",
        )
    check_lengths(rows)
    return rows.base_from_flange
