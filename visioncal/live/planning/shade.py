"""What stands between a camera and a board: declared boxes, and the arm itself."""

from dataclasses import dataclass

import numpy as np

from visioncal.core.types import FloatArray, IntArray, Mask
from visioncal.live.planning.cell import PlanCell
from visioncal.robot.batch import chain_frames
from visioncal.robot.bodies import Body, arm_bodies

# A line of sight may end on a box, as on the table that a board lies on: it is free up to here.
_LIES_ON, _TINY = 0.99, 1e-12


@dataclass(frozen=True, eq=False)
class Shade:
    """Lines of sight from the camera to points of the print, and what may stand in them.

    Attributes:
        cell: The cell, as it is guessed.
        points: (p, 3) the points of the print, in the target's frame [m].
        parts: The arm's bodies; not those on which camera or board are mounted, which are where
            they are in every posture.
    """

    cell: PlanCell
    points: FloatArray
    parts: tuple[Body, ...]

    @classmethod
    def of(cls, cell: PlanCell, points: FloatArray) -> "Shade":
        """Prepares the bodies of a cell."""
        parts = (body for body in arm_bodies(cell.robot) if body.link < cell.robot.joint_count)
        return cls(cell, points, tuple(parts))

    def behind_boxes(self, base_from_flange: FloatArray) -> IntArray:
        """Looks for boxes in the lines of sight.

        Args:
            base_from_flange: (k, 4, 4) poses [m].

        Returns:
            (k,) the place of a box that hides a part of the print; -1 where there is none.
        """
        starts, ends = self._lines(base_from_flange)
        found = np.full(len(base_from_flange), -1, dtype=np.int64)
        for place, box in enumerate(self.cell.boxes):
            found[_meet_box(starts, ends, box.base_from_box[None], box.size_m)] = place
        return found

    def behind_arm(self, q: FloatArray) -> IntArray:
        """Looks for the arm itself in the lines of sight.

        Args:
            q: (k, n) joint angles [rad].

        Returns:
            (k,) the place in `parts` of one that hides a part of the print; -1 where there is none.
        """
        chain = self.cell.robot.chain
        frames = chain_frames(chain, chain.effective(q))
        starts, ends = self._lines(frames[:, -1])
        found = np.full(len(q), -1, dtype=np.int64)
        for place, part in enumerate(self.parts):
            body = part.link_from_body[None]
            if part.link:
                body = frames[:, part.link - 1] @ body
            if part.shape == "box":
                hidden = _meet_box(starts, ends, body, part.size_m)
            else:
                hidden = _meet_tube(starts, ends, body, part.size_m)
            found[hidden] = place
        return found

    def _lines(self, base_from_flange: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Begins (k or 1, 1, 3) and ends (k or 1, p, 3) of the lines of sight, in the base [m]."""
        cell = self.cell
        in_hand = cell.mount == "eye-in-hand"
        base_from_cam = base_from_flange @ cell.x if in_hand else cell.x[None]
        base_from_target = cell.z[None] if in_hand else base_from_flange @ cell.z
        ends = self.points @ np.swapaxes(base_from_target[:, :3, :3], 1, 2)
        return base_from_cam[:, None, :3, 3], ends + base_from_target[:, None, :3, 3]


def _meet_box(
    starts: FloatArray, ends: FloatArray, base_from_box: FloatArray, size_m: FloatArray
) -> Mask:
    """Whether one of the lines (k, p) of a row meets a box at (k or 1, 4, 4)."""
    # A line meets a box where the spans in which it is between opposite faces overlap (Kay and
    # Kajiya 1986, slabs).
    rotation, middle = base_from_box[:, :3, :3], base_from_box[:, None, :3, 3]
    start, along = (starts - middle) @ rotation, (ends - starts) @ rotation
    along = np.where(along == 0.0, _TINY, along)
    faces = np.stack([(side * size_m - start) / along for side in (-0.5, 0.5)])
    enters, leaves = faces.min(axis=0).max(axis=-1), faces.max(axis=0).min(axis=-1)
    meets = (enters <= leaves) & (enters < _LIES_ON) & (leaves > 0.0)
    return np.asarray(meets.any(axis=1))


def _meet_tube(
    starts: FloatArray, ends: FloatArray, base_from_tube: FloatArray, size_m: FloatArray
) -> Mask:
    """Whether one of the lines (k, p) of a row meets a tube with round ends at (k or 1, 4, 4)."""
    # The nearest points of two lines (Ericson 2005, Real-Time Collision Detection, 5.1.9). A line
    # that begins inside is no line of sight: the camera is beside the tube, whose form is a rough
    # one.
    radius, length = size_m
    axis = length * base_from_tube[:, None, :3, 2]
    foot = base_from_tube[:, None, :3, 3] - 0.5 * axis
    along, apart = _LIES_ON * (ends - starts), starts - foot
    far, long = _dot(along, along), max(length**2, _TINY)
    both, by_line, by_axis = _dot(along, axis), _dot(along, apart), _dot(axis, apart)
    across = np.maximum(far * long - both**2, _TINY * far * long)
    at_line = np.clip((both * by_axis - by_line * long) / across, 0.0, 1.0)
    at_axis = np.clip((both * at_line + by_axis) / long, 0.0, 1.0)
    at_line = np.clip((both * at_axis - by_line) / far, 0.0, 1.0)
    between = apart + at_line[..., None] * along - at_axis[..., None] * axis
    inside = apart - np.clip(by_axis / long, 0.0, 1.0)[..., None] * axis
    meets = (_dot(between, between) < radius**2) & (_dot(inside, inside) > radius**2)
    return np.asarray(meets.any(axis=1))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(np.sum(a * b, axis=-1))
