"""Cameras that OpenCV opens: USB video class, a device file, or a stream's URL."""

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack

import cv2
import numpy as np

from visioncal.core.types import Image
from visioncal.live.drivers import stream
from visioncal.live.drivers.protocols import DeviceSetup
from visioncal.vision.boards.imaging import decode_image

# OpenCV's format of packets as they come, and the code of JPEG files.
_UNDECODED, _JPEG = -1, cv2.VideoWriter.fourcc(*"MJPG")


class UvcCamera(stream.StreamingCamera):
    """Camera device through OpenCV's VideoCapture.

    Requested settings are set where the camera supports them; `settings` are what it then reports.
    Autofocus, which would change the intrinsics, is switched off. Exposure stays as the camera has
    it unless requested, which is automatic for most. The address is the camera's index, the path of
    its device, or a URL.
    """

    def _open(self, address: str, requested: DeviceSetup, closing: ExitStack) -> stream.Opened:
        source = int(address or 0) if (address or "0").isdecimal() else address
        name = f"camera {without_password(str(source))}"
        capture = _open_capture(source, name, requested)
        closing.callback(capture.release)
        if requested.resolution is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, requested.resolution[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, requested.resolution[1])
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        capture.set(cv2.CAP_PROP_AUTOFOCUS, 0)
        if requested.focus is not None:
            capture.set(cv2.CAP_PROP_FOCUS, requested.focus)
        if requested.exposure_us is not None:
            # V4L2's value for manual exposure, and its unit of 0.1 ms.
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, 1.0)
            capture.set(cv2.CAP_PROP_EXPOSURE, round(1e-6 * requested.exposure_us / 1e-4))
        if requested.gain is not None:
            capture.set(cv2.CAP_PROP_GAIN, requested.gain)
        values = {
            "exposure": capture.get(cv2.CAP_PROP_EXPOSURE),
            "auto_exposure": capture.get(cv2.CAP_PROP_AUTO_EXPOSURE),
            "focus": capture.get(cv2.CAP_PROP_FOCUS),
            "gain": capture.get(cv2.CAP_PROP_GAIN),
            "rate_hz": capture.get(cv2.CAP_PROP_FPS),
        }
        # OpenCV returns 0 or -1 for settings that the camera does not have.
        settings = {key: value for key, value in values.items() if 0.0 < value < math.inf}
        return name, _arrivals(capture, 1e-6 * (requested.exposure_us or 0)), {**settings}


def _arrivals(capture: cv2.VideoCapture, exposure_s: float) -> Iterator[stream.Arrival]:
    # JPEG files of a network camera are decoded only when they are asked for: at a high resolution
    # they come faster than they could be decoded.
    is_jpeg = capture.get(cv2.CAP_PROP_FORMAT) == _UNDECODED

    def decode() -> Image | None:
        read, image = capture.retrieve()
        if not read or image is None:
            raise ValueError("it cannot be decoded")
        if not is_jpeg:
            return np.asarray(image, np.uint8)
        decoded = decode_image(image.tobytes(), colour=True)
        # Cut short, as where the network lost a part.
        return None if isinstance(decoded, str) else decoded

    while capture.grab():
        now_s = time.monotonic()
        reported_s = 1e-3 * float(capture.get(cv2.CAP_PROP_POS_MSEC))
        # Only V4L2 of Linux reports the kernel's timestamp; one of the last ten seconds is of this
        # host's clock.
        if now_s - 10.0 < reported_s <= now_s:
            exposed_s = reported_s - exposure_s, reported_s - 0.5 * exposure_s
            yield stream.Arrival(now_s, decode, exposed_s)
        else:
            yield stream.Arrival(now_s, decode)


def without_password(url: str) -> str:
    """A URL without user and password, to be shown and stored."""
    scheme, separator, rest = url.partition("://")
    authority, slash, path = rest.partition("/")
    return f"{scheme}{separator}{authority.rpartition('@')[2]}{slash}{path}" if separator else url


def _open_capture(source: int | str, name: str, requested: DeviceSetup) -> cv2.VideoCapture:
    scheme, separator, _ = str(source).partition("://")
    is_url = bool(separator) and "!" not in scheme
    if is_url:
        stream.refuse_settings(name, requested, "on the camera's own page")
        # The default timeout is half a minute, and decoding in n threads delays by n pictures.
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 5000]
        limits += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, 1500, cv2.CAP_PROP_N_THREADS, 1]
        undecoded = [*limits, cv2.CAP_PROP_FORMAT, _UNDECODED]
        capture = cv2.VideoCapture(str(source), cv2.CAP_FFMPEG, undecoded)
        if capture.isOpened() and int(capture.get(cv2.CAP_PROP_FOURCC)) != _JPEG:
            # Pictures of other codecs depend on those before them.
            capture.release()
            capture = cv2.VideoCapture(str(source), cv2.CAP_FFMPEG, limits)
    else:
        capture = cv2.VideoCapture(source)
    why, step = "", ""
    if not capture.isOpened():
        why = "cannot be opened"
        step = (
            "Look at its address, its power and its network: does another player on this computer "
            "show its pictures? One that wants a password has it in its URL: "
            "http://USER:PASSWORD@HOST/PATH."
            if is_url
            else "Look at its cable, at whether another program holds it, and at whether this user "
            "may read it (on Linux: the group video; v4l2-ctl --list-devices)."
        )
    # Only a file has a number of pictures.
    elif int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) > 0:
        why = "is a video file, whose pictures have no time"
        step = "Extract them into a folder, and record with --camera folder:PATH."
    if why:
        capture.release()
        raise stream.camera_error(name, why, step)
    return capture
