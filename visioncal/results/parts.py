"""What a calibration is made of, beside its transforms, and how its verdict stands on disk."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from scipy.spatial.transform import RigidTransform

from visioncal.core.codec import DROPPED, INLINE, REST, WrittenForm
from visioncal.core.errors import DataError
from visioncal.core.types import Need
from visioncal.core.verdict import Finding, Remedy, Verdict, VerdictStatus
from visioncal.results.arm import ArmSections
from visioncal.results.edge import StoredPose
from visioncal.robot import Robot

# Of all results of a calibration.
SCHEMA: Literal[1] = 1


_OF_ROBOT = WrittenForm(
    lambda item: dict(item.document), lambda item, _: Robot.from_document(item) if item else None
)


def check_schema(document: Mapping[str, Any]) -> None:
    """Checks that a result is of the schema that this version reads.

    Raises:
        DataError: It is of another.
    """
    found = document.get("schema")
    if found != SCHEMA:
        is_newer = isinstance(found, int) and found > SCHEMA
        raise DataError(
            f"schema is {found!r}, this version reads {SCHEMA}.",
            culprits=["schema"],
            next_step="A newer visioncal reads it." if is_newer else "Calibrate the session again.",
        )


@dataclass(frozen=True)
class SessionForm:
    """The session that a result is of: its name, and the sha256 of its canonical content."""

    name: str
    sha256: str


@dataclass(frozen=True, eq=False)
class SolverResult:
    """What one solver made of the used views.

    Attributes:
        matrices: (4, 4) both edges by name.
        rms_mm: Scatter of the target's position over the used views [mm].
        rms_deg: Scatter of the target's orientation over the used views [deg]; None where places
            alone were read.
    """

    matrices: Annotated[Mapping[str, StoredPose], REST]
    rms_mm: float
    rms_deg: float | None = None

    @property
    def transforms(self) -> dict[str, RigidTransform]:
        """Both edges by name."""
        return {name: RigidTransform.from_matrix(matrix) for name, matrix in self.matrices.items()}


@dataclass(frozen=True, eq=False)
class RobotResult(ArmSections):
    """A robot of a whole cell, with what was found of its arm.

    Attributes:
        model: Its nominal model, where that is known.
    """

    model: Annotated[Robot | None, _OF_ROBOT, REST] = None


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

    need: Annotated[Need, INLINE]
    probability: float
    pairs: tuple[Picker, ...] = ()

    def of(self, camera: str, robot: str) -> "NeedMet":
        """What is said of one camera and robot; of those that are no pair, of all."""
        mine = [pair for pair in self.pairs if (pair.camera, pair.robot) == (camera, robot)]
        return NeedMet(self.need, mine[0].probability) if mine else self


@dataclass(frozen=True, kw_only=True)
class CauseForm:
    """What may be why a result is not good.

    Attributes:
        cause: What it is, as a short name that stays.
        probability: How likely it is.
        sentence: What it is, with its figures.
        without_it: What the result would be without it, in a sentence; absent where not computed.
        do: What to do about it, with a command where one does it.
    """

    cause: str
    probability: float
    sentence: str
    without_it: Annotated[str, DROPPED] = ""
    do: Annotated[str, DROPPED] = ""

    @classmethod
    def of(cls, found: Finding) -> "CauseForm":
        """Writes a finding that may be the cause."""
        return cls(
            cause=found.kind,
            probability=found.probability,
            sentence=found.words,
            without_it=found.without_it,
            do="" if found.do is None else str(found.do),
        )

    def finding(self, words: str) -> Finding:
        """Reads it, with the words of a reason that begins with its sentence."""
        step = Remedy(self.do) if self.do else None
        return Finding(
            self.cause, words, step, probability=self.probability, without_it=self.without_it
        )


@dataclass(frozen=True, kw_only=True)
class VerdictForm:
    """Whether a result can be trusted.

    Attributes:
        status: In one word.
        reasons: Why, in plain sentences.
        good_for_mm: The least need that it would be good for [mm]; absent where it is good for
            none.
        causes: What may be why it is not good, likeliest first.
        findings: The reasons one by one; absent in files of earlier versions.
    """

    status: VerdictStatus
    reasons: tuple[str, ...]
    good_for_mm: float | None = None
    causes: tuple[CauseForm, ...] = ()
    findings: tuple[Finding, ...] | None = None

    @classmethod
    def of(cls, verdict: Verdict) -> "VerdictForm":
        """Writes a verdict."""
        return cls(
            status=verdict.status,
            reasons=verdict.reasons,
            good_for_mm=verdict.good_for_mm,
            causes=tuple(map(CauseForm.of, verdict.causes)),
            findings=verdict.findings,
        )

    def verdict(self, _: str) -> Verdict:
        """Reads it."""
        found = tuple(self._earlier()) if self.findings is None else self.findings
        return Verdict(self.status, found, self.good_for_mm)

    def _earlier(self) -> Iterator[Finding]:
        """Findings of reasons and causes, of which a reason may begin with a cause's sentence."""
        causes = {cause.sentence: cause for cause in self.causes}
        for reason in self.reasons:
            begun = next((cause for cause in causes if reason.startswith(cause)), None)
            if begun is None:
                yield Finding("remark", reason)
            else:
                yield causes.pop(begun).finding(reason)
        yield from (cause.finding(sentence) for sentence, cause in causes.items())


StoredVerdict = Annotated[Verdict, WrittenForm(VerdictForm.of, VerdictForm.verdict, VerdictForm)]
