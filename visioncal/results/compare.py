"""Comparison of two calibrations of one cell: tests of changes against noise."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtrc, fdtrc

from visioncal.core.arguments import typed
from visioncal.core.number_format import some_of
from visioncal.core.transforms import inverse_right_jacobian, invert, log, pose_difference
from visioncal.core.types import Camera, FloatArray, Mount
from visioncal.results import Calibration, CameraResult, Edge, VerdictStatus
from visioncal.results.edge import PoseSigmas
from visioncal.session.frames import edge_names
from visioncal.session.selecting import ANY, Choice
from visioncal.vision.camera import intrinsics

# Significance level of a pair of calibrations over all tests.
FALSE_ALARMS = 0.01
# Smallest standard deviation in a test [rad, m], for exact data.
_LEAST_SIGMA = 1e-9
_NOTHING = "No transform changed: noise explains what differs."
_NOTHING_ELSE = "Of what was calibrated nothing changed: noise explains what differs."


@dataclass(frozen=True)
class Significance:
    """Result of a significance test of a difference."""

    p_value: float  # Probability of a difference at least as large by noise alone.
    limit: float  # A smaller `p_value` is a change.

    @property
    def is_change(self) -> bool:
        """Whether the difference is significant."""
        return self.p_value < self.limit


@dataclass(frozen=True, eq=False)
class EdgeChange(PoseSigmas):
    """Difference of one transform between two calibrations."""

    # Its name, such as `flange_from_cam`. A camera's is compared in the frame of its centre ray,
    # where both calibrations have that (`Calibration.ray_frame`).
    name: str
    twist: FloatArray  # (6,) rotation [rad] and translation [m] with `second = first * exp(twist)`.
    covariance: FloatArray  # (6, 6) of the twist if nothing changed.
    moved_mm: float  # Distance between the two origins [mm].
    moved_deg: float  # Angle between the two orientations [deg].
    translation: Significance  # Test of the translation.
    rotation: Significance  # Test of the rotation.

    @property
    def is_change(self) -> bool:
        """Whether the difference is significant."""
        return self.translation.is_change or self.rotation.is_change


@dataclass(frozen=True, eq=False)
class LensChange:
    """Difference of the intrinsics between two calibrations."""

    names: tuple[str, ...]  # fx, fy, cx, cy and the names of the distortion's coefficients.
    a: FloatArray  # (k,) values in the first.
    b: FloatArray  # (k,) values in the second.
    # (k,) standard deviations of the differences; None where not both were estimated.
    sigmas: FloatArray | None = None
    # Joint test of the differences; None where not both were estimated.
    significance: Significance | None = None

    @property
    def is_change(self) -> bool:
        """Whether the intrinsics differ: significantly, or at all where not both were estimated."""
        if self.significance is None:
            return self.sigmas is None and not np.array_equal(self.a, self.b)
        return self.significance.is_change


@dataclass(frozen=True, eq=False)
class Comparison:
    """Comparison of two calibrations."""

    mounts: tuple[str, str]  # The camera's mount in each; `whole cell` for one.
    verdicts: tuple[VerdictStatus, VerdictStatus]  # The verdict of each.
    # Whether both are of the same session, so that they share its noise and are not independent.
    same_session: bool
    edges: tuple[EdgeChange, ...]  # The transforms that both have, then the tools and fixtures.
    only_in_a: tuple[str, ...]  # Names of transforms that only the first has.
    only_in_b: tuple[str, ...]  # Names of transforms that only the second has.
    # The intrinsics, where both cameras have the same model and resolution.
    lens: LensChange | None
    # The noise levels in both, by name; None where absent.
    noise: Mapping[str, tuple[float | None, float | None]]
    findings: tuple[str, ...]  # Conclusions, in sentences.

    @property
    def is_change(self) -> bool:
        """Whether a transform or the lens changed significantly."""
        return any(edge.is_change for edge in self.edges) or (
            self.lens is not None and self.lens.is_change
        )

    @property
    def is_equal(self) -> bool:
        """Whether both are the same result of one session, but for rounding."""
        pairs: list[tuple[Any, Any]] = [] if self.lens is None else [(self.lens.a, self.lens.b)]
        pairs += [(edge.twist, np.zeros(6)) for edge in self.edges]
        pairs += self.noise.values()
        return (
            self.same_session
            and not (self.only_in_a or self.only_in_b)
            and self.verdicts[0] == self.verdicts[1]
            and all(
                pair[0] is not None
                and pair[1] is not None
                and np.allclose(*pair, rtol=1e-6, atol=_LEAST_SIGMA)
                for pair in pairs
            )
        )


@typed
def compare(
    a: Calibration,
    b: Calibration,
    *,
    camera: str | None = None,
    robot: str | None = None,
    target: str | None = None,
) -> Comparison:
    """Compares two calibrations as independent measurements of one cell.

    Rotation and translation of each transform are tested separately, on the components of
    `log(a^-1 * b)`. Their covariances are estimated from few views, so the squared Mahalanobis
    distance over three is F distributed (Hotelling 1931) with the combined degrees of freedom of
    both noise estimates (Welch 1947). Intrinsics that both have estimated have one chi-square test,
    since thousands of corners determine their noise. `FALSE_ALARMS` is divided among the tests
    (Bonferroni).

    Errors that both calibrations share cancel: the same given intrinsics, the same board. Arm
    errors at other stops do not cancel and are in no covariance: they look like a change.

    Args:
        a: The first calibration.
        b: The second calibration.
        camera: Name of the camera in a whole cell's calibration. Without any name, two whole cells
            are compared by all transforms that both have.
        robot: Name of the robot, likewise.
        target: Name of the target, likewise.

    Raises:
        DataError: There is none of that name, or a name is needed.
    """
    choice = Choice(camera, robot, target)
    if not choice.is_any or a.cell is None or b.cell is None:
        # Names select from whole cells; where neither is one, `chosen` refuses them.
        neither = a.cell is None and b.cell is None
        a, b = (
            calibration.chosen(choice if neither or calibration.cell is not None else ANY)
            for calibration in (a, b)
        )
    names = [name for name in a.placed if name in b.placed]
    # Two tests for each transform, and one for the lens.
    limit = FALSE_ALARMS / (2 * len(names) + 1)
    # Of a noise level: three residuals a view less half of twelve unknowns.
    used = [sum(view.used for view in each.views) for each in (a, b)]
    freedom = [max(3 * count - 6, 1) for count in used]
    edges = tuple(_edge_change(name, *_comparable(a, b, name), freedom, limit) for name in names)
    levels = (_levels(a), _levels(b))
    lens = _lens_change(a.camera, b.camera, limit)
    return Comparison(
        mounts=(
            "whole cell" if a.cell is not None else a.mount,
            "whole cell" if b.cell is not None else b.mount,
        ),
        verdicts=(a.verdict.status, b.verdict.status),
        same_session=a.session_sha256 == b.session_sha256,
        edges=edges,
        only_in_a=tuple(name for name in a.placed if name not in b.placed),
        only_in_b=tuple(name for name in b.placed if name not in a.placed),
        lens=lens,
        noise={
            name: (levels[0].get(name), levels[1].get(name)) for name in {**levels[0], **levels[1]}
        },
        findings=tuple(_findings(a, b, edges, lens)),
    )


def _comparable(a: Calibration, b: Calibration, name: str) -> tuple[Edge, Edge]:
    """A transform in both; a camera's in the frame of its centre ray, where both have that."""
    # The optical axis depends on the lens model's parameters; the direction of a ray does not.
    first, second = a.ray_frame, b.ray_frame
    if name == edge_names(a.mount)[0] and first and second and np.array_equal(first.px, second.px):
        return first.transform, second.transform
    return a.placed[name], b.placed[name]


