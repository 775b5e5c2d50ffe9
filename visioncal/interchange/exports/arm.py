"""What there is to export of a calibrated arm, and what a file of others cannot hold of it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from visioncal.core.choices import CONVENTIONS, Convention
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.estimation.workspace import postures
from visioncal.interchange.exports.content import Format, Selection
from visioncal.interchange.exports.sources import Source
from visioncal.results import Calibration, Verdict
from visioncal.results.arm import JointFunctions, JointRange, WorkspaceSigma
from visioncal.robot import (
    DHTable,
    Robot,
    fit_links,
    parallel_axes,
    table_from_document,
    table_of,
    unwritten,
    without_functions,
)

# Postures over which the worst error is looked for, and to which constant links are fitted.
_POSTURES, _FITTED = 4000, 800
# What all the workspace counts beside where the arm was measured: links that leave the least in a
# small box alone would lead far astray beyond it.
_ELSEWHERE = 0.1


@dataclass(frozen=True)
class LeftBehind:
    """How far constant links are off from the arm that was found: rms and at the most [mm]."""

    rms_mm: float
    most_mm: float

    @classmethod
    def of(cls, away: FloatArray) -> "LeftBehind":
        """Of (m, 3) distances [m]."""
        distances_mm = 1e3 * np.linalg.norm(away, axis=1)
        return cls(float(np.sqrt(np.mean(distances_mm**2))), float(distances_mm.max()))

    def __str__(self) -> str:
        return f"{figure(self.rms_mm)} mm rms, {figure(self.most_mm)} mm at the most"


@dataclass(frozen=True, eq=False)
class FittedLinks:
    """Links and offsets that leave the least of what a file cannot hold of an arm.

    Attributes:
        robot: The arm of these, with the functions that go with them.
        measured: What it leaves over the ranges in which joints stood at the stops; None where
            these are not known.
        workspace: The same all over the workspace.
    """

    robot: Robot
    measured: LeftBehind | None
    workspace: LeftBehind

    @property
    def words(self) -> str:
        """What it leaves behind."""
        if self.measured is None:
            return f"{self.workspace} over the workspace"
        return f"{self.measured} where the arm was measured, {self.workspace} over the workspace"


@dataclass(frozen=True, eq=False)
class ArmContent:
    """What a format of arms writes.

    Attributes:
        nominal: The arm as it was stated.
        robot: The arm as it was calibrated.
        origin: Where the result comes from, in one line.
        verdict: Whether it can be trusted.
        sigma_mm: Predicted standard deviation of a tool's place over the workspace;
            None where that is not known.
        functions: Repeatable errors of its joints by their angles; None where none were found.
        convention: In which form joints are tabulated, where that was said.
        calibration_hash: What marks the arm for its driver, where that was said.
        sag_mm: How far the flange of an arm whose joints bend stands off at the most under its own
            weight [mm]; zero for a rigid one.
        cold_c: Least and greatest temperature of its links [deg C], for one that drifts with it.
        drift_mm: How far that moved its flange at the most, in one posture of the session [mm].
        links: Links and offsets in which what a form cannot hold is as far as it can be; None where
            it holds all, or the arm stands for itself.
        with_corrections: Whether links and the table of joints' corrections go together.
    """

    nominal: Robot
    robot: Robot
    origin: str
    verdict: Verdict
    sigma_mm: WorkspaceSigma | None
    functions: JointFunctions | None = None
    convention: Convention | None = None
    calibration_hash: str | None = None
    sag_mm: float = 0.0
    cold_c: tuple[float, float] | None = None
    drift_mm: float = 0.0
    links: FittedLinks | None = None
    with_corrections: bool = False

    @property
    def written(self) -> Robot:
        """The arm whose links and offsets are written."""
        return self.robot if self.links is None else self.links.robot

    @property
    def omitted(self) -> tuple[str, ...]:
        """What no file holds of the arm, and what that costs."""
        return tuple(name for name in (self.sagging, self.drifting) if name)

    @property
    def sagging(self) -> str:
        """What no file holds of an arm whose joints bend, and what that costs; else empty."""
        if not self.sag_mm or self.links is not None:
            return ""
        return (
            "its joints bend under load, which has no place in it: this is the arm without weight. "
            f"Under its own it stands off by up to {self.sag_mm:.2g} mm (visioncal correct counts "
            "that)"
        )

    @property
    def drifting(self) -> str:
        """What no file holds of an arm that drifts with its temperature; else empty."""
        if self.cold_c is None:
            return ""
        low, high = (f"{value:.0f}" for value in self.cold_c)
        links = f"links at {low} deg C" if low == high else f"links at {low} to {high} deg C"
        return (
            "it drifts with its temperature, which has no place in it: this is the arm with "
            f"{links}. In one posture of the session its flange moved by up to {self.drift_mm:.2g} "
            "mm as it warmed up (visioncal correct --temperatures counts that)"
        )

    @property
    def notes(self) -> list[str]:
        """Lines for a comment: where it comes from, its quality, and what it goes with."""
        quality = f"verdict {self.verdict.status}"
        if self.sigma_mm is not None:
            median, high = self.sigma_mm.median, self.sigma_mm.p95
            quality += f"; sigma over the workspace {median:.2g} mm, at 95 % of it under {high:.2g}"
        return [
            self.origin,
            quality,
            f"{self.robot.name}, calibrated: base_from_flange, the pose of {self.robot.tip} in the "
            "base; the calibration's transforms go with this arm, not with the nominal one",
            *self.omitted,
        ]

    @property
    def nominal_table(self) -> DHTable:
        """The nominal arm as a table, whose choices a table of the calibrated one keeps."""
        if "convention" in self.nominal.document:
            return table_from_document(self.nominal.document)
        return table_of(self.nominal, "standard")

    @property
    def table(self) -> DHTable:
        """The calibrated arm as a table; where nothing was said, in a form that has no leaps."""
        nominal, form = self.nominal_table, self.convention
        if form is None:
            form = "hayati" if parallel_axes(self.nominal).any() else nominal.convention
        return table_of(without_functions(self.written), form, like=nominal)

    @property
    def left_out(self) -> str:
        """What links and offsets alone leave out, and what that costs; empty for nothing."""
        bending = ("its joints bend under its own weight, and under a load",) if self.sag_mm else ()
        missing = (*unwritten(self.robot), *bending)
        if not missing:
            return ""
        said = f"what is not constant about its joints ({'; '.join(missing)}) has no place in it. "
        if not self.with_corrections:
            said += "Its links and offsets are those that leave the least of that"
            return said if self.links is None else f"{said}: {self.links.words}"
        return (
            f"{said}The table of joint-corrections goes with it: a reader without that is off by "
            f"up to {omission_mm(self.written):.2g} mm{self.still_bent}"
        )

    @property
    def still_bent(self) -> str:
        """What links and the table of joints' corrections together leave of an arm that bends."""
        if self.links is None:
            return ""
        return (
            ". Its links hold what they can of how it bends under its own weight; with both that "
            f"leaves {self.links.words}"
        )


