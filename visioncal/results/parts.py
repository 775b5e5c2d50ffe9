"""Parts of a calibration beside its transforms, and the form of its verdict in files."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from scipy.spatial.transform import RigidTransform

from visioncal.core.choices import PoseForm
from visioncal.core.codec import DROPPED, INLINE, REST, WrittenForm
from visioncal.core.conventions import controller_form
from visioncal.core.types import Need
from visioncal.core.verdict import Finding, Verdict, VerdictStatus
from visioncal.results.arm import ArmSections
from visioncal.results.edge import StoredPose
from visioncal.robot import Robot

# Version of the form of calibration.json.
SCHEMA: Literal[2] = 2

_ROBOT_FORM = WrittenForm(
    lambda item: dict(item.document), lambda item, _: Robot.from_document(item) if item else None
)


@dataclass(frozen=True)
class SessionForm:
    """The session of a result: its name, and the sha256 of its canonical content."""

    name: str
    sha256: str


@dataclass(frozen=True, eq=False)
class SolverResult:
    """Result of one solver with the used views."""

    matrices: Annotated[Mapping[str, StoredPose], REST]  # (4, 4) both edges by name.
    rms_mm: float  # Scatter of the target's position over the used views [mm].
    # Scatter of its orientation [deg]; None where only positions were read.
    rms_deg: float | None = None

    @property
    def transforms(self) -> dict[str, RigidTransform]:
        """Both edges by name."""
        return {name: RigidTransform.from_matrix(matrix) for name, matrix in self.matrices.items()}


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot's nominal model and its maker's form of poses."""

    model: Annotated[Robot | None, _ROBOT_FORM, REST] = None  # The model, where known.
    form: str | None = None  # The form, a name among `POSE_FORMS`, where stated.

    @property
    def controller(self) -> PoseForm | None:
        """The stated form, or that of the model's maker; None where unknown; raises DataError."""
        return controller_form("" if self.model is None else self.model.name, self.form)


@dataclass(frozen=True, eq=False)
class RobotResult(ArmSections, RobotModel):
    """A robot of a whole cell, with the sections on its arm."""


@dataclass(frozen=True)
class Picker:
    """Probability that picks by one robot with one camera meet the need."""

    camera: str
    robot: str
    probability: float


@dataclass(frozen=True)
class NeedMet:
    """Required accuracy of picks, and the probability of meeting it."""

    need: Annotated[Need, INLINE]  # The required accuracy.
    probability: float  # Probability that a pick meets it; in a whole cell, of the worst pair.
    pairs: tuple[Picker, ...] = ()  # The pairs of camera and robot of a whole cell; else empty.

    def of(self, camera: str, robot: str) -> "NeedMet":
        """The probability of one camera and robot; of all where they are no pair."""
        matching_pairs = [
            pair for pair in self.pairs if (pair.camera, pair.robot) == (camera, robot)
        ]
        return NeedMet(self.need, matching_pairs[0].probability) if matching_pairs else self


@dataclass(frozen=True, kw_only=True)
class CauseForm:
    """Probable cause of a result that is not good."""

    cause: str  # Its short, stable name.
    probability: float  # Its probability.
    sentence: str  # Description with figures.
    # The result without this cause, in a sentence; absent where not computed.
    without_it: Annotated[str, DROPPED] = ""
    do: Annotated[str, DROPPED] = ""  # Remedy, with a command where there is one.

    @classmethod
    def of(cls, finding: Finding) -> "CauseForm":
        """Form of a finding that may be the cause."""
        return cls(
            cause=finding.kind,
            probability=finding.probability,
            sentence=finding.words,
            without_it=finding.without_it,
            do="" if finding.do is None else str(finding.do),
        )


# Causes derive from the findings, and are written for other readers.
_CAUSE_FORM = WrittenForm(CauseForm.of, lambda form, _: form, CauseForm)


@dataclass(frozen=True, kw_only=True)
class VerdictForm:
    """Verdict of a result."""

    status: VerdictStatus  # good, check or bad.
    reasons: tuple[str, ...]  # Its reasons, in sentences.
    # Smallest need that it would be good for [mm]; absent where there is none.
    good_for_mm: float | None = None
    # The same by the controller's own poses, where the arm was calibrated along; `good_for_mm` then
    # is for corrected targets.
    good_for_mm_uncorrected: float | None = None
    # Probable causes why it is not good, most probable first.
    causes: tuple[Annotated[Finding, _CAUSE_FORM], ...] = ()
    findings: tuple[Finding, ...] = ()  # The findings behind the reasons.

    def verdict(self, _: str) -> Verdict:
        """The verdict."""
        return Verdict(self.status, self.findings, self.good_for_mm, self.good_for_mm_uncorrected)


StoredVerdict = Annotated[
    Verdict, WrittenForm(lambda verdict: verdict, VerdictForm.verdict, VerdictForm)
]
