"""Import of optional libraries, with the command that installs a missing one."""

from importlib import import_module
from types import ModuleType
from typing import Any, TypeAlias

from visioncal.core.errors import DriverError

# An object of a library whose classes exist only where it is installed.
Handle: TypeAlias = Any

# Packages of the extras, by their names in pyproject.toml.
_PACKAGES = {
    "ur": "ur-rtde>=1.6.5,<2",
    "oak": "depthai>=3.12,<4",
    "genicam": "harvesters>=1.4.3,<2",
    "basler": "pypylon>=26.9",
    "realsense": "pyrealsense2>=2.59,<3",
    "cluster": "distributed>=2025.1",
    "page": "nicegui>=3.18,<4",
    "ros": "rosbags>=0.11,<0.12",
    "lerobot": "pyarrow>=18",
}


def client_library(module: str, extra: str) -> ModuleType:
    """Imports a library that an extra brings; raises DriverError."""
    try:
        return import_module(module)
    except ImportError as error:
        raise DriverError(
            f"{module} cannot be imported: {error}.",
            culprits=[module],
            next_step=f"Install it: pip install '{_PACKAGES[extra]}'",
        ) from error