def _levels(calibration: Calibration) -> Mapping[str, float]:
    """Noise levels by name; in a whole cell, prefixed by the frame or robot."""
    return {
        f"{of} {name}".strip(): level
        for of, levels in calibration.by_name.noise.items()
        for name, level in levels.items()
    }


def _edge_change(name: str, a: Edge, b: Edge, freedom: Sequence[int], limit: float) -> EdgeChange:
    first, second = a.matrix, b.matrix
    twist = log(invert(first) @ second)
    # First order of log(exp(-error_a) * exp(twist) * exp(error_b)) in both errors.
    by_a, by_b = inverse_right_jacobian(-twist), inverse_right_jacobian(twist)
    covariances = (by_a @ a.covariance @ by_a.T, by_b @ b.covariance @ by_b.T)
    moved_mm, moved_deg = pose_difference(first, second)
    covariance, tests = covariances[0] + covariances[1], []
    for part in (slice(0, 3), slice(3, 6)):
        # The covariance is the sum of two of estimated scale.
        sizes = np.array([np.trace(each[part, part]) for each in covariances]) + _LEAST_SIGMA**2
        combined = sizes.sum() ** 2 / np.sum(sizes**2 / np.array(freedom))
        squared = _squared_distance(twist[part], covariance[part, part])
        tests.append(Significance(float(fdtrc(3, combined, squared / 3)), limit))
    rotation, translation = tests
    return EdgeChange(name, twist, covariance, moved_mm, moved_deg, translation, rotation)


def _squared_distance(difference: FloatArray, covariance: FloatArray) -> float:
    """Squared Mahalanobis distance, scaled, since intrinsics differ by many powers of ten."""
    sigmas = np.sqrt(np.diag(covariance) + _LEAST_SIGMA**2)
    correlation = covariance / np.outer(sigmas, sigmas)
    np.fill_diagonal(correlation, 1.0)
    scaled = difference / sigmas
    return float(scaled @ np.linalg.lstsq(correlation, scaled, rcond=None)[0])


def _lens_change(a: CameraResult | None, b: CameraResult | None, limit: float) -> LensChange | None:
    if a is None or b is None:
        return None
    kinds = [(lens.model, lens.resolution, lens.distortion.size) for lens in (a.camera, b.camera)]
    if kinds[0] != kinds[1]:
        return None
    first, second = intrinsics(a.camera), intrinsics(b.camera)
    change = LensChange(intrinsics_names(a.camera), first, second)
    if a.covariance is None or b.covariance is None:
        return change
    covariance = a.covariance + b.covariance
    squared = _squared_distance(second - first, covariance)
    significance = Significance(float(chdtrc(len(first), squared)), limit)
    return replace(change, sigmas=np.sqrt(np.diag(covariance)), significance=significance)


