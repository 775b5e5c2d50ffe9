"""How an arm moved, and what its joints needed for it."""

from dataclasses import dataclass

from visioncal.core.types import FloatArray, IntArray, Mask


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Where n joints were at m times, and how they moved.

    Attributes:
        times_s: (m,) ascending [s].
        q: (m, n) joint angles [rad].
        dq: (m, n) their speeds [rad/s].
        ddq: (m, n) their accelerations [rad/s^2].
    """

    times_s: FloatArray
    q: FloatArray
    dq: FloatArray
    ddq: FloatArray

    def __len__(self) -> int:
        return len(self.times_s)

    def chosen(self, rows: slice | IntArray | Mask) -> "JointMotion":
        """Some of the samples."""
        return JointMotion(self.times_s[rows], self.q[rows], self.dq[rows], self.ddq[rows])


@dataclass(frozen=True, eq=False)
class Measured:
    """A motion, and the torques that were measured during it.

    Attributes:
        motion: How the arm moved.
        torques_nm: (m, n) of its joints [N m].
    """

    motion: JointMotion
    torques_nm: FloatArray

    def __len__(self) -> int:
        return len(self.motion)

    def chosen(self, rows: slice | IntArray | Mask) -> "Measured":
        """Some of the samples."""
        return Measured(self.motion.chosen(rows), self.torques_nm[rows])
