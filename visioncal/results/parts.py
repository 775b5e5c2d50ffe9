"""What a calibration is made of, beside its transforms."""

from collections.abc import Mapping
from dataclasses import dataclass

from scipy.spatial.transform import RigidTransform

from visioncal.core.types import Camera, FloatArray, Need
from visioncal.results.arm import ArmSections
from visioncal.robot import Robot

# Why a view is in no fit although nothing is wrong with it.
HELD_BACK = "held out of the fit by the session (role = holdout)"


@dataclass(frozen=True, eq=False)
class SolverResult:
    """What one solver made of the used views.

    Attributes:
        matrices: (4, 4) both edges by name.
        rms_mm: Scatter of the target's position over the used views [mm].
        rms_deg: Scatter of the target's orientation over the used views [deg]; None where places
            alone were read.
    """

    matrices: Mapping[str, FloatArray]
    rms_mm: float
    rms_deg: float | None = None

    @property
    def transforms(self) -> dict[str, RigidTransform]:
        """Both edges by name."""
        return {name: RigidTransform.from_matrix(it) for name, it in self.matrices.items()}


@dataclass(frozen=True, eq=False)
class CameraResult:
    """The camera that the result was obtained with.

    Attributes:
        camera: The intrinsics.
        estimated: Whether they were estimated from this session's images.
        covariance: (k, k) of fx, fy, cx, cy and the distortion, where estimated.
        edge_covariance: (k, 6 e) of these with the calibration's edges in the order of its
            `joint_covariance`, where both were estimated together.
    """

    camera: Camera
    estimated: bool
    covariance: FloatArray | None = None
    edge_covariance: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class RobotResult(ArmSections):
    """A robot of a whole cell, with what was found of its arm.

    Attributes:
        model: Its nominal model, where that is known.
    """

    model: Robot | None = None


@dataclass(frozen=True)
class ViewResult:
    """What became of one view. A figure that could not be computed is None, and absent on disk.

    Attributes:
        view: The view's number.
        used: Whether the fit used it.
        reason: Why it was not used, in words; empty for a used view.
        corners: How many corners were found.
        rms_px: Reprojection error through the whole chain of frames [px].
        residual_mm: Distance of the target, as this view places it, from its mean place [mm].
        residual_deg: The same in rotation [deg].
    """

    view: int
    used: bool
    reason: str = ""
    corners: int | None = None
    rms_px: float | None = None
    residual_mm: float | None = None
    residual_deg: float | None = None


@dataclass(frozen=True)
class Rms:
    """Root mean square residuals.

    `deg` is None where an instrument read places alone, `px` where no image was used.
    """

    mm: float
    deg: float | None = None
    px: float | None = None


@dataclass(frozen=True)
class Validation:
    """Residuals of views that the fit had not seen.

    Attributes:
        method: How views were left out, in words.
        held_out: Their residuals, over all used views in turn.
        holdout: Residuals of the views that the session declares as `holdout`.
    """

    method: str
    held_out: Rms
    holdout: Rms | None = None


@dataclass(frozen=True)
class Picker:
    """How likely picks by one robot of what one camera sees land within what is needed."""

    camera: str
    robot: str
    probability: float


@dataclass(frozen=True)
class NeedMet:
    """What the task needs, and how likely a pick lands within it.

    Attributes:
        need: What it needs.
        probability: How likely a pick lands within it; of a whole cell, by the worst of its pairs.
        pairs: Each camera and robot of a whole cell that pick together; empty elsewhere.
    """

    need: Need
    probability: float
    pairs: tuple[Picker, ...] = ()

    def of(self, camera: str, robot: str) -> "NeedMet":
        """What is said of one camera and robot; of those that are no pair, of all."""
        mine = [it for it in self.pairs if (it.camera, it.robot) == (camera, robot)]
        return NeedMet(self.need, mine[0].probability) if mine else self
