"""Joint motions, and the torques measured during them."""

from dataclasses import dataclass

from visioncal.core.types import FloatArray, IntArray, Mask


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Positions, speeds and accelerations of n joints at m times.

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
        """The samples of given rows."""
        return JointMotion(self.times_s[rows], self.q[rows], self.dq[rows], self.ddq[rows])


@dataclass(frozen=True, eq=False)
class Measured:
    """A motion, and the torques (m, n) of the joints measured during it [N m]."""

    motion: JointMotion
    torques_nm: FloatArray

    def __len__(self) -> int:
        return len(self.motion)

    def chosen(self, rows: slice | IntArray | Mask) -> "Measured":
        """The samples of given rows."""
        return Measured(self.motion.chosen(rows), self.torques_nm[rows])
