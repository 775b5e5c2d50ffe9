"""What the report says: rows of ready text, made from a calibration, for the templates."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from datetime import datetime
from functools import cache
from importlib import metadata

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from visioncal.core.number_format import decimals_for, fixed, matched, percent, significant
from visioncal.core.types import FloatArray
from visioncal.present.facts import PLUS_MINUS, Fact, answering_solver, frame_words
from visioncal.present.report.advice import contradicts
from visioncal.present.words import joint_words, level_words, parameter_row, spring_words
from visioncal.results import (
    Calibration,
    Edge,
    NeedMet,
    Verdict,
    ViewResult,
)
from visioncal.results.compare import intrinsics_names
from visioncal.results.sections import ClockResult, PointResult
from visioncal.vision.camera import intrinsics

_DEPENDENCIES = ("numpy", "scipy", "opencv-contrib-python-headless", "pin", "rerun-sdk")
_MOUNTS = {
    "eye-in-hand": "the camera rides on the robot",
    "eye-to-hand": "the camera stands still and the robot carries the target",
    "instrument": "a measuring instrument stands still and reads what the robot carries",
}


@dataclass(frozen=True)
class EdgeCard:
    """One estimated transform, as text.

    Attributes:
        name: Its name, such as `flange_from_cam`.
        meaning: What it is, in words.
        sigma_mm: Standard deviation of its translation [mm].
        sigma_deg: Standard deviation of its rotation [deg]; empty where that was not measured.
        rows: The components with their deviations and units.
        matrix: The 4x4 matrix, to be copied.
    """

    name: str
    meaning: str
    sigma_mm: str
    sigma_deg: str
    rows: tuple[Fact, ...]
    matrix: str


def readable_time(created: str) -> str:
    """When something was computed, for people; it stands in ISO 8601."""
    try:
        time = datetime.fromisoformat(created)
    except ValueError:
        return created
    return f"{time:%Y-%m-%d %H:%M %Z}".strip()


def edge_card(name: str, edge: Edge) -> EdgeCard:
    """Writes a transform of some name, such as `flange_from_cam`, as text."""
    parent, _, child = name.partition("_from_")
    rotation = edge.matrix[:3, :3]
    # The perturbation is in the child's frame; the components are along the parent's axes.
    covariance_m2 = rotation @ edge.covariance[3:, 3:] @ rotation.T
    sigmas_mm = 1e3 * np.sqrt(np.clip(np.diag(covariance_m2), 0.0, None))
    translation_mm = 1e3 * edge.transform.translation
    rows = [
        Fact(axis, matched(value, sigma), f"{PLUS_MINUS} {_rounded(sigma)} mm")
        for axis, value, sigma in zip("xyz", translation_mm, sigmas_mm, strict=True)
    ]
    if edge.oriented:
        rows += _rotation_facts(edge)
    else:
        rows.append(Fact("rotation", "not measured", f"taken as that of {frame_words(parent)}"))
    return EdgeCard(
        name,
        f"The pose of {frame_words(child)} in the frame of {frame_words(parent)}.",
        _rounded(edge.sigma_mm),
        _rounded(edge.sigma_deg) if edge.oriented else "",
        tuple(rows),
        _matrix_text(edge.matrix),
    )


def _rotation_facts(edge: Edge) -> list[Fact]:
    sigma_axis_deg = edge.sigma_deg / np.sqrt(3.0)
    decimals = decimals_for(0.5 * np.deg2rad(sigma_axis_deg))
    rotation = edge.transform.rotation
    rotvec_deg = ", ".join(
        matched(value, sigma_axis_deg) for value in rotation.as_rotvec(degrees=True)
    )
    quaternion = ", ".join(fixed(value, decimals) for value in rotation.as_quat())
    return [
        Fact("rotation vector", f"[{rotvec_deg}]", "deg"),
        Fact("quaternion x, y, z, w", f"[{quaternion}]"),
    ]


def _rounded(sigma: float) -> str:
    return significant(sigma, 2)


def _matrix_text(matrix: FloatArray) -> str:
    rows = [", ".join(f"{value: .9f}" for value in row) for row in matrix]
    return "[[" + "],\n [".join(rows) + "]]"


def key_figures(calibration: Calibration) -> tuple[Fact, ...]:
    """The handful of figures that most readers come for."""
    edge = next(iter(calibration.edges.values()))
    sensor = "instrument" if calibration.mount == "instrument" else "camera"
    used = sum(view.used for view in calibration.views)
    facts = [
        Fact(f"{sensor} position, sigma", f"{_rounded(edge.sigma_mm)} mm"),
        Fact(f"{sensor} orientation, sigma", f"{_rounded(edge.sigma_deg)}\N{DEGREE SIGN}"),
        Fact(
            "held-out residual",
            f"{significant(calibration.validation.held_out.mm)} mm",
            ""
            if calibration.validation.held_out.deg is None
            else f"{significant(calibration.validation.held_out.deg)}\N{DEGREE SIGN}",
        ),
        Fact("views used", f"{used} of {len(calibration.views)}"),
    ]
    if calibration.rms.px is not None:
        facts.insert(3, Fact("reprojection, rms", f"{significant(calibration.rms.px)} px"))
    arm = calibration.arm
    if arm is not None and arm.workspace_sigma_mm is not None:
        sigma = f"{significant(arm.workspace_sigma_mm.median)} mm"
        facts.insert(2, Fact("all over the workspace, sigma", sigma))
    return (*need_facts(calibration.need, calibration.verdict), *facts)


def need_facts(met: NeedMet | None, verdict: Verdict) -> tuple[Fact, ...]:
    """What the task needs and how likely that is met, and what the result is good for."""
    facts = []
    if met is not None:
        both = ((met.need.mm, " mm"), (met.need.deg, "\N{DEGREE SIGN}"))
        asked = " and ".join(f"{value:g}{unit}" for value, unit in both if value is not None)
        facts.append(Fact(f"picks within {asked}", percent(met.probability)))
    if verdict.good_for_mm is not None:
        facts.append(
            Fact("good for tasks of", f"{significant(verdict.good_for_mm)} mm", "and more")
        )
    return tuple(facts)


def method_facts(calibration: Calibration) -> tuple[Fact, ...]:
    """How the result was obtained."""
    used = sum(view.used for view in calibration.views)
    facts = [
        Fact("mount", calibration.mount, _MOUNTS[calibration.mount]),
        Fact("views", f"{used} used of {len(calibration.views)}"),
    ]
    answer = answering_solver(calibration)
    if answer is not None:
        note = (
            "fit of both transforms, weighted by the noise"
            if answer == "joint"
            else "a closed form"
        )
        facts.append(Fact("solver", answer, note))
    if calibration.robot is not None:
        facts.append(Fact("robot model", str(calibration.robot.document.get("name", "given"))))
    if calibration.camera is not None:
        camera = calibration.camera.camera
        width, height = camera.resolution
        facts.append(Fact("camera", f"{camera.model}, {width} \N{MULTIPLICATION SIGN} {height} px"))
    if calibration.instrument is not None:
        read = f"it read {calibration.instrument.reads}"
        facts.append(Fact("instrument", calibration.instrument.words, read))
        facts += [_point_fact(it) for it in calibration.points]
    if calibration.clock is not None:
        facts += _clock_facts(calibration.clock)
    return tuple(facts)


def _clock_facts(clock: ClockResult) -> Iterator[Fact]:
    """How far the camera's clock is ahead of the robot's, and when an image's rows are taken."""
    ahead_ms = 1e3 * clock.camera_minus_robot_s
    if clock.sigma_s is None:
        yield Fact("camera's clock", f"{ahead_ms:+.4g} ms", "taken so: views at rest")
    else:
        sigma_ms = 1e3 * clock.sigma_s
        note = f"{PLUS_MINUS} {significant(sigma_ms)}, ahead of the robot's, by {clock.method}"
        yield Fact("camera's clock", f"{matched(ahead_ms, sigma_ms)} ms", note)
    shutter = clock.shutter
    if shutter is not None:
        sigma_ms = 1e3 * shutter.readout_sigma_s
        late = f"{matched(1e3 * shutter.readout_s, sigma_ms)} ms"
        note = f"{PLUS_MINUS} {significant(sigma_ms)}, from an image's first row to its last"
        yield Fact(f"{shutter.kind} shutter", late, note)


