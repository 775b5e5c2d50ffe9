"""Devices by the names that a user gives: `ur:192.168.0.10`, `socket:30100`, `oak`, `uvc:0`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from operator import attrgetter
from typing import TYPE_CHECKING, TypeVar

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean

if TYPE_CHECKING:
    # Help on the command line names the kinds, without what they need.
    from visioncal.live.drivers.protocols import Arm, CameraDevice, DeviceSetup

_Opener = TypeVar("_Opener")


def open_arm(
    words: str,
    ask: Callable[[str], str],
    form: str | None = None,
    *,
    moves: bool,
    answers: bool = True,
) -> Arm:
    """Opens an arm.

    Args:
        words: `KIND` or `KIND:ADDRESS`.
        ask: Asks a question and returns the line that was typed.
        form: Form of typed poses; None to recognise it.
        moves: Whether it is to be driven; otherwise it need not be ready for that.
        answers: Whether a person types, who can be asked again, unlike a file.

    Raises:
        DataError: There is no such kind.
        DriverError: It cannot be opened.
    """
    opener, address = _opener(words, ARMS, "--arm")
    return opener(address, ask=ask, form=form, moves=moves, answers=answers)


def open_camera(words: str, requested: DeviceSetup) -> CameraDevice:
    """Opens a camera, named as in `open_arm`.

    Raises:
        DataError: There is no such kind.
        DriverError: It cannot be opened.
    """
    opener, address = _opener(words, CAMERAS, "--camera")
    return opener(address, requested)


def _opener(words: str, openers: Mapping[str, _Opener], option: str) -> tuple[_Opener, str]:
    kind, _, address = words.partition(":")
    if kind not in openers:
        raise DataError(
            f"{option}: the device is {kind[:80]!r}, but must be one of {', '.join(openers)}.",
            culprits=[option],
            next_step=did_you_mean(kind, openers),
        )
    if kind == "ur" and not address:
        raise DataError("ur needs an address: ur:HOST, as ur:192.168.0.10.", culprits=[option])
    return openers[kind], address


# Drivers and their client libraries are imported only when a device is opened.


def _ur(address: str, *, moves: bool, **_: object) -> Arm:
    from visioncal.live.drivers.ur import UrArm

    return UrArm(address, watch_only=not moves)


def _manual(
    _: str, *, ask: Callable[[str], str], form: str | None, answers: bool, **__: object
) -> Arm:
    from visioncal.live.drivers.manual import ManualArm

    return ManualArm(ask, form, answers=answers)


def _socket(address: str, *, form: str | None, **__: object) -> Arm:
    from visioncal.live.drivers.pose_socket import SocketArm

    host, _, port = address.rpartition(":")
    if not (port.isascii() and port.isdecimal() and len(port) < 6 and int(port) < 1 << 16):
        raise DataError(
            f"--arm: socket needs a port to listen at, but has {address[:80]!r}.",
            culprits=["--arm"],
            next_step="Give a port, as socket:30100 for programs on this computer, or with the "
            "address of this computer in the robot's network, as socket:192.168.0.2:30100.",
        )
    return SocketArm(host or "127.0.0.1", int(port), form)


def _driver(name: str) -> Callable[[str, DeviceSetup], CameraDevice]:
    """Opener of a camera by its driver, `module.Class` of an address and what is requested."""
    module, _, kind = name.partition(".")

    def opened(address: str, requested: DeviceSetup) -> CameraDevice:
        # The import waits for the call.
        opener = attrgetter(kind)(import_module(f"visioncal.live.drivers.{module}"))
        camera: CameraDevice = opener(address, requested)
        return camera

    return opened


ARMS: Mapping[str, Callable[..., Arm]] = {"ur": _ur, "manual": _manual, "socket": _socket}
# Those that request views, and are not driven.
REQUESTING = ("manual", "socket")
CAMERAS: Mapping[str, Callable[[str, DeviceSetup], CameraDevice]] = {
    "oak": _driver("oak.OakCamera"),
    "uvc": _driver("uvc.UvcCamera"),
    "genicam": _driver("genicam.GenicamCamera"),
    "basler": _driver("basler.BaslerCamera"),
    "realsense": _driver("realsense.RealsenseCamera"),
    "folder": _driver("folder.FolderCamera"),
    "python": _driver("function.FunctionCamera.of_file"),
}