def intrinsics_names(camera: Camera) -> tuple[str, ...]:
    """Names of a camera's intrinsics, by OpenCV's names and in its order."""
    brown, fisheye = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), ("k1", "k2", "k3", "k4")
    lens = fisheye if camera.model == "fisheye" else brown
    return ("fx", "fy", "cx", "cy", *lens[: camera.distortion.size])


def _findings(
    a: Calibration, b: Calibration, edges: Sequence[EdgeChange], lens: LensChange | None
) -> Iterator[str]:
    if a.session_sha256 == b.session_sha256:
        yield (
            "Both come from the same session and share its noise: their sigmas say nothing about "
            "the difference."
        )
    bad = [
        f"The {name} has the verdict bad, to be cleared up before anything is made of the "
        f"difference: {verdict.first_reason}"
        for name, verdict in (("first", a.verdict), ("second", b.verdict))
        if verdict.status == "bad"
    ]
    yield from bad
    every = [edge.name for edge in edges if edge.is_change]
    changed = [name for name in every if name in a.edges]
    placed = [name for name in every if name not in a.edges]
    nothing = _NOTHING_ELSE if placed else _NOTHING
    if bad:
        yield "Whether camera or board moved, a bad result does not show."
    elif a.cell is not None and not edges:
        yield "No frame is in both cells: nothing was compared."
    elif a.cell is not None:
        frames = some_of([name.partition("_from_")[2] for name in changed])
        yield (
            f"{frames} moved, or what they hang on was redefined; the others did not."
            if changed
            else nothing
        )
    elif a.mount != b.mount:
        yield f"The mounts differ ({a.mount}, {b.mount}): no transform is in both."
    else:
        yield _edge_finding(a.mount, changed) or nothing
    if placed:
        yield f"{some_of(placed)} changed: exchanged or moved, or found otherwise."
    if lens is not None and lens.is_change:
        yield (
            "The intrinsics differ: another camera, focus or zoom."
            if lens.significance is not None
            else "The intrinsics that were used differ, and they move the camera's edge with them."
        )
    if lens is None and a.camera is not None and b.camera is not None:
        yield "The cameras differ in model or resolution; their intrinsics were not compared."


def _edge_finding(mount: Mount, changed: Sequence[str]) -> str:
    """Sentence that says whether camera, board or both moved; empty for none."""
    sensor, seen = ("instrument", "probe") if mount == "instrument" else ("camera", "board")
    in_cell = " in the cell, or the controller's base frame was redefined"
    on_flange = " on the flange, or the controller's tool frame was redefined"
    if mount != "eye-in-hand":
        in_cell, on_flange = on_flange, in_cell
    sensor_moved, seen_moved = f"The {sensor} moved{on_flange}", f"The {seen} was moved{in_cell}"
    ends = [name.rpartition("_from_")[2] for name in changed]
    is_sensor = any(end.startswith(("cam", "instrument")) for end in ends)
    is_seen = any(end.startswith(("target", "probe")) for end in ends)
    if is_sensor and is_seen:
        return f"{sensor.capitalize()} and {seen} both moved. {sensor_moved}. {seen_moved}."
    if is_sensor:
        return f"{sensor_moved}; the {seen} did not: use the second calibration."
    if is_seen:
        return f"{seen_moved}; the {sensor} did not: its calibration still holds."
    return ""


# Keys of the document where they differ from the fields' names; None for those by name.
_KEYS = {
    "a": "first",
    "b": "second",
    "only_in_a": "only_in_first",
    "only_in_b": "only_in_second",
    "lens": "camera",
    "significance": "test",
} | dict.fromkeys(("name", "edges", "noise"))


def to_document(comparison: Comparison) -> dict[str, Any]:
    """Document of `visioncal diff --json`; what was not computed is absent."""
    transforms = {
        edge.name: _written(edge) | {"sigma_mm": edge.sigma_mm, "sigma_deg": edge.sigma_deg}
        for edge in comparison.edges
    }
    noise = {
        name: {key: level for key, level in (("first", a), ("second", b)) if level is not None}
        for name, (a, b) in comparison.noise.items()
    }
    return {**_written(comparison), "transforms": transforms, "noise": noise}


def _written(value: Any) -> Any:  # noqa: ANN401 - any of the dataclasses here, or their fields
    """JSON of a value; dataclasses with whether they are a change."""
    if isinstance(value, np.ndarray | tuple):
        return np.asarray(value).tolist()
    if not is_dataclass(value):
        return value
    written = {"is_change": value.is_change} if hasattr(value, "is_change") else {}
    for field in fields(value):
        key, content = _KEYS.get(field.name, field.name), getattr(value, field.name)
        if key is not None and content is not None:
            written[key] = _written(content)
    return written
