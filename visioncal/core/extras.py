"""Import of optional libraries, with the command that installs a missing one."""

import sys
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
    "kornia": "kornia>=0.8,<1",
    "page": "nicegui>=3.18,<4",
    "ros": "rosbags>=0.11,<0.12",
    "lerobot": "pyarrow>=18",
}
# The newest Python for which a package has wheels, where it is not the newest of all.
_NEWEST_PYTHON = {"ur": (3, 12)}


def client_library(module: str, extra: str) -> ModuleType:
    """Imports a library that an extra brings; raises DriverError."""
    try:
        return import_module(module)
    except ImportError as error:
        package, newest = _PACKAGES[extra], _NEWEST_PYTHON.get(extra, sys.version_info[:2])
        next_step = f"Install it: pip install '{package}'"
        if sys.version_info[:2] > newest:
            next_step = (
                f"{package} has no release for this Python, {sys.version_info[0]}."
                f"{sys.version_info[1]}: make a virtual environment with Python "
                f"{newest[0]}.{newest[1]}."
            )
        raise DriverError(
            f"{module} cannot be imported: {error}.", culprits=[module], next_step=next_step
        ) from error
