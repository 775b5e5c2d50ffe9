"""The calibrated arm as a URDF, a DH table, UR's own file or JSON.

Parts of the arm that a format cannot hold are named in its comments and warnings.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from visioncal.core.choices import CONVENTIONS, Convention
from visioncal.core.errors import DataError
from visioncal.core.files import json_text
from visioncal.core.number_format import figure, known_name
from visioncal.core.transforms import log
from visioncal.dynamics import ArmDynamics, Identified
from visioncal.interchange.exports.content import Format, Selection, Source
from visioncal.results import Calibration
from visioncal.robot import Robot
from visioncal.robot.conversion import parallel_axes, table_of
from visioncal.robot.tables import DHTable, table_from_document
from visioncal.robot.workspace import postures
from visioncal.robot.writing import (
    corrected_tip,
    corrected_urdf,
    fit_links,
    small_urdf,
    table_toml,
    unexportable_functions,
    ur_flange,
    ur_kinematics_yaml,
    urdf_with_inertias,
    with_inertias,
    without_functions,
)

# Number of postures for fitting constant links.
_FITTED = 800


@dataclass(frozen=True, eq=False)
class ArmContent:
    """Content for a format of arms."""

    calibration: Calibration
    nominal: Robot
    robot: Robot
    convention: Convention | None = None
    # The hash by which the driver recognises the arm, if stated.
    calibration_hash: str | None = None
    # The arm with fitted constant links, where the format cannot hold it as a whole, and the
    # remaining error in words.
    links: tuple[Robot, str] | None = None

    @property
    def written(self) -> Robot:
        """The arm whose links and offsets are written."""
        return self.robot if self.links is None else self.links[0]

    @cached_property
    def omitted(self) -> tuple[str, ...]:
        """Parts of the arm that the file leaves out, with their sizes."""
        omitted, source, sag_mm = [], self.calibration, _sag_mm(self.calibration)
        if self.links is not None:
            missing = [*unexportable_functions(self.robot)]
            missing += ["its joints bend under its own weight, and under a load"] * bool(sag_mm)
            omitted.append(
                f"what is not constant about its joints ({'; '.join(missing)}) has no place in it. "
                f"Its links and offsets are those that leave the least of that: {self.links[1]}"
            )
        elif sag_mm:
            omitted.append(
                "its joints bend under load, which has no place in it: this is the arm without "
                f"weight. Under its own it stands off by up to {sag_mm:.2g} mm (visioncal correct "
                "counts that)"
            )
        if source.thermal is not None:
            cold_c = source.drift.reference_c
            low, high = (f"{value:.0f}" for value in (cold_c.min(), cold_c.max()))
            links = f"links at {low} deg C" if low == high else f"links at {low} to {high} deg C"
            drift_mm = max(point.drift_mm for point in source.thermal.course)
            omitted.append(
                "it drifts with its temperature, which has no place in it: this is the arm with "
                f"{links}. In one posture of the session its flange moved by up to {drift_mm:.2g} "
                "mm as it warmed up (visioncal correct --temperatures counts that)"
            )
        return tuple(omitted)

    @property
    def notes(self) -> list[str]:
        """Comment lines: origin, quality, what the arm belongs to, and what is left out."""
        source = self.calibration
        quality = f"verdict {source.verdict.status}"
        sigma_mm = None if source.arm is None else source.arm.workspace_sigma_mm
        if sigma_mm is not None:
            median, high = sigma_mm.median, sigma_mm.p95
            quality += f"; sigma over the workspace {median:.2g} mm, at 95 % of it under {high:.2g}"
        return [
            f"calibrated by visioncal from {source.session_name!r}, {source.created}",
            quality,
            f"{self.robot.name}, calibrated: base_from_flange, the pose of {self.robot.tip} in the "
            "base; the calibration's transforms go with this arm, not with the nominal one",
            *self.omitted,
        ]

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


@dataclass(frozen=True)
class ArmFormat(Format[ArmContent]):
    """A foreign format of arms."""

    links_alone: bool = True  # Whether it holds links and offsets, and no functions of joints.


def select_arm(source: Source, selection: Selection, form: ArmFormat) -> ArmContent:
    """Selects the arm to export; raises DataError."""
    form.check(selection)
    arm = source.arm if isinstance(source, Calibration) else None
    nominal = source.robot if isinstance(source, Calibration) else None
    if not isinstance(source, Calibration) or nominal is None or arm is None or arm.robot is None:
        raise DataError(
            f"{form.name} needs a calibrated arm, and this result has none.",
            culprits=[form.name],
            next_step="A calibration has one if its session has q1_rad ... and [robot] model, and "
            "stops all over the workspace show errors of the arm.",
        )
    convention: Convention | None = None
    if selection.convention is not None:
        convention = known_name("convention", selection.convention, CONVENTIONS, "--convention")
    links = None
    if form.links_alone and (unexportable_functions(arm.robot) or _sag_mm(source)):
        robot = without_functions(arm.robot)
        # They are fitted over its measured ranges, where these are known, and the workspace.
        # Postures all over the workspace, as a fit to the stops alone may have large errors beyond.
        samples = [(postures(robot, 2 * _FITTED), 0.1)]
        if arm.measured:
            lower, upper = np.array([(joint.lower, joint.upper) for joint in arm.measured]).T
            rng = np.random.default_rng(0)
            samples = [(rng.uniform(lower, upper, (2 * _FITTED, len(lower))), 1.0), *samples]
        # Half of the postures are fitted, the other half measures the remaining error.
        q = np.concatenate([angles[::2] for angles, _ in samples])
        weights = np.concatenate(
            [np.full(len(angles[::2]), weight / len(angles)) for angles, weight in samples]
        )
        fitted = fit_links(robot, q, source.standing(q), weights)
        errors = []
        for angles, _ in samples:
            poses = source.standing(angles[1::2]) - fitted.base_from_flange(angles[1::2])
            away_mm = 1e3 * np.linalg.norm(poses[:, :3, 3], axis=1)
            rms_mm, most_mm = float(np.sqrt(np.mean(away_mm**2))), float(away_mm.max())
            errors.append(f"{figure(rms_mm)} mm rms, {figure(most_mm)} mm at the most")
        places = ["where the arm was measured", "over the workspace"][-len(errors) :]
        links = fitted, ", ".join(map(" ".join, zip(errors, places, strict=True)))
    return ArmContent(source, nominal, arm.robot, convention, selection.calibration_hash, links)


def _sag_mm(calibration: Calibration) -> float:
    """Largest deflection of the flange under the arm's own weight, over the workspace [mm]."""
    arm = calibration.calibrated_robot
    if arm is None or calibration.elastic is None:
        return 0.0
    q = postures(arm)
    deflections = calibration.standing(q)[:, :3, 3] - arm.base_from_flange(q)[:, :3, 3]
    return 1e3 * float(np.linalg.norm(deflections, axis=1).max())


