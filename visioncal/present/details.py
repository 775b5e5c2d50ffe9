"""Facts and observation table of a tool or a fixture."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from visioncal.core.number_format import significant
from visioncal.present.facts import readable_time
from visioncal.present.tables import Fact, Table, TableRow
from visioncal.results import Frame

_UNITS = {"_px": "px", "_mm": "mm", "_deg": "deg", "_rad": "rad", "_m": "m", "_percent": "%"}
# Labels by the key's path; {} is the name of a point. Other keys are shown as written.
_LABELS = {
    "turn_deg": "largest turn between touches",
    "points_m": "{}, in the base",
    "points_sigma_mm": "{}, sigma",
    "worst.offset": "least known offset",
    "worst.offset_sigma_mm": "its sigma",
    "worst.rotation": "least known rotation",
    "worst.rotation_sigma_deg": "its sigma",
    "tool.name": "tool",
    "tool.sigma_mm": "sigma of its tip",
    "point_target_mm": "point on the target",
    "rms_deg": "orientation residual, rms",
    "scatter_over_expected": "scatter over what is expected",
    "sigma_by_images_mm": "sigma, from image to image",
    "sigma_in_common_mm": "sigma, the same in all images",
    "camera_calibrated": "camera calibrated",
    "dictionary": "marker dictionary",
    "marker_mm": "side of a marker",
    "seen_in": "images that show {}",
    "scale.value": "scale of the drawing",
    "scale.sigma": "its sigma",
    "coplanar": "all points in one plane",
}
# Ratios near one: their last digits matter.
_RATIOS = {"scale.value"}


def frame_facts(frame: Frame) -> tuple[Fact, ...]:
    """Method, source and accuracy of a tool or a fixture."""
    used = sum(observation.used for observation in frame.observations)
    return (
        Fact("method", frame.method),
        Fact("source", frame.source),
        Fact("created", readable_time(frame.created)),
        Fact("observations", f"{used} used of {len(frame.observations)}"),
        Fact("residual, rms", f"{significant(frame.rms_mm)} mm", "over those used"),
        Fact("noise, per axis", f"{significant(frame.noise_mm)} mm"),
        *(Fact(label, f"{value} {unit}".strip()) for label, value, unit in details(frame.details)),
    )


def observation_table(frame: Frame) -> Table:
    """Residual and status of each observation."""
    rows = []
    for seen in frame.observations:
        mark = "left-out" if not seen.used else "look" if seen.reason else "used"
        words = {"left-out": "left out", "look": "look", "used": "yes"}[mark]
        cells = (seen.name, seen.kind, significant(seen.residual_mm), words)
        rows.append(TableRow(cells, mark))
    return Table.of(("observation", "kind", "mm", "used"), rows, (0, 1, 3))


def details(document: Mapping[str, Any], parent: str = "") -> Iterator[tuple[str, str, str]]:
    """Further figures of a method as (label, value, unit); `parent` is the document's path.

    Matrices and lists of objects are left out: programs read them from disk.
    """
    for name, value in document.items():
        path = f"{parent}.{name}" if parent else name
        if isinstance(value, Mapping):
            yield from details(value, path)
            continue
        digits = 6 if path in _RATIOS else 2 if "sigma" in path else 4
        text = _text(value, digits)
        if text:
            # The keys of points are their names; the unit is that of their parent.
            suffix = _suffix(parent if parent in _LABELS else name)
            words = (key.removesuffix(_suffix(key)).replace("_", " ") for key in path.split("."))
            label = _LABELS.get(path) or _LABELS.get(parent, "").format(name) or ": ".join(words)
            yield label, text, _UNITS.get(suffix, "")


def _suffix(key: str) -> str:
    return next((unit for unit in _UNITS if key.endswith(unit)), "")


def _text(value: object, digits: int) -> str:
    """A detail as text; empty if it is not for display."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return f"{value:.{digits}g}"
    if isinstance(value, str):
        return value
    if isinstance(value, Sequence) and all(
        isinstance(number, int | float | str) for number in value
    ):
        return ", ".join(_text(number, digits) for number in value)
    return ""
