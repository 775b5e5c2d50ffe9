"""Simulated cells: all combinations of given parameters."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from visioncal.core.choices import SIMULATED_ARMS
from visioncal.core.errors import DataError
from visioncal.core.files import read_toml
from visioncal.core.number_format import did_you_mean
from visioncal.core.types import Progress
from visioncal.simulation import CAMERAS, CellOptions, simulate, write_session
from visioncal.simulation.options import TARGETS

# Numeric keys: the field of `CellOptions` and the unit.
_NUMBERS: Mapping[str, tuple[str, float]] = {
    "robot_sigma_mm": ("robot_sigma_m", 1e-3),
    "robot_sigma_mrad": ("robot_sigma_rad", 1e-3),
    "arm_sigma_mm": ("dh_sigma_m", 1e-3),
    "arm_sigma_mrad": ("dh_sigma_rad", 1e-3),
    "pixel_sigma_px": ("pixel_sigma_px", 1.0),
}
# Keys with named values: the field of `CellOptions` and the values by name.
_NAMES: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "robot": ("robot", {arm: arm for arm in SIMULATED_ARMS}),
    "mount": ("mount", {name: name for name in ("eye-in-hand", "eye-to-hand")}),
    "camera": ("camera", CAMERAS),
    "board": ("target", TARGETS),
}
_SEEDS, _MOST_SEEDS, _MOST_VIEWS = 10, 10_000, 10_000


def write_cells(file: Path, folder: Path, progress: Progress | None = None) -> list[Path]:
    """Simulates all combinations of varied parameters, each with several seeds.

    Args:
        file: A TOML file with a list of values for each key, and the number of `seeds`.
        folder: Folder for the sessions, without images, each with its truth beside it; existing
            ones are kept.
        progress: Called after each.

    Returns:
        The sessions' folders.

    Raises:
        DataError: The file cannot be read, or a key or value in it is unknown.
    """
    document = read_toml(file, str(file))
    seeds = document.pop("seeds", _SEEDS)
    if type(seeds) is not int or not 0 < seeds <= _MOST_SEEDS:
        raise DataError(
            f"{file}: seeds is {seeds!r}; 1 to {_MOST_SEEDS} is needed.", culprits=[str(file)]
        )
    varied = {key: value if isinstance(value, list) else [value] for key, value in document.items()}
    fields = {key: [_field(file, key, value) for value in values] for key, values in varied.items()}
    cells = []
    for indices in product(*(range(len(group)) for group in varied.values())):
        chosen = dict(zip(varied, indices, strict=True))
        words = "-".join(f"{key}_{varied[key][at]}" for key, at in chosen.items()) or "cell"
        options = replace(CellOptions(), **dict(fields[key][at] for key, at in chosen.items()))
        cells += [
            (folder / words / f"seed_{seed:04d}", replace(options, seed=seed))
            for seed in range(seeds)
        ]
    for at, (path, options) in enumerate(cells):
        if not path.exists():
            write_session(simulate(options), path, images=False)
        if progress is not None:
            progress("cells", at + 1, len(cells))
    return [path for path, _ in cells]


def _field(file: Path, key: str, value: object) -> tuple[str, Any]:
    """The field of `CellOptions` that a key sets, and its value."""
    if key == "views":
        if type(value) is int and 3 <= value <= _MOST_VIEWS:
            return key, value
        raise DataError(
            f"{file}: views has {value!r}; 3 to {_MOST_VIEWS} is needed.", culprits=[str(file)]
        )
    if key in _NUMBERS:
        field, unit = _NUMBERS[key]
        if isinstance(value, int | float) and 0.0 <= value <= 100.0:
            return field, unit * value
        raise DataError(
            f"{file}: {key} has {value!r}; a number from 0 to 100 is needed.", culprits=[str(file)]
        )
    if key in _NAMES:
        field, values = _NAMES[key]
        if value in values:
            return field, values[str(value)]
        raise DataError(
            f"{file}: {key} has {value!r}; known are {', '.join(values)}.",
            culprits=[key],
            next_step=did_you_mean(str(value), values) or f"Write one of these in {file}, {key}.",
        )
    keys = ("views", *_NUMBERS, *_NAMES, "seeds")
    raise DataError(
        f"{file}: {key} is nothing that is varied; known are {', '.join(keys)}.",
        culprits=[key],
        next_step=did_you_mean(key, keys) or f"Write one of these in {file}.",
    )
