"""The rows of one robot and one camera, the edges that most of some rows agree on, and evidence.

Mistakes of a record pair its rows otherwise; see `undoing`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from scipy.special import gammaln

from visioncal.calibration.guess.fit import mounting_fits, robust_fits
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import stop_of
from visioncal.calibration.stages.readings import places_of_one_point
from visioncal.core.limits import FEWEST_COMPARED
from visioncal.core.transforms import invert, robot_part, rotation_angle
from visioncal.core.types import FloatArray, IntArray, Mask, Mount
from visioncal.vision.targets import corner_positions, rotation_transforms

# Least standard deviation by axis, without unit: digits of a table.
LEAST = 5e-4
# Share of the rows that a fit keeps, and its random starts: half of the rows may be wrong, and a
# few lose their partner.
_KEPT, _STARTS = 0.45, 40
# Neighbouring rows by which a fit starts, too: those of one end of the session may be right alone.
_WINDOW = 7
# Robots that stand still are within so much of where they stood [m], [rad], and what a camera sees
# of them within a share of the distance and an angle [rad].
_STILL_M, _STILL_RAD, _STILL_SEEN = 1e-3, 2e-3, 0.02
# Log-density of a wrong view's pose, over two radians and two distances by axis, with the prior
# probability of wrong views. Copies of poses differ by less.
_WRONG, _WIDTH, _SAME = float(np.log(0.05)), 3.0 * float(np.log(2.0)), 1e-9


@dataclass(frozen=True, eq=False)
class StopOfRobot:
    """A stop of a whole cell at which a robot's pose is known."""

    view: int  # Number of the first row there with its pose.
    pose: FloatArray  # (4, 4) `base_from_flange`.


@dataclass(frozen=True, eq=False)
class Record:
    """The poses of one robot and what one camera saw of one board, by row of the session.

    Or an instrument of its probe, which it sees as a fixed camera a board.
    """

    views: IntArray  # (n,) numbers of the session's rows.
    robot: FloatArray  # (n, 4, 4) the robot's part of the chain; NaN where unknown.
    mount: Mount
    rows: IntArray  # (m,) the rows that show the board.
    camera: FloatArray  # (m, c, 4, 4) `cam_from_target` with all rivals.
    marks: FloatArray  # (k, 3) corners of the board [m]; empty of several and of unknown ones.
    is_numbered: bool  # Whether the camera's poses are of corners, which have numbers.
    shows: str  # The name of what is beside a row's pose: its image or its reading.
    are_places: bool  # Whether only the places of a point were read, whose rotations mean nothing.

    @classmethod
    def of(cls, run: RunState, stops: Mapping[int, StopOfRobot] | None = None) -> Self:
        """The record of a run after the stage `pnp`, of one robot and one camera.

        `stops` are all of the robot in a whole cell, of which the run has those of one pair: rows
        are counted by them.
        """
        seen, session, read = run.poses_of_one_board, run.session, run.readings
        every = {view.number: view for view in session.views}
        if read is not None and len(read.names) > 1:
            # Rows of several points repeat the pose of their stop.
            of_point = places_of_one_point(read)
            every = {number: view for number, view in every.items() if number in of_point}
        known = {number: run.base_from_flange.get(number) for number in every}
        if stops and len({stop_of(view) for view in every.values()} & stops.keys()) == len(every):
            at_stop = {stop_of(view): number for number, view in every.items()}
            known = {at_stop.get(stop, of.view): of.pose for stop, of in stops.items()}
        views = [*known]
        robot = np.full((len(views), 4, 4), np.nan)
        rows, camera = [], list[FloatArray]()
        turns = {name: rotation_transforms(board) for name, board in session.boards.items()}
        excluded = run.held_back | run.spared.keys()
        for at, (view, pose) in enumerate(known.items()):
            if pose is not None:
                robot[at] = pose
            if view in seen and view in every and view not in excluded:
                board_turns = turns.get(session.board_of(every[view]), np.eye(4)[None])
                rows.append(at)
                camera.append((seen[view].cam_from_target[:, None] @ board_turns).reshape(-1, 4, 4))
        most = max(map(len, camera), default=0)
        padded = [poses[np.minimum(np.arange(most), len(poses) - 1)] for poses in camera]
        mount: Mount = run.mount or "eye-in-hand"
        mount = mount if read is None else "eye-to-hand"
        chain, shown = robot_part(robot, mount), np.array(rows, dtype=int)
        marks = corner_positions(*session.boards.values()) if len(turns) == 1 else np.zeros((0, 3))
        is_numbered = bool(run.corners) and len(marks) > 0
        shows, are_places = ("image", False) if read is None else ("reading", not read.are_poses)
        of_rows = np.array(views), chain, mount, shown, np.array(padded), marks, is_numbered
        return cls(*of_rows, shows, are_places)

    def paired(self, order: IntArray) -> IntArray:
        """(m,) the robot's row of each view that shows the board; -1 where it has no pose."""
        at = order[self.rows]
        return np.where((at >= 0) & np.isfinite(self.robot[at, 0, 0]), at, -1)

    @cached_property
    def copies(self) -> Mask:
        """(m,) views whose row repeats the robot's pose of the row before."""
        return _same_as_before(self.robot)[self.rows]

    @cached_property
    def lingering(self) -> Mask:
        """(m,) views that repeat the target's pose of the view before."""
        return _same_as_before(self.camera[:, 0])