# Placeholder for an unknown hash, which no controller has.
_NO_HASH = "calib_visioncal"


def _write_urdf(content: ArmContent) -> str:
    if "urdf" in content.nominal.document:
        robot = without_functions(content.written)
        return corrected_urdf(content.nominal, robot, content.notes)
    return small_urdf(without_functions(content.written), content.notes)


def _warn_urdf(content: ArmContent) -> Iterator[str]:
    if "urdf" in content.nominal.document:
        tip = corrected_tip(content.nominal, content.written)
        if tip != content.robot.tip:
            yield (
                f"no fixed joint places {content.robot.tip}, so that the calibrated one is a link "
                f"of its own in the file: {tip}. Poses are of that."
            )


def _warn_ur(content: ArmContent) -> Iterator[str]:
    difference = log(ur_flange(content.written, content.nominal_table))
    turned = np.rad2deg(np.linalg.norm(difference[:3]))
    moved = 1e3 * np.linalg.norm(difference[3:])
    if max(turned, moved) > 1e-4:
        yield (
            f"the flange lies {moved:.2g} mm and {turned:.2g} deg from wrist_3, which has no field "
            "for that: a comment in the file has its pose. Parts on the flange go behind it."
        )
    if content.calibration_hash is None:
        yield (
            f"its hash is {_NO_HASH!r}, which no controller has: the driver will report that the "
            "calibration does not match, and go on. Give the one that ur_calibration extracts with "
            "--hash."
        )


ARMS = (
    ArmFormat(
        "robot-urdf",
        "the calibrated arm as a URDF: the session's own with other origins, or a small one "
        "[m, rad]",
        _write_urdf,
        warn=_warn_urdf,
    ),
    ArmFormat(
        "robot-dh",
        "the calibrated arm as a DH table (.toml), --convention standard, modified or hayati "
        "[m, rad]",
        lambda content: table_toml(content.table, content.notes),
        takes=frozenset({"convention"}),
    ),
    ArmFormat(
        "ur-kinematics",
        "the calibrated UR as ur_description's kinematics_params_file (YAML), --hash its hash "
        "[m, rad]",
        lambda content: ur_kinematics_yaml(
            without_functions(content.written),
            calibration_hash=content.calibration_hash or _NO_HASH,
            like=content.nominal_table,
            notes=content.notes,
        ),
        takes=frozenset({"calibration_hash"}),
        warn=_warn_ur,
    ),
    ArmFormat(
        "robot-json",
        "the calibrated arm with all that was found: 4x4 placements, axes, joints' functions "
        "[m, rad]",
        lambda content: json_text({**content.robot.document, "source": "; ".join(content.notes)}),
        links_alone=False,
    ),
)
# Formats that hold the inertias of an arm's links.
_OF_INERTIAS = ("robot-urdf", "robot-json")


def write_dynamics(identified: Identified, to: str, selection: Selection) -> str:
    """An arm with the identified inertias of its links, as `robot-urdf` or `robot-json`.

    Raises:
        DataError: The format holds no inertias, an option does not apply to it, or no inertias were
            identified.
    """
    if to not in _OF_INERTIAS:
        raise DataError(
            f"Identified dynamics are inertias of an arm's links, which {to} does not hold; "
            f"{' and '.join(_OF_INERTIAS)} do.",
            culprits=[to],
            next_step=f"visioncal export DYNAMICS --to {_OF_INERTIAS[0]}",
        )
    next(form for form in ARMS if form.name == to).check(selection)
    arm = ArmDynamics.of(identified)
    session = identified.facts["session"]["name"]
    notes = [f"dynamics identified by visioncal from {session!r}, {identified.facts['created']}"]
    if to == "robot-json":
        document = with_inertias(arm.robot.corrected(), arm.inertias).document
        return json_text({**document, "source": notes[0]})
    if "urdf" in arm.robot.document:
        return urdf_with_inertias(arm.robot, arm.inertias, notes)
    return small_urdf(arm.weighed(), notes)
