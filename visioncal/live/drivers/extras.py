"""Import of optional client libraries, with the command that installs a missing one.

DepthAI, the library of Luxonis' OAK cameras, is imported only here, with its telemetry off.
"""

import os
from importlib import import_module
from types import ModuleType
from typing import Any, TypeAlias

from visioncal.core.errors import DriverError

# Packages of the extras, by their names in pyproject.toml.
_PACKAGES = {"ur": "ur-rtde>=1.6.5,<2", "oak": "depthai>=3.12,<4"}
# A pipeline, a node, an output, a message: their classes exist only where the library is installed.
Handle: TypeAlias = Any


def client_library(module: str, extra: str) -> ModuleType:
    """Imports a client library that an extra brings.

    Raises:
        DriverError: It is not installed, with the command that installs it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise DriverError(
            f"{module} cannot be imported: {error}.",
            culprits=[module],
            next_step=f"Install it: pip install '{_PACKAGES[extra]}'",
        ) from error


def depthai() -> ModuleType:
    """Imports depthai.

    It reads its environment once, on import; by default it sends telemetry.

    Raises:
        DriverError: It is not installed, with the command that installs it.
    """
    os.environ["DEPTHAI_TELEMETRY"] = "0"
    # Hides warnings about USB in containers.
    os.environ.setdefault("DEPTHAI_LEVEL", "error")
    # By default it searches for a device for 10 s; one that is connected is found within one.
    os.environ.setdefault("DEPTHAI_SEARCH_TIMEOUT", "3000")
    return client_library("depthai", "oak")
