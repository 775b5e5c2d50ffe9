"""State of a pipeline run, to which each stage adds its results."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypedDict, TypeVar, Unpack

from visioncal.calibration.pipeline.assessment import FitAssessment
from visioncal.calibration.pipeline.budget import uncertainty_of
from visioncal.calibration.stages.arms import Arm
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.cell_fit import CellFit
from visioncal.calibration.stages.kinematics import check_level
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.readings import Readings
from visioncal.calibration.suspects.judged import Findings
from visioncal.core.choices import Convention, SolverName
from visioncal.core.errors import DataError
from visioncal.core.types import Corners, Mount, Progress
from visioncal.results import Verdict
from visioncal.results.sections import UncertaintyResult
from visioncal.session import Session

_T = TypeVar("_T")


class CalibrationOptions(TypedDict, total=False):
    """Options of `calibrate`, by name; the defaults are its own.

    With `pictures`, faint copies of the images are kept in `Run.searches`.
    """

    solver: SolverName
    level: str
    convention: Convention | None
    progress: Progress | None
    threads: int | None
    dense: bool
    pictures: bool


@dataclass(frozen=True, eq=False)
class RunState(Observed):
    """State of a run between two stages; None for results of stages still to come.

    The properties `cell`, `cell_fit` and `assessment` raise a RuntimeError before their stage has
    run.
    """

    solver: SolverName = "joint"  # The requested solver, for one robot and one camera.
    level: str = "auto"  # How far arms are calibrated: one of `robot.arm_model.LEVELS`.
    # Joint table convention of calibrated arms; None for the stated one.
    convention: Convention | None = None
    # Corners by view that were detected before this run.
    given_corners: Mapping[int, Corners] | None = None
    # The readings of an instrument, where these are all that was observed.
    readings: Readings | None = None
    cell_or_none: Cell | None = None  # The cell as the session states it.
    cell_fit_or_none: CellFit | None = None  # The fit of the cell.
    assessment_or_none: FitAssessment | None = None  # The fit with its covariance and diagnosis.
    findings: Findings | None = None  # Input of the verdict.
    verdict: Verdict | None = None  # The verdict on the result.

    @property
    def mount(self) -> Mount | None:
        """Mount of the camera, of one camera and one robot; None for a whole cell."""
        return self.session.mount if self.session.has_one_pair else None

    @property
    def cell(self) -> Cell:
        """The cell as the session states it."""
        return _required(self.cell_or_none, "the cell")

    @property
    def cell_fit(self) -> CellFit:
        """The fit of the cell."""
        return _required(self.cell_fit_or_none, "the fit")

    @property
    def assessment(self) -> FitAssessment:
        """The fit with its covariance and diagnosis."""
        return _required(self.assessment_or_none, "the answer")

    @cached_property
    def uncertainty(self) -> UncertaintyResult:
        """Uncertainty of one camera and one robot where their views look."""
        answer = self.assessment
        work = uncertainty_of(self.cell_fit, answer.ended)
        return replace(work, noise_95=answer.of_robot(answer.noise_95))

    @property
    def robot_arm(self) -> Arm:
        """The only robot's arm."""
        return next(iter(self.cell_fit.arms.values()))

    @property
    def pixel_px(self) -> float | None:
        """Standard deviation of a corner coordinate of the only camera, after the fit [px]."""
        sigmas_px = {} if self.cell_fit_or_none is None else self.cell_fit.fit.sigmas_px
        return next(iter(sigmas_px.values()), super().pixel_px)

    @property
    def used(self) -> tuple[int, ...]:
        """The views that the fit uses, in the session's order."""
        rows, used = self.cell_fit.cell.rows, self.cell_fit.inlier_fit.used.tolist()
        return tuple(row.view for row, is_used in zip(rows, used, strict=True) if is_used)


def _required(value: _T | None, name: str) -> _T:
    if value is None:
        raise RuntimeError(f"a stage that needs {name} comes before it")
    return value


def initial_state(session: Session | Path | str, **options: Unpack[CalibrationOptions]) -> RunState:
    """Loads the session and checks the options: the state before the first stage."""
    threads, solver = options.get("threads"), options.get("solver", "joint")
    if threads is not None and threads < 1:
        raise DataError(f"threads is {threads}, but must be at least 1.", culprits=["--threads"])
    check_level(options.get("level", "auto"))
    state = RunState(
        session if isinstance(session, Session) else Session.load(session),
        options.get("progress"),
        threads or 0,
        dense=options.get("dense", False),
        pictures=options.get("pictures", False),
        solver=solver,
        level=options.get("level", "auto"),
        convention=options.get("convention"),
    )
    if not state.session.has_one_pair and solver != "joint":
        raise DataError(
            f"solver {solver} is not for a whole cell, which takes the joint solver.",
            culprits=["--solver"],
            next_step="Leave it out, or calibrate one camera and robot of it (Session.of).",
        )
    return state
