"""The colour of Intel's RealSense cameras, with aligned depth, through librealsense."""

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack

import numpy as np

from visioncal.core.extras import Handle, client_library
from visioncal.core.types import Camera, Image, Image16
from visioncal.live.drivers import stream
from visioncal.live.drivers.protocols import DeviceSetup


class RealsenseCamera(stream.StreamingCamera):
    """Camera device of a RealSense's colour stream, by its serial number.

    Depth is beside it where the device has any, at the nearest size and the same rate. The largest
    resolution is the default. Exposure and gain stay automatic, or as its viewer set them: their
    unit differs between models.
    """

    def _open(self, address: str, requested: DeviceSetup, closing: ExitStack) -> stream.Opened:
        rs = client_library("pyrealsense2", "realsense")
        serial, model = rs.camera_info.serial_number, rs.camera_info.name
        devices = list(rs.context().query_devices())
        found = [(device.get_info(serial), device.get_info(model)) for device in devices]
        index = stream.chosen("realsense", found, address, "realsense-viewer")
        device, name = devices[index], " ".join(reversed(found[index]))
        stream.refuse_settings(name, requested, "in realsense-viewer")
        with stream.being_opened(name, RuntimeError):
            sensor, profile = _colour(rs, device, name, requested.resolution)
            self.factory, source = factory_intrinsics(rs, profile.get_intrinsics())
            settings = {"rate_hz": profile.fps(), "factory_intrinsics": source}
            streams, depth = [(sensor, profile)], _depth(rs, device, profile)
            if depth is not None:
                streams.append(depth)
                unit_m = depth[0].get_option(rs.option.depth_units)
                # It is of single precision.
                settings["depth_unit_m"] = float(f"{unit_m:.6g}")
            queue = rs.frame_queue(2) if depth is None else rs.syncer(2)
            for one, wanted in streams:
                one.open(wanted)
                closing.callback(one.close)
                one.start(queue)
                closing.callback(one.stop)
            return name, _arrivals(rs, device, queue, [wanted for _, wanted in streams]), settings


def _colour(
    rs: Handle, device: Handle, name: str, resolution: tuple[int, int] | None
) -> tuple[Handle, Handle]:
    """The sensor with a colour stream, and its profile of a resolution, by default the largest."""
    profiles: dict[tuple[int, int], list[tuple[float, Handle, Handle]]] = {}
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if (profile.stream_type(), profile.format()) == (rs.stream.color, rs.format.bgr8):
                video = profile.as_video_stream_profile()
                # A resting arm needs no more than 15 Hz: the nearest rate is taken.
                ranked = abs(video.fps() - 15), sensor, video
                profiles.setdefault((video.width(), video.height()), []).append(ranked)
    size = resolution or max(profiles, default=(0, 0))
    if size not in profiles:
        why = f"gives no colour pictures of {size} pixels; it has {sorted(profiles)}"
        step = "Ask for a resolution that it has; on USB 2 it has fewer."
        raise stream.camera_error(name, why, step, "--resolution")
    return min(profiles[size], key=lambda ranked: ranked[0])[1:]


def _depth(rs: Handle, device: Handle, colour: Handle) -> tuple[Handle, Handle] | None:
    """The sensor with a depth stream of the colour's rate and its profile of the nearest size."""
    found = [
        (abs(video.width() - colour.width()), at, sensor, video)
        for at, sensor in enumerate(device.query_sensors())
        for profile in sensor.get_stream_profiles()
        if (profile.stream_type(), profile.format()) == (rs.stream.depth, rs.format.z16)
        for video in [profile.as_video_stream_profile()]
        if video.fps() == colour.fps()
    ]
    return min(found, key=lambda item: item[:2])[2:] if found else None


def factory_intrinsics(rs: Handle, intrinsics: Handle) -> tuple[Camera | None, str]:
    """Factory intrinsics, and where they are from or why they are not used.

    Librealsense's Brown-Conrady model is that of OpenCV. Most colour streams are said to be of its
    inverse, which the documentation has undistort a picture (Projection in librealsense, Distortion
    Models), but the library's own projection distort it: coefficients have no certain meaning.
    """
    matrix = np.array([intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy])
    distortion, model = np.array(intrinsics.coeffs, dtype=float), intrinsics.model
    if not matrix[0] or (distortion.any() and model != rs.distortion.brown_conrady):
        return None, f"not used: f {matrix[0]:.6g}, {model.name} {distortion.round(6).tolist()}"
    size = (intrinsics.width, intrinsics.height)
    return Camera("brown", size, matrix, distortion), "read from the device"


def _arrivals(
    rs: Handle, device: Handle, queue: Handle, profiles: Sequence[Handle]
) -> Iterator[stream.Arrival | None]:
    metadata = rs.frame_metadata_value
    moments = (metadata.sensor_timestamp, metadata.frame_timestamp)
    align, colour, *others = rs.align(rs.stream.color), *profiles
    # Alignment widens the edges of what is aligned as it comes, as from a D405.
    is_same = all(
        np.allclose(between.translation, 0.0) and str(one.get_intrinsics()) == str(lens)
        for one in others
        for between, lens in [(one.get_extrinsics_to(colour), colour.get_intrinsics())]
    )

    def decode() -> Image:
        return np.array(frame.as_video_frame().get_data(), dtype=np.uint8)

    def distances() -> Image16:
        aligned = frame_pair if is_same else align.process(frame_pair)
        return np.array(aligned.get_depth_frame().get_data(), dtype=np.uint16)

    while device.is_connected():
        if not others:
            came, frame = queue.try_wait_for_frame(100)
        else:
            came, frame_pair = queue.try_wait_for_frames(100)
            frame = came and frame_pair.get_color_frame()
            came = bool(frame and frame_pair.get_depth_frame())
        now_s, exposed_s = time.monotonic(), None
        is_global = came and frame.get_frame_timestamp_domain() == rs.timestamp_domain.global_time
        if is_global and all(frame.supports_frame_metadata(moment) for moment in moments):
            # Middle of the exposure and begin of readout, which is not before its end; the host's
            # time is of the latter.
            middle_s, readout_s = (1e-6 * frame.get_frame_metadata(moment) for moment in moments)
            half_s, since_s = readout_s - middle_s, time.time() - 1e-3 * frame.get_timestamp()
            exposed_s = now_s - since_s - 2.0 * half_s, now_s - since_s - half_s
        depth = distances if others else None
        yield stream.Arrival(now_s, decode, exposed_s, depth) if came else None
