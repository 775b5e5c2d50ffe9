"""Cameras of any maker that brings a GenTL producer, by harvesters."""

import logging
import os
import time
from collections.abc import Generator
from contextlib import ExitStack, nullcontext
from pathlib import Path

from visioncal.core.extras import Handle, client_library
from visioncal.core.types import Image
from visioncal.live.drivers import stream
from visioncal.live.drivers.features import Features, bgr_or_grey
from visioncal.live.drivers.protocols import DeviceSetup

# Folders in which makers' installers put their producers, by the standard GenTL.
_VARIABLE = "GENICAM_GENTL64_PATH"
_NAMES = ("id_", "serial_number", "user_defined_name", "model")


class GenicamCamera(stream.StreamingCamera):
    """Camera device through a GenTL producer.

    Its address is `ID`, `PATH.cti` or `PATH.cti:ID`: the producer, by default all of those in
    GENICAM_GENTL64_PATH, and the camera's id, serial number or user's name.
    """

    def _open(self, address: str, requested: DeviceSetup, closing: ExitStack) -> stream.Opened:
        core = client_library("harvesters.core", "genicam")
        apis = (client_library(f"genicam.{api}", "genicam") for api in ("genapi", "gentl"))
        errors = (AttributeError, *(api.GenericException for api in apis))
        path, suffix, rest = address.rpartition(".cti")
        kind, wanted = (f"genicam:{path}.cti", rest[1:]) if suffix else ("genicam", rest)
        folders = [Path(name) for name in os.environ.get(_VARIABLE, "").split(os.pathsep) if name]
        producers = [file for folder in folders for file in sorted(folder.glob("*.cti"))]
        if suffix:
            producers = [file for file in [Path(path + suffix)] if file.is_file()]
        if not producers:
            why = f"there is no file {path}.cti" if suffix else f"{_VARIABLE} names no .cti file"
            step = "Install its maker's software, and give the file: --camera genicam:PATH.cti."
            raise stream.camera_error("camera genicam", f"has no GenTL producer: {why}", step)
        # Failures are raised, too, and worded for their reader.
        logger = logging.getLogger("harvesters")
        logger.addHandler(logging.NullHandler())
        harvester = core.Harvester(logger=logger)
        closing.callback(harvester.reset)
        with stream.being_opened(kind, *errors):
            for producer in producers:
                harvester.add_file(str(producer))
            harvester.update()
            # A property that a producer does not report is None.
            infos = [info.property_dict for info in harvester.device_info_list]
        named = [tuple(str(info[key]) for key in _NAMES if info.get(key)) for info in infos]
        index = stream.chosen(kind, named, wanted, "its maker's viewer")
        name = f"camera {' '.join(named[index])}"
        with stream.being_opened(name, *errors):
            acquirer = harvester.create(index)
            closing.callback(acquirer.destroy)
            nodes = acquirer.remote_device.node_map
            features = Features(name, lambda feature: getattr(nodes, feature), "value", errors)
            features.configure(requested)
            acquirer.start()
            arrivals = _arrivals(acquirer)
            # Before the rest: it holds a buffer of the camera.
            closing.callback(arrivals.close)
            return name, arrivals, features.held(arrivals)


def _arrivals(acquirer: Handle) -> Generator[stream.Arrival | None, None, None]:
    def decode() -> Image:
        part = buffer.payload.components[0]
        channels = int(part.num_components_per_pixel)
        # Behind the pixels of a row there may be padding.
        rows = part.data.reshape(part.height, -1)[:, : part.width * channels]
        shape = (part.height, part.width, channels) if channels > 1 else rows.shape
        return bgr_or_grey(rows.reshape(shape), part.data_format)

    while True:
        buffer = acquirer.try_fetch(timeout=0.1)
        with buffer or nullcontext():
            yield stream.Arrival(time.monotonic(), decode) if buffer else None