def _point_fact(point: PointResult) -> Fact:
    axis_mm = point.sigma_mm / np.sqrt(3.0)
    place = ", ".join(matched(1e3 * it, axis_mm) for it in (point.x_m, point.y_m, point.z_m))
    note = f"{PLUS_MINUS} {significant(point.sigma_mm)}, on the flange"
    return Fact(f"point {point.point}", f"[{place}] mm", note)


def lens_facts(calibration: Calibration) -> tuple[Fact, ...]:
    """The intrinsics, each with its standard deviation where it was estimated."""
    result = calibration.camera
    if result is None:
        return ()
    values = intrinsics(result.camera)
    names = intrinsics_names(result.camera)
    units = ["px"] * len(result.camera.matrix) + [""] * len(result.camera.distortion)
    if result.covariance is None or len(result.covariance) != len(values):
        shown = [f"{value:.2f}" for value in result.camera.matrix]
        shown += [f"{value:.5g}" for value in result.camera.distortion]
        return tuple(Fact(*it) for it in zip(names, shown, units, strict=True))
    sigmas = np.sqrt(np.clip(np.diag(result.covariance), 0.0, None))
    return tuple(
        Fact(name, matched(value, sigma), f"{PLUS_MINUS} {matched(sigma, sigma)} {unit}".strip())
        for name, value, sigma, unit in zip(names, values, sigmas, units, strict=True)
    )


def view_mark(view: ViewResult, outlying: Collection[int]) -> str:
    """What became of a view: `used`, `look` (at it), `left-out` or `rejected`."""
    if view.used:
        return "look" if view.view in outlying else "used"
    return "left-out" if contradicts(view) else "rejected"


def dependency_versions() -> tuple[Fact, ...]:
    """Versions of the libraries that compute the result, as installed here."""
    return tuple(Fact(name, metadata.version(name)) for name in _DEPENDENCIES)


def template(name: str) -> Template:
    """A template by its name, in which what is not given is an error."""
    return _environment().get_template(name)


@cache
def _environment() -> Environment:
    # It keeps the templates, which take longer to be compiled than a page to be made.
    found = Environment(
        loader=PackageLoader("visioncal", "present/report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    forms = (significant, joint_words, level_words, parameter_row, spring_words)
    found.filters |= {it.__name__: it for it in forms}
    return found
