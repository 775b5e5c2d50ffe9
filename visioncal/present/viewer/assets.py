"""The files of rerun's web viewer, which its installed command carries inside."""

import re
from collections.abc import Mapping
from http.client import HTTPConnection, HTTPException

from visioncal.core.errors import DriverError
from visioncal.present.viewer.process import viewer_process

SCRIPT, MODULE = "re_viewer.js", "re_viewer_bg.wasm"

_PATIENCE_S = 30.0
_SERVING = re.compile(r"Hosting a web-viewer at http://127\.0\.0\.1:(\d+)")
# A recording by its URL makes rerun serve the files alone; nobody ever asks for it.
_NO_RECORDING = "http://127.0.0.1/none.rrd"


def viewer_assets() -> Mapping[str, bytes]:
    """Fetches the script and the module of the web viewer, by name.

    Rerun's command is let serve them on this machine for the quarter of a second that it takes.

    Raises:
        DriverError: Rerun's command does not start, or does not have them.
    """
    arguments = ("--serve-web", "--bind", "127.0.0.1", "--web-viewer-port", "0", _NO_RECORDING)
    with viewer_process(*arguments) as process:
        said: list[str] = []
        for line in process.stdout or ():
            said.append(line.strip())
            if serving := _SERVING.search(line):
                return {name: _fetch(int(serving[1]), name) for name in (SCRIPT, MODULE)}
    raise _unserved(" ".join(said[-1:]) or "it said nothing")


def _fetch(port: int, name: str) -> bytes:
    # Not urllib, which would ask a proxy of the environment for it.
    connection = HTTPConnection("127.0.0.1", port, timeout=_PATIENCE_S)
    try:
        connection.request("GET", f"/{name}")
        response = connection.getresponse()
        content = response.read()
    except (OSError, HTTPException) as error:
        raise _unserved(f"{name}: {error}") from error
    finally:
        connection.close()
    if response.status != 200:
        raise _unserved(f"{name}: HTTP status {response.status}")
    return content


def _unserved(reason: str) -> DriverError:
    return DriverError(
        f"rerun's command does not hand out its web viewer: {reason}.",
        next_step="Install rerun-sdk again, or leave out --web for the native viewer.",
    )
