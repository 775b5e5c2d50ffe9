"""What is known of a session so far; every step of the way adds to it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

from visioncal.calibration.pipeline.answer import Answer
from visioncal.calibration.pipeline.budget import Work, work_of
from visioncal.calibration.pipeline.solved import Solved
from visioncal.calibration.stages.arms import RobotArm
from visioncal.calibration.stages.cell import Cell
from visioncal.calibration.stages.findings import Findings
from visioncal.calibration.stages.observed import Observed
from visioncal.calibration.stages.readings import Readings
from visioncal.core.choices import Convention, SolverName
from visioncal.core.types import Corners, Mount
from visioncal.results import Verdict
from visioncal.robot import Loads
from visioncal.session.loads import loads_of
from visioncal.session.selecting import is_whole_cell

_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class RunState(Observed):
    """Everything that is known of a session at some point of the way.

    Attributes:
        solver: The solver asked for, where there are one robot and one camera.
        level: How far to go: a key of `stages.kinematics.ASKED`.
        convention: Of the joint table in which arms are given; None for the stated one.
        found_before: The corners in the images by view, where they were found before.
        readings: What an instrument read, where that is all that was observed.
        read: The cell as the session states it.
        fit: Its fit.
        answer: The fit with its covariance, and what speaks against it.
        findings: What the verdict is made of.
        verdict: Whether to trust it all.
    """

    solver: SolverName = "joint"
    level: str = "auto"
    convention: Convention | None = None
    found_before: Mapping[int, Corners] | None = None
    readings: Readings | None = None
    read: Cell | None = None
    fit: Solved | None = None
    answer: Answer | None = None
    findings: Findings | None = None
    verdict: Verdict | None = None

    @property
    def mount(self) -> Mount | None:
        """Where the camera of one camera and one robot is; None of a whole cell."""
        return None if is_whole_cell(self.session) else self.session.mount

    def loads(self, views: Sequence[int]) -> Loads:
        """What the flange carried at some views, and from which side the joints came."""
        rows = {view.number: view for view in self.session.views}
        return loads_of(
            [rows[view].numbers for view in views],
            [rows[view].text.get("approach", "") for view in views],
        )

    @property
    def cell(self) -> Cell:
        """The cell as the session states it.

        Raises:
            RuntimeError: A step asks for it before it was read: the order is wrong.
        """
        return _there(self.read, "the cell")

    @property
    def fitted(self) -> Solved:
        """The fit.

        Raises:
            RuntimeError: A step asks for it before it was made: the order is wrong.
        """
        return _there(self.fit, "the fit")

    @property
    def solved(self) -> Answer:
        """The answer.

        Raises:
            RuntimeError: A step asks for it before it was made: the order is wrong.
        """
        return _there(self.answer, "the answer")

    @cached_property
    def work(self) -> Work:
        """How well one camera and one robot place what they look at."""
        return work_of(self.fitted, self.solved.beside, self.solved.covariance)

    @property
    def robot_arm(self) -> RobotArm:
        """The only robot's arm, as far as it is calibrated."""
        return next(iter(self.fitted.arms.values()))

    @property
    def pixel_px(self) -> float | None:
        """Noise of a coordinate of the only camera's corners, as the fit has it [px]."""
        if self.fit is not None and self.fit.seen is not None:
            return self.fit.seen.sigmas_px[0]
        return super().pixel_px

    @property
    def used(self) -> tuple[int, ...]:
        """The views in the fit, in the session's order."""
        rows, used = self.fitted.cell.rows, self.fitted.agreed.used.tolist()
        return tuple(row.view for row, mine in zip(rows, used, strict=True) if mine)


def _there(value: _T | None, name: str) -> _T:
    """What an earlier step has made; without it, the steps are in a wrong order."""
    if value is None:
        raise RuntimeError(f"a step that needs {name} comes before it")
    return value
