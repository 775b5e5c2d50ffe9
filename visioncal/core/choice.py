"""Choice of one camera, robot and target of a whole cell."""

from dataclasses import dataclass
from functools import partial

from visioncal.core.options import option

camera_name = partial(option, "Of a whole cell: which camera, as left.", "--camera")
robot_name = partial(option, "Of a whole cell: which robot, as a.", "--robot")


@dataclass(frozen=True)
class Choice:
    """Names of a camera, a robot and a target; None for any.

    A name is that of the session's table, as `left`, or of the frame, as `cam_left`.
    """

    camera: str | None = camera_name()
    robot: str | None = robot_name()
    target: str | None = option("Of a whole cell: which target, as floor.")

    @property
    def is_any(self) -> bool:
        """Whether it has no names."""
        return self.camera is self.robot is self.target is None
