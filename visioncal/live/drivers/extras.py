"""Import of DepthAI, the library of Luxonis' OAK cameras: only here, with its telemetry off."""

import os
from types import ModuleType
from typing import Any, TypeAlias

from visioncal.core.extras import client_library

# A pipeline, a node, an output, a message: their classes exist only where the library is installed.
Handle: TypeAlias = Any


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