@dataclass(frozen=True)
class ArmFormat(Format[ArmContent]):
    """A form in which others read an arm.

    Attributes:
        holds: All that was found; links and offsets alone; or joints' functions beside such links.
    """

    holds: Literal["all", "links", "functions"] = "all"


def select_arm(source: Source, selection: Selection, form: ArmFormat) -> ArmContent:
    """Picks the arm that is to be exported.

    Args:
        source: A calibration.
        selection: What is asked for.
        form: The format that is to hold it.

    Raises:
        DataError: The source has no calibrated arm, or something was said for which the format
            has no use.
    """
    form.check(selection)
    nominal = source.robot if isinstance(source, Calibration) else None
    arm = source.arm if isinstance(source, Calibration) else None
    if not isinstance(source, Calibration) or nominal is None or arm is None or arm.robot is None:
        raise _without_arm(source, form)
    if form.holds == "functions" and not unwritten(arm.robot):
        raise DataError(
            f"--to {form.name}: nothing was found of this arm's joints that is a function of "
            "their angles: there is nothing to correct.",
            culprits=[source.session_name],
            next_step="--to robot-urdf and --to robot-dh hold all of its links and offsets.",
        )
    sag_mm = _sag_mm(source)
    together = form.holds == "functions" or selection.with_corrections
    robot = arm.robot if together else without_functions(arm.robot)
    loses = sag_mm > 0.0 or (not together and bool(unwritten(arm.robot)))
    links = _fitted(source, robot, arm.measured) if form.holds != "all" and loses else None
    return ArmContent(
        nominal,
        arm.robot,
        f"calibrated by visioncal from {source.session_name!r}, {source.created}",
        source.verdict,
        arm.workspace_sigma_mm,
        arm.functions,
        None if selection.convention is None else _convention(selection.convention),
        selection.calibration_hash,
        sag_mm,
        *_drift(source),
        links,
        together,
    )


