"""Devices by the names that a user gives: `ur:192.168.0.10`, `oak`, `uvc:0`."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.live.drivers.protocols import Arm, CameraDevice, DeviceSetup

# Kinds that need an address, with its form.
_ADDRESSES = {"ur": "ur:HOST, as ur:192.168.0.10"}


@dataclass(frozen=True)
class ArmSetup:
    """Options of an arm to open."""

    address: str  # What follows the kind: a host.
    watch_only: bool  # Whether it is only read, and need not be ready to be driven.
    ask: Callable[[str], str]  # Asks a question and returns the line that was typed.
    form: str | None = None  # Form of typed poses; None to recognise it.
    answers: bool = True  # Whether a person types, who can be asked again, unlike a file.


_Opener = TypeVar("_Opener")


def open_arm(words: str, wish: ArmSetup) -> Arm:
    """Opens an arm.

    Args:
        words: `KIND` or `KIND:ADDRESS`.
        wish: Its options; the address is replaced by that of the words.

    Raises:
        DataError: There is no such kind.
        DriverError: It cannot be opened.
    """
    opener, address = _opener(words, ARMS, "--arm")
    return opener(replace(wish, address=address))


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
            f"{option}: {kind[:80]!r} is no kind of device; {', '.join(openers)} are.",
            culprits=[option],
            next_step=did_you_mean(kind, openers),
        )
    if not address and kind in _ADDRESSES:
        raise DataError(f"{kind} needs an address: {_ADDRESSES[kind]}.")
    return openers[kind], address


# Drivers and their client libraries are imported only when a device is opened.


def _ur(wish: ArmSetup) -> Arm:
    from visioncal.live.drivers.ur import UrArm

    return UrArm(wish.address, watch_only=wish.watch_only)


def _manual(wish: ArmSetup) -> Arm:
    from visioncal.live.drivers.manual import ManualArm

    return ManualArm(wish.ask, wish.form, answers=wish.answers)


def _oak(address: str, requested: DeviceSetup) -> CameraDevice:
    from visioncal.live.drivers.oak import OakCamera

    return OakCamera(requested, device=address or None)


def _uvc(address: str, requested: DeviceSetup) -> CameraDevice:
    from visioncal.live.drivers.uvc import UvcCamera

    return UvcCamera(int(address or 0) if (address or "0").isdecimal() else address, requested)


ARMS: Mapping[str, Callable[[ArmSetup], Arm]] = {"ur": _ur, "manual": _manual}
CAMERAS: Mapping[str, Callable[[str, DeviceSetup], CameraDevice]] = {
    "oak": _oak,
    "uvc": _uvc,
}
