"""What the report says: rows of ready text, made from a calibration."""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata

import numpy as np

from visioncal.calibration import Calibration, CameraResult, Edge, Rms, SolverResult, ViewResult
from visioncal.report.numbers import decimals_for, matched, significant
from visioncal.transforms import pose_difference
from visioncal.types import FloatArray

_DEPENDENCIES = ("numpy", "scipy", "opencv-contrib-python-headless", "pin", "rerun-sdk")

_HEADLINES = {
    "good": "Good: ready to use",
    "check": "Check: usable once the points below are settled",
    "bad": "Bad: do not use this result",
}


@dataclass(frozen=True)
class Fact:
    """A labelled figure or phrase."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class EdgeCard:
    """One estimated transform, as text.

    Attributes:
        name: Its name, such as `flange_from_cam`.
        meaning: What it is, in words.
        sigma_mm: Standard deviation of its translation [mm].
        sigma_deg: Standard deviation of its rotation [deg].
        rows: The components with their deviations and units.
        matrix: The 4x4 matrix, to be copied.
    """

    name: str
    meaning: str
    sigma_mm: str
    sigma_deg: str
    rows: tuple[Fact, ...]
    matrix: str


@dataclass(frozen=True)
class SolverRow:
    """One solver: its residuals, and how far each of its edges is from the result's."""

    name: str
    rms_mm: str
    rms_deg: str
    differences: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class ViewRow:
    """One view, as text."""

    number: int
    used: bool
    reason: str
    corners: str
    px: str
    mm: str
    deg: str


@dataclass(frozen=True)
class ResidualRow:
    """Root mean square residuals of one set of views, as text."""

    label: str
    mm: str
    deg: str
    px: str


def headline(calibration: Calibration) -> str:
    """The verdict in a few words."""
    return _HEADLINES[calibration.verdict.status]


def edge_cards(calibration: Calibration) -> tuple[EdgeCard, ...]:
    """The estimated transforms, the wanted one first."""
    return tuple(_edge_card(name, edge) for name, edge in calibration.edges.items())


def _edge_card(name: str, edge: Edge) -> EdgeCard:
    parent, _, child = name.partition("_from_")
    rotation = edge.transform.rotation.as_matrix()
    # The perturbation is in the child's frame; the components are along the parent's axes.
    covariance_m2 = rotation @ edge.covariance[3:, 3:] @ rotation.T
    sigmas_mm = 1e3 * np.sqrt(np.clip(np.diag(covariance_m2), 0.0, None))
    translation_mm = 1e3 * edge.transform.translation
    sigma_axis_deg = edge.sigma_deg / np.sqrt(3.0)
    quaternion_decimals = decimals_for(0.5 * np.deg2rad(sigma_axis_deg))
    rows = [
        Fact(axis, matched(value, sigma), f"\N{PLUS-MINUS SIGN} {_rounded(sigma)} mm")
        for axis, value, sigma in zip("xyz", translation_mm, sigmas_mm, strict=True)
    ]
    rotvec_deg = edge.transform.rotation.as_rotvec(degrees=True)
    rows += [
        Fact(
            "rotation vector",
            "[" + ", ".join(matched(value, sigma_axis_deg) for value in rotvec_deg) + "]",
            "deg",
        ),
        Fact(
            "quaternion x, y, z, w",
            "["
            + ", ".join(
                f"{value:.{quaternion_decimals}f}" for value in edge.transform.rotation.as_quat()
            )
            + "]",
        ),
    ]
    return EdgeCard(
        name,
        f"The pose of {_words(child)} in the frame of {_words(parent)}.",
        _rounded(edge.sigma_mm),
        _rounded(edge.sigma_deg),
        tuple(rows),
        _matrix_text(edge.transform.as_matrix()),
    )


def _words(frame: str) -> str:
    return {"cam": "the camera", "base": "the robot's base"}.get(frame, f"the {frame}")


def _rounded(sigma: float) -> str:
    return significant(sigma, 2)


def _matrix_text(matrix: FloatArray) -> str:
    rows = [", ".join(f"{value: .9f}" for value in row) for row in matrix]
    return "[[" + "],\n [".join(rows) + "]]"


def solver_rows(calibration: Calibration) -> tuple[SolverRow, ...]:
    """The solvers, each with its distance from the result in position [mm] and angle [deg]."""
    return tuple(_solver_row(calibration, name, it) for name, it in calibration.solvers.items())


def _solver_row(calibration: Calibration, name: str, result: SolverResult) -> SolverRow:
    differences = []
    for edge_name, edge in calibration.edges.items():
        if edge_name not in result.transforms:
            differences.append((significant(None), significant(None)))
            continue
        mm, deg = pose_difference(
            edge.transform.as_matrix(), result.transforms[edge_name].as_matrix()
        )
        differences.append((significant(mm), significant(deg)))
    return SolverRow(
        name, significant(result.rms_mm), significant(result.rms_deg), tuple(differences)
    )