def _fitted(calibration: Calibration, robot: Robot, measured: Sequence[JointRange]) -> FittedLinks:
    """Fits links to where the calibrated arm stands, where it was measured and all over."""
    drawn = [(postures(robot, 2 * _FITTED), _ELSEWHERE)]
    if measured:
        lower, upper = np.array([(joint.lower, joint.upper) for joint in measured]).T
        rng = np.random.default_rng(0)
        drawn = [(rng.uniform(lower, upper, (2 * _FITTED, len(lower))), 1.0), *drawn]
    # One half is fitted, the other one shows what that leaves.
    q = np.concatenate([array[::2] for array, _ in drawn])
    weights = np.concatenate(
        [np.full(len(array[::2]), share / len(array)) for array, share in drawn]
    )
    found = fit_links(robot, q, calibration.standing(q), weights)
    left = [
        LeftBehind.of(
            (calibration.standing(array[1::2]) - found.base_from_flange(array[1::2]))[:, :3, 3]
        )
        for array, _ in drawn
    ]
    return FittedLinks(found, left[0] if measured else None, left[-1])


def _sag_mm(calibration: Calibration) -> float:
    """How far the flange stands off under its own weight at worst, over the workspace [mm]."""
    arm = calibration.calibrated_robot
    if arm is None or calibration.elastic is None:
        return 0.0
    q = postures(arm)
    away = calibration.standing(q)[:, :3, 3] - arm.base_from_flange(q)[:, :3, 3]
    return 1e3 * float(np.linalg.norm(away, axis=1).max())


def _drift(calibration: Calibration) -> tuple[tuple[float, float] | None, float]:
    """Temperatures of the links to which the arm belongs, and how far it drifted from that [mm]."""
    if calibration.thermal is None:
        return None, 0.0
    model = calibration.drift
    cold_c = float(model.reference_c.min()), float(model.reference_c.max())
    return cold_c, max(point.drift_mm for point in calibration.thermal.course)


def omission_mm(robot: Robot) -> float:
    """How far the flange is off at worst without gear ratios, eccentricity and harmonics [mm].

    Over random postures within the joints' limits, at most a turn from zero.
    """
    q = postures(robot, _POSTURES)
    away = robot.base_from_flange(q) - without_functions(robot).base_from_flange(q)
    return LeftBehind.of(away[:, :3, 3]).most_mm


def _convention(name: str) -> Convention:
    if name in CONVENTIONS:
        return name
    raise DataError(
        f"There is no convention {name!r}; the names are {', '.join(CONVENTIONS)}.",
        culprits=["--convention"],
    )


def _without_arm(source: Source, form: ArmFormat) -> DataError:
    """Says why there is no calibrated arm, and how to get one."""
    if not isinstance(source, Calibration):
        why, step = "a file of frames has none", "Name the calibration instead"
    elif source.arm is not None:
        why = "this calibration kept the nominal one: no level of the arm's errors explained more"
        step = (
            "The nominal arm is what its own file says. For more than that, add stops all over the "
            "workspace and calibrate again"
        )
    else:
        why = "this calibration has none"
        step = (
            "Record q1_rad ... in views.csv, name [robot] model in session.toml, and run "
            "visioncal calibrate SESSION"
        )
    return DataError(
        f"{form.name} writes the calibrated arm, and {why}.",
        culprits=[form.name],
        next_step=f"{step}.",
    )
