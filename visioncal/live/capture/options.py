"""How a session is recorded."""

from dataclasses import dataclass, field
from typing import Literal

from visioncal.core.choices import PLAN_ACCELERATION, PLAN_SPEED
from visioncal.core.errors import DataError

Keep = Literal["sharpest", "mean"]
# Nobody watches an arm at a faster pace with a hand on the stop button [rad/s].
FASTEST = 1.5


@dataclass(frozen=True)
class Stillness:
    """When arm and image count as still.

    Attributes:
        joint_speed: Of the fastest joint [rad/s].
        joint_rad: How far a joint may stand from where it stood when the rest began [rad].
        flange_m: The same for the flange [m]; well-kept arms repeat to it.
        flange_rad: And for its rotation [rad].
        image_px: How far the image may have moved since then [px].
        quiet_s: How long all of this must have held before the first frame that counts [s].
        patience_s: How long to wait for it [s].
    """

    joint_speed: float = 2e-3
    joint_rad: float = 5e-5
    flange_m: float = 3e-5
    flange_rad: float = 5e-5
    image_px: float = 0.15
    quiet_s: float = 0.3
    patience_s: float = 8.0


@dataclass(frozen=True)
class CaptureOptions:
    """How a session is recorded.

    Attributes:
        speed: Of the joint that turns farthest [rad/s].
        acceleration: Likewise [rad/s^2].
        frames: Frames a view.
        keep: Whether the sharpest of them is kept, or their mean.
        still: When arm and image count as still.
        single: Whether every frame is of another place, as in a folder of pictures: then one is
            taken as it comes.
        lost: After so many stops in a row without a view, the recording ends; 0 for never, where a
            person sees it and goes elsewhere.
    """

    speed: float = PLAN_SPEED
    acceleration: float = PLAN_ACCELERATION
    frames: int = 3
    keep: Keep = "sharpest"
    still: Stillness = field(default_factory=Stillness)
    single: bool = False
    lost: int = 3

    def __post_init__(self) -> None:
        if not 0.0 < self.speed <= FASTEST:
            raise DataError(
                f"--speed is {self.speed}; above 0 and up to {FASTEST} rad/s is possible.",
                culprits=["--speed"],
            )
        if self.acceleration <= 0.0 or self.frames < 1:
            raise DataError("recording: acceleration and frames must be above zero.")
