"""Cells that are simulated by the hundred, before one is bought: combinations of what is varied."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from visioncal.core.choices import SIMULATED_ARMS
from visioncal.core.errors import DataError
from visioncal.core.files import did_you_mean, read_toml
from visioncal.core.types import Progress
from visioncal.simulation import CAMERAS, CellOptions, simulate, write_session
from visioncal.simulation.options import TARGETS

# The field of a cell that a key varies, and its unit.
_NUMBERS: Mapping[str, tuple[str, float]] = {
    "robot_sigma_mm": ("robot_sigma_m", 1e-3),
    "robot_sigma_mrad": ("robot_sigma_rad", 1e-3),
    "arm_sigma_mm": ("dh_sigma_m", 1e-3),
    "arm_sigma_mrad": ("dh_sigma_rad", 1e-3),
    "pixel_sigma_px": ("pixel_sigma_px", 1.0),
}
# That of the names that a key takes, and what they stand for.
_NAMES: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "robot": ("robot", {it: partial(str, it) for it in SIMULATED_ARMS}),
    "mount": ("mount", {it: partial(str, it) for it in ("eye-in-hand", "eye-to-hand")}),
    "camera": ("camera", CAMERAS),
    "board": ("target", TARGETS),
}
_SEEDS, _MOST_SEEDS, _MOST_VIEWS = 10, 10_000, 10_000


def write_cells(file: Path, folder: Path, progress: Progress | None = None) -> list[Path]:
    """Simulates all combinations of what a file varies, each some times.

    Args:
        file: A TOML file: of each key a list of values, and `seeds`, how many of each.
        folder: Where the sessions go, without images, each with its truth beside it; those that are
            there are left alone.
        progress: Told of each.

    Returns:
        The sessions' folders.

    Raises:
        DataError: The file cannot be read, or a key or value in it is none that is known.
    """
    document = read_toml(file, str(file))
    seeds = document.pop("seeds", _SEEDS)
    if type(seeds) is not int or not 0 < seeds <= _MOST_SEEDS:
        raise DataError(
            f"{file}: seeds is {seeds!r}; 1 to {_MOST_SEEDS} is needed.", culprits=[str(file)]
        )
    varied = {key: value if isinstance(value, list) else [value] for key, value in document.items()}
    fields = {key: [_field(file, key, it) for it in values] for key, values in varied.items()}
    wanted = []
    for places in product(*(range(len(it)) for it in varied.values())):
        chosen = dict(zip(varied, places, strict=True))
        words = "-".join(f"{key}_{varied[key][at]}" for key, at in chosen.items()) or "cell"
        options = replace(CellOptions(), **dict(fields[key][at] for key, at in chosen.items()))
        wanted += [
            (folder / words / f"seed_{seed:04d}", replace(options, seed=seed))
            for seed in range(seeds)
        ]
    for at, (path, options) in enumerate(wanted):
        if not path.exists():
            write_session(simulate(options), path, images=False)
        if progress is not None:
            progress("cells", at + 1, len(wanted))
    return [path for path, _ in wanted]


def _field(file: Path, key: str, value: object) -> tuple[str, Any]:
    """The field of a cell that a key names, and its value there."""
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
        field, known = _NAMES[key]
        if value in known:
            return field, known[str(value)]()
        raise DataError(
            f"{file}: {key} has {value!r}; known are {', '.join(known)}.",
            culprits=[key],
            next_step=did_you_mean(str(value), known) or f"Write one of these in {file}, {key}.",
        )
    keys = ("views", *_NUMBERS, *_NAMES, "seeds")
    raise DataError(
        f"{file}: {key} is nothing that is varied; known are {', '.join(keys)}.",
        culprits=[key],
        next_step=did_you_mean(key, keys) or f"Write one of these in {file}.",
    )