def residual_rows(calibration: Calibration) -> tuple[ResidualRow, ...]:
    """Residuals of the fit, of views left out in turn, and of the declared hold-out set."""
    validation = calibration.validation
    sets: list[tuple[str, Rms | None]] = [
        ("used views, as fitted", calibration.rms),
        (f"left out in turn ({validation.method})", validation.held_out),
        ("declared hold-out views", validation.holdout),
    ]
    return tuple(
        ResidualRow(label, significant(rms.mm), significant(rms.deg), significant(rms.px))
        for label, rms in sets
        if rms is not None
    )


def key_figures(calibration: Calibration) -> tuple[Fact, ...]:
    """The handful of figures that most readers come for."""
    edge = next(iter(calibration.edges.values()))
    used = sum(view.used for view in calibration.views)
    facts = [
        Fact("camera position, sigma", f"{_rounded(edge.sigma_mm)} mm"),
        Fact("camera orientation, sigma", f"{_rounded(edge.sigma_deg)}\N{DEGREE SIGN}"),
        Fact(
            "held-out residual",
            f"{significant(calibration.validation.held_out.mm)} mm",
            f"{significant(calibration.validation.held_out.deg)}\N{DEGREE SIGN}",
        ),
        Fact("views used", f"{used} of {len(calibration.views)}"),
    ]
    if calibration.rms.px is not None:
        facts.insert(3, Fact("reprojection, rms", f"{significant(calibration.rms.px)} px"))
    return tuple(facts)


def method_facts(calibration: Calibration) -> tuple[Fact, ...]:
    """How the result was obtained."""
    used = sum(view.used for view in calibration.views)
    facts = [
        Fact(
            "mount",
            calibration.mount,
            "the camera rides on the robot"
            if calibration.mount == "eye-in-hand"
            else "the camera stands still and the robot carries the target",
        ),
        Fact("views", f"{used} used of {len(calibration.views)}"),
    ]
    if calibration.robot is not None:
        facts.append(Fact("robot model", str(calibration.robot.document.get("name", "given"))))
    if calibration.camera is not None:
        facts += _camera_facts(calibration.camera)
    noise = [_noise_fact(name, value) for name, value in calibration.noise.items()]
    return (*facts, *noise)


_MATRIX = ("fx", "fy", "cx", "cy")


def _lens_names(model: str) -> tuple[str, ...]:
    """OpenCV's names of the distortion coefficients, in its order."""
    if model == "fisheye":
        return ("k1", "k2", "k3", "k4")
    return ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def _camera_facts(result: CameraResult) -> list[Fact]:
    camera = result.camera
    values = np.concatenate([camera.matrix, camera.distortion])
    if result.covariance is not None and len(result.covariance) == len(values):
        sigmas = np.sqrt(np.clip(np.diag(result.covariance), 0.0, None))
        texts = [
            f"{matched(value, sigma)} \N{PLUS-MINUS SIGN} {_rounded(sigma)}"
            for value, sigma in zip(values, sigmas, strict=True)
        ]
    else:
        texts = [f"{value:.2f}" for value in camera.matrix]
        texts += [f"{value:.5g}" for value in camera.distortion]
    width, height = camera.resolution
    how = "estimated from this session" if result.estimated else "as given by the session"
    matrix = ", ".join(f"{name} {text}" for name, text in zip(_MATRIX, texts, strict=False))
    return [
        Fact("camera", f"{camera.model}, {width} \N{MULTIPLICATION SIGN} {height} px", how),
        Fact("camera matrix [px]", matrix),
        Fact(
            "distortion",
            ", ".join(
                f"{name} {text}"
                for name, text in zip(_lens_names(camera.model), texts[4:], strict=False)
            ),
        ),
    ]


_UNITS = {"_px": "px", "_mm": "mm", "_deg": "deg"}


def _noise_fact(name: str, value: float) -> Fact:
    stem, unit = name, ""
    for suffix, word in _UNITS.items():
        if name.endswith(suffix):
            stem, unit = name.removesuffix(suffix), word
    return Fact(
        f"noise, {stem.replace('_', ' ')}", f"{significant(value)} {unit}".strip(), "per axis"
    )


def view_rows(views: Sequence[ViewResult]) -> tuple[ViewRow, ...]:
    """One row for each view of the session, in its order."""
    return tuple(
        ViewRow(
            view.view,
            view.used,
            view.reason,
            significant(None) if view.corners is None else str(view.corners),
            significant(view.rms_px),
            significant(view.residual_mm),
            significant(view.residual_deg),
        )
        for view in views
    )


def dependency_versions() -> tuple[Fact, ...]:
    """Versions of the libraries that compute the result, as installed here."""
    return tuple(Fact(name, metadata.version(name)) for name in _DEPENDENCIES)
