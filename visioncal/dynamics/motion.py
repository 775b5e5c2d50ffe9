"""Joint motions, and the torques measured during them."""

from dataclasses import dataclass

from visioncal.core.types import FloatArray, IntArray, Mask


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Positions, speeds and accelerations of n joints at m times."""

    times_s: FloatArray  # (m,) ascending [s].
    q: FloatArray  # (m, n) joint angles [rad].
    dq: FloatArray  # (m, n) their speeds [rad/s].
    ddq: FloatArray  # (m, n) their accelerations [rad/s^2].

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
