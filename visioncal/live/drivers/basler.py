"""Basler's cameras through pypylon."""

import time
from collections.abc import Iterator
from contextlib import ExitStack

from visioncal.core.extras import Handle, client_library
from visioncal.core.types import Image
from visioncal.live.drivers import stream
from visioncal.live.drivers.features import Features, bgr_or_grey
from visioncal.live.drivers.protocols import DeviceSetup


class BaslerCamera(stream.StreamingCamera):
    """Camera device through pylon, by its serial number or the name that its user gave it."""

    def _open(self, address: str, requested: DeviceSetup, closing: ExitStack) -> stream.Opened:
        pylon = client_library("pypylon.pylon", "basler")
        error = client_library("pypylon.genicam", "basler").GenericException
        factory = pylon.TlFactory.GetInstance()
        infos = factory.EnumerateDevices()
        found = [
            (info.GetSerialNumber(), info.GetUserDefinedName() or info.GetModelName())
            for info in infos
        ]
        info = infos[stream.chosen("basler", found, address, "pylon Viewer")]
        name = f"Basler {info.GetModelName()} {info.GetSerialNumber()}"
        with stream.being_opened(name, error):
            device = pylon.InstantCamera(factory.CreateDevice(info))
            closing.callback(device.Close)
            device.Open()
            features = Features(name, lambda feature: getattr(device, feature), "Value", (error,))
            features.configure(requested)
            device.StartGrabbing(pylon.GrabStrategy_LatestImageOnly)
            arrivals = _arrivals(pylon, device, str(features.get("PixelFormat")))
            return name, arrivals, features.held(arrivals)


def _arrivals(pylon: Handle, device: Handle, pixel_format: str) -> Iterator[stream.Arrival | None]:
    def decode() -> Image | None:
        # It fails where packets were lost on the network.
        return bgr_or_grey(result.Array, pixel_format) if result.GrabSucceeded() else None

    while not device.IsCameraDeviceRemoved():
        with device.RetrieveResult(100, pylon.TimeoutHandling_Return) as result:
            yield stream.Arrival(time.monotonic(), decode) if result.IsValid() else None
