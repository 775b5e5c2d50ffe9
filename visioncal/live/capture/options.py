"""Options of a recording."""

from dataclasses import dataclass, field

from visioncal.core.choices import PLAN_ACCELERATION, PLAN_SPEED
from visioncal.core.errors import DataError

# Fastest joint speed at which a person can watch with a hand on the stop button [rad/s].
FASTEST = 1.5


@dataclass(frozen=True)
class Stillness:
    """Limits within which arm and image count as still."""

    joint_speed: float = 2e-3  # Speed of the fastest joint [rad/s].
    joint_rad: float = 5e-5  # Motion of a joint since the rest began [rad].
    # Motion of the flange since then [m]; the repeatability of well-kept arms.
    flange_m: float = 3e-5
    flange_rad: float = 5e-5  # Rotation of the flange since then [rad].
    image_px: float = 0.15  # Motion of the image since then [px].
    # How long all of this must have held before the first frame that counts [s].
    quiet_s: float = 0.3
    patience_s: float = 8.0  # How long to wait for it [s].


@dataclass(frozen=True)
class CaptureOptions:
    """Options of a recording."""

    speed: float = PLAN_SPEED  # Speed of the joint that travels farthest [rad/s].
    acceleration: float = PLAN_ACCELERATION  # Its acceleration [rad/s^2].
    frames: int = 3  # Frames per view, of which the sharpest is kept.
    # Limits within which arm and image count as still.
    still: Stillness = field(default_factory=Stillness)
    # Number of stops in a row without a view that ends the recording; 0 for never, where a person
    # sees it.
    missed_in_a_row: int = 3

    def __post_init__(self) -> None:
        if not 0.0 < self.speed <= FASTEST:
            raise DataError(
                f"--speed is {self.speed}; above 0 and up to {FASTEST} rad/s is possible.",
                culprits=["--speed"],
            )
        if self.acceleration <= 0.0 or self.frames < 1:
            raise DataError("recording: acceleration and frames must be above zero.")