def _distinct(robot: FloatArray, camera: FloatArray) -> IntArray:
    """Rows of (m, 4, 4) poses of both sides, one of each place at which neither moved.

    A robot of a cell may wait at one place while others move: its rows there agree whatever the
    edges are, and would be the half on which a robust fit stands. A grid separates places.
    """
    far_m = _STILL_SEEN * max(float(np.median(np.linalg.norm(camera[:, :3, 3], axis=1))), 1e-9)
    sides = ((robot, _STILL_M, _STILL_RAD), (camera, far_m, _STILL_SEEN))
    cells = [
        np.round(part.reshape(len(part), -1) / step)
        for poses, step_m, step_rad in sides
        for part, step in ((poses[:, :3, 3], step_m), (poses[:, :3, :3], step_rad))
    ]
    return np.sort(np.unique(np.hstack(cells), axis=0, return_index=True)[1])


def _same_as_before(poses: FloatArray) -> Mask:
    """(n,) mask of (n, 4, 4) poses that are the one before."""
    return np.append(False, np.abs(np.diff(poses, axis=0)).max(axis=(1, 2)) < _SAME)


@dataclass(frozen=True, eq=False)
class Edges:
    """Both edges by some pairing of the rows, and what they make of a record."""

    record: Record
    x: FloatArray
    z: FloatArray
    lever: float

    @classmethod
    def by(cls, record: Record, pairs: IntArray, among: Mask) -> Self | None:
        """The edges that most of some paired rows agree on; None with too few."""
        some = np.flatnonzero(among & (pairs >= 0))
        if len(some) < FEWEST_COMPARED:
            return None
        distinct = _distinct(record.robot[pairs[some]], record.camera[some, 0])
        some = some[distinct] if len(distinct) >= FEWEST_COMPARED else some
        robot, seen = record.robot[pairs[some]][None], record.camera[some, 0]
        if record.are_places:
            # Of a reading, the chain is that of the point on the flange.
            fit = mounting_fits(invert(robot), seen[:, :3, 3], _STARTS, _KEPT, _WINDOW)[0]
            return cls(record, fit.z, fit.x, fit.lever)
        fit = robust_fits(robot, seen[None], _STARTS, share=_KEPT)[0]
        return cls(record, fit.x, fit.z, fit.lever)

    def turned(self, pairs: IntArray) -> FloatArray:
        """(m, 4, 4) each view's target in the common one, by the nearest of its rivals."""
        placed, nearest, _ = self._nearest(pairs)
        return np.asarray(placed[np.arange(len(pairs)), nearest])

    def _nearest(self, pairs: IntArray) -> tuple[FloatArray, IntArray, FloatArray]:
        """(..., m, r, 4, 4) targets in the common one by r rivals, the nearest, and squares."""
        robot = self.record.robot[pairs][..., None, :, :]
        placed = invert(self.z) @ robot @ self.x @ self.record.camera
        squares = self.squares(placed)
        return placed, np.linalg.norm(squares, axis=-1).argmin(axis=-1), squares

    def squares(self, turned: FloatArray) -> FloatArray:
        """(..., 2) squared distances and angles without unit; (..., 1) distances of places."""
        shift = np.linalg.norm(turned[..., :3, 3], axis=-1) / self.lever
        if self.record.are_places:
            return np.asarray(shift[..., None] ** 2)
        return np.stack([shift, rotation_angle(turned)], axis=-1) ** 2

    def of(self, pairs: IntArray) -> FloatArray:
        """(..., m, 2) squares of pairings (..., m), (..., m, 1) of places; infinite without a pose.

        Many pairings at once take a fraction of the time of one by one.
        """
        _, nearest, squares = self._nearest(pairs)
        squares = np.take_along_axis(squares, nearest[..., None, None], axis=-2)[..., 0, :]
        return np.where(pairs[..., None] < 0, np.inf, squares)


def evidence(squares: FloatArray) -> tuple[FloatArray, Mask]:
    """Log marginal likelihoods of (k, m, 2) squares, and the (k, m) views that agree.

    The noise of positions and of rotations is integrated over (a Student distribution); the number
    of agreeing views is the likeliest, and both edges take six directions of each. Of (k, m, 1)
    squares of places alone they take nine.
    """
    count, sides = squares.shape[1:]
    order = np.argsort(squares.sum(axis=2), axis=1, kind="stable")
    sums = np.cumsum(np.take_along_axis(squares, order[..., None], 1) + 3.0 * LEAST**2, axis=1)
    agreeing = np.arange(FEWEST_COMPARED, count + 1)
    freedom = 3.0 * agreeing - (6.0 if sides == 2 else 9.0)
    by_level = gammaln(0.5 * freedom) - 0.5 * freedom * np.log(np.pi)
    logs = sides * by_level - 0.5 * freedom * np.log(sums[:, agreeing - 1]).sum(axis=2)
    logs += (_WRONG - sides * _WIDTH) * (count - agreeing)
    best = logs.argmax(axis=1)
    agrees = np.argsort(order, axis=1) < agreeing[best][:, None]
    return logs[np.arange(len(logs)), best], agrees
