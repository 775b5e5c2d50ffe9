"""DepthAI, the library of Luxonis' OAK cameras: imported here alone, with its telemetry off."""

import os
from types import ModuleType
from typing import Any, TypeAlias

from visioncal.live.drivers.extras import client_library

# A pipeline, a node, an output, a message: their classes are there only where the library is.
Handle: TypeAlias = Any


def depthai() -> ModuleType:
    """Imports depthai.

    It reads its environment once, when it is imported; by default it reports to its maker.

    Raises:
        DriverError: It is not installed, with the command that installs it.
    """
    os.environ["DEPTHAI_TELEMETRY"] = "0"
    # Its warnings about USB in containers are no news to a user of a recording or a rehearsal.
    os.environ.setdefault("DEPTHAI_LEVEL", "error")
    # It looks for a device for 10 s; one that is there is found within one.
    os.environ.setdefault("DEPTHAI_SEARCH_TIMEOUT", "3000")
    return client_library("depthai", "oak")
