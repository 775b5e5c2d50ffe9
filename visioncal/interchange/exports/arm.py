"""Content of exported arms, and what a foreign format cannot hold of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from visioncal.core.choices import CONVENTIONS, Convention
from visioncal.core.errors import DataError
from visioncal.core.number_format import figure
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
    unexportable_functions,
    without_functions,
)

# Numbers of postures for the largest error, and for fitting constant links.
_POSTURES, _FITTED = 4000, 800
# Weight of the workspace relative to the measured ranges: links fitted to a small range alone would
# have large errors beyond it.
_WORKSPACE_WEIGHT = 0.1


@dataclass(frozen=True, eq=False)
class ArmContent:
    """Content for a format of arms."""

    nominal: Robot
    robot: Robot
    origin: str  # Where the result comes from, in one line.
    verdict: Verdict
    # Predicted standard deviation of a tool's position over the workspace; None where unknown.
    sigma_mm: WorkspaceSigma | None
    # Repeatable errors of the joints by their angles; None where none were found.
    functions: JointFunctions | None = None
    convention: Convention | None = None
    # The hash by which the driver recognises the arm, if stated.
    calibration_hash: str | None = None
    # Largest deflection of the flange under the arm's own weight [mm]; zero for a rigid arm.
    sag_mm: float = 0.0
    # Least and greatest reference temperature of its links [deg C], for an arm that drifts.
    cold_c: tuple[float, float] | None = None
    # Largest drift of its flange with temperature, in one posture of the session [mm].
    drift_mm: float = 0.0
    # The arm with fitted constant links, where the format cannot hold it as a whole, and the
    # remaining error in words.
    links: tuple[Robot, str] | None = None
    with_corrections: bool = False  # Whether the table of joint corrections is used with the links.

    @property
    def written(self) -> Robot:
        """The arm whose links and offsets are written."""
        return self.robot if self.links is None else self.links[0]

    @property
    def omitted(self) -> tuple[str, ...]:
        """Bending and thermal drift that no file holds, with their size."""
        omitted = []
        if self.sag_mm and self.links is None:
            omitted.append(
                "its joints bend under load, which has no place in it: this is the arm without "
                f"weight. Under its own it stands off by up to {self.sag_mm:.2g} mm (visioncal "
                "correct counts that)"
            )
        if self.cold_c is not None:
            low, high = (f"{value:.0f}" for value in self.cold_c)
            links = f"links at {low} deg C" if low == high else f"links at {low} to {high} deg C"
            omitted.append(
                "it drifts with its temperature, which has no place in it: this is the arm with "
                f"{links}. In one posture of the session its flange moved by up to "
                f"{self.drift_mm:.2g} mm as it warmed up (visioncal correct --temperatures counts "
                "that)"
            )
        return tuple(omitted)

    @property
    def notes(self) -> list[str]:
        """Comment lines: origin, quality, and what the arm belongs to."""
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
    def all_notes(self) -> list[str]:
        """Comment lines, with what links and offsets leave out."""
        return [*self.notes, *([self.left_out] if self.left_out else [])]

    @property
    def left_out_warnings(self) -> tuple[str, ...]:
        """What links and offsets leave out, as a warning."""
        return (f"{self.left_out}.",) if self.left_out else ()

    @property
    def nominal_table(self) -> DHTable:
        """Joint table of the nominal arm, whose free choices that of the calibrated arm keeps."""
        if "convention" in self.nominal.document:
            return table_from_document(self.nominal.document)
        return table_of(self.nominal, "standard")

    @property
    def table(self) -> DHTable:
        """Joint table of the calibrated arm; the default form has no parallel-axis singularity."""
        nominal, form = self.nominal_table, self.convention
        if form is None:
            form = "hayati" if parallel_axes(self.nominal).any() else nominal.convention
        return table_of(without_functions(self.written), form, like=nominal)

    @property
    def left_out(self) -> str:
        """What links and offsets alone leave out, with the resulting error; empty for nothing."""
        sag = ("its joints bend under its own weight, and under a load",) if self.sag_mm else ()
        missing = (*unexportable_functions(self.robot), *sag)
        if not missing:
            return ""
        text = f"what is not constant about its joints ({'; '.join(missing)}) has no place in it. "
        if not self.with_corrections:
            text += "Its links and offsets are those that leave the least of that"
            return text if self.links is None else f"{text}: {self.links[1]}"
        return (
            f"{text}The table of joint-corrections goes with it: a reader without that is off by "
            f"up to {joint_function_error_mm(self.written):.2g} mm{self.bending_error_words}"
        )

    @property
    def bending_error_words(self) -> str:
        """What links and joint corrections together leave of an arm that bends."""
        if self.links is None:
            return ""
        return (
            ". Its links hold what they can of how it bends under its own weight; with both that "
            f"leaves {self.links[1]}"
        )


@dataclass(frozen=True)
class ArmFormat(Format[ArmContent]):
    """A foreign format of arms."""

    # Everything; links and offsets only; or joint functions for use with such links.
    holds: Literal["all", "links", "functions"] = "all"


def select_arm(source: Source, selection: Selection, form: ArmFormat) -> ArmContent:
    """Selects the arm to export.

    Raises:
        DataError: The source has no calibrated arm, or an option does not apply to the format.
    """
    form.check(selection)
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
    nominal = source.robot if isinstance(source, Calibration) else None
    arm = source.arm if isinstance(source, Calibration) else None
    if not isinstance(source, Calibration) or nominal is None or arm is None or arm.robot is None:
        raise DataError(
            f"{form.name} writes the calibrated arm, and {why}.",
            culprits=[form.name],
            next_step=f"{step}.",
        )
    if form.holds == "functions" and not unexportable_functions(arm.robot):
        raise DataError(
            f"--to {form.name}: nothing was found of this arm's joints that is a function of "
            "their angles: there is nothing to correct.",
            culprits=[source.session_name],
            next_step="--to robot-urdf and --to robot-dh hold all of its links and offsets.",
        )
    if selection.convention is not None and selection.convention not in CONVENTIONS:
        raise DataError(
            f"There is no convention {selection.convention!r}; the names are "
            f"{', '.join(CONVENTIONS)}.",
            culprits=["--convention"],
        )
    sag_mm = _sag_mm(source)
    cold_c, drift_mm = None, 0.0
    if source.thermal is not None:
        reference_c = source.drift.reference_c
        cold_c = float(reference_c.min()), float(reference_c.max())
        drift_mm = max(point.drift_mm for point in source.thermal.course)
    with_functions = form.holds == "functions" or selection.with_corrections
    robot = arm.robot if with_functions else without_functions(arm.robot)
    loses = sag_mm > 0.0 or (not with_functions and bool(unexportable_functions(arm.robot)))
    links = (
        _fit_constant_links(source, robot, arm.measured) if form.holds != "all" and loses else None
    )
    return ArmContent(
        nominal,
        arm.robot,
        f"calibrated by visioncal from {source.session_name!r}, {source.created}",
        source.verdict,
        arm.workspace_sigma_mm,
        arm.functions,
        selection.convention,
        selection.calibration_hash,
        sag_mm,
        cold_c,
        drift_mm,
        links,
        with_functions,
    )


def _fit_constant_links(
    calibration: Calibration, robot: Robot, measured: Sequence[JointRange]
) -> tuple[Robot, str]:
    """Fits constant links to the calibrated arm; also says what error remains.

    They are fitted over its measured ranges, where these are known, and the workspace.
    """
    samples = [(postures(robot, 2 * _FITTED), _WORKSPACE_WEIGHT)]
    if measured:
        lower, upper = np.array([(joint.lower, joint.upper) for joint in measured]).T
        rng = np.random.default_rng(0)
        samples = [(rng.uniform(lower, upper, (2 * _FITTED, len(lower))), 1.0), *samples]
    # Half of the postures are fitted, the other half measures the remaining error.
    q = np.concatenate([angles[::2] for angles, _ in samples])
    weights = np.concatenate(
        [np.full(len(angles[::2]), weight / len(angles)) for angles, weight in samples]
    )
    fitted = fit_links(robot, q, calibration.standing(q), weights)
    errors = []
    for angles, _ in samples:
        poses = calibration.standing(angles[1::2]) - fitted.base_from_flange(angles[1::2])
        away_mm = 1e3 * np.linalg.norm(poses[:, :3, 3], axis=1)
        rms_mm, most_mm = float(np.sqrt(np.mean(away_mm**2))), float(away_mm.max())
        errors.append(f"{figure(rms_mm)} mm rms, {figure(most_mm)} mm at the most")
    places = ["where the arm was measured", "over the workspace"][-len(errors) :]
    return fitted, ", ".join(map(" ".join, zip(errors, places, strict=True)))


def _sag_mm(calibration: Calibration) -> float:
    """Largest deflection of the flange under the arm's own weight, over the workspace [mm]."""
    arm = calibration.calibrated_robot
    if arm is None or calibration.elastic is None:
        return 0.0
    q = postures(arm)
    deflections = calibration.standing(q)[:, :3, 3] - arm.base_from_flange(q)[:, :3, 3]
    return 1e3 * float(np.linalg.norm(deflections, axis=1).max())


def joint_function_error_mm(robot: Robot) -> float:
    """Largest flange error without gear ratios, eccentricity and harmonics [mm].

    Over random postures within the joints' limits, at most a turn from zero.
    """
    q = postures(robot, _POSTURES)
    differences = robot.base_from_flange(q) - without_functions(robot).base_from_flange(q)
    return 1e3 * float(np.linalg.norm(differences[:, :3, 3], axis=1).max())
