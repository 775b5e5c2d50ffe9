"""Bags of ROS 1 and ROS 2 (sqlite3 and MCAP), read without ROS by rosbags (extra `ros`).

Images, depth (of images and of organised clouds), CameraInfo, JointState, TF, PoseStamped and
/robot_description are read by their types. The robot's motion becomes a stream on its own clock;
where the arm stood, one frame a stop becomes a view, else frames of the whole sweep. Images are
read from the bag when they are stored, one by one: memory does not grow with the bag.
"""

from array import array
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from visioncal.core.conventions import PoseNumbers
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.number_format import known_name, some_of
from visioncal.core.transforms import invert, log
from visioncal.core.types import FloatArray, IntArray, Mount
from visioncal.interchange.formats.bag_messages import BagContents, BagImages, contents_of
from visioncal.interchange.formats.foreign import (
    ForeignFormat,
    ForeignRecording,
    ForeignStream,
    ImportOptions,
    frames_to_take,
)
from visioncal.interchange.formats.intrinsics import intrinsics_from
from visioncal.robot import Robot
from visioncal.robot.trajectory import Trajectory
from visioncal.session.motion import is_standing_still

_ENDINGS = (".bag", ".mcap", ".db3")
# Frames of a robot that are preferred where TF has several, by what they are.
_BASES = ("base_link", "base", "panda_link0", "fr3_link0", "link_base", "link_0", "world")
_TIPS = ("tool0", "flange", "panda_link8", "fr3_link8", "link_eef", "ee_link", "tcp")


def _is_bag(path: Path) -> bool:
    if path.is_file():
        return path.suffix.lower() in _ENDINGS
    return any(next(path.glob(f"*{ending}"), None) is not None for ending in _ENDINGS)


def _read(source: Path, requested: ImportOptions) -> ForeignRecording:
    """Reads a bag; topics and frames are guessed where the user names none."""
    contents, name = contents_of(source, requested), source.stem
    if not contents.images:
        raise DataError(
            f"{source}: no topic has images (sensor_msgs/Image or CompressedImage).",
            culprits=[str(source)],
            next_step="Record the camera's topic, too: ros2 bag record IMAGES /tf /tf_static.",
        )
    cameras = _cameras(contents, requested)
    stream, words, tip, robot = _motion(contents, requested)
    at_s, poses = stream.stamps_s, stream.poses.poses()
    flange = Trajectory(at_s[np.isfinite(poses[:, 0, 0])], poses[np.isfinite(poses[:, 0, 0])])
    rows, places = list[tuple[str, float, str]](), dict[str, tuple[str, int]]()
    # Depth of images: its path and place.
    depths = dict[str, tuple[str, tuple[str, int]]]()
    how = "--robot-key BASE,TIP or a topic names another."
    notes = [f"The robot's motion: {words}. {how}{_refused(contents)}"]
    for topic, camera in cameras.items():
        images = contents.images[topic]
        chosen, how = _chosen(np.array(images.stamps_s), flange)
        notes.append(f"{topic}: {how}")
        for at in chosen.tolist():
            path = f"images/{camera}{'_' if camera else ''}{at:06d}.{images.ending}"
            places[path] = topic, images.received_ns[at]
            rows.append((camera, images.stamps_s[at], path))
        topic_rows = [row[1:] for row in rows[len(rows) - len(chosen) :]]
        depths |= _depths(contents, topic, topic_rows, notes)
    rows.sort(key=lambda row: row[1])
    columns = {} if len(cameras) == 1 else {"camera": tuple(camera for camera, _, _ in rows)}
    if depths:
        columns["depth"] = tuple(depths.get(path, ("",))[0] for _, _, path in rows)
        places |= dict(depths.values())
    lenses = {camera: _lens(contents, topic, notes) for topic, camera in cameras.items()}
    labels = tuple(f"{name}, {path}" for _, _, path in rows)
    one = next(iter(lenses.values())) if len(lenses) == 1 else None
    return ForeignRecording(
        name=name,
        robot=PoseNumbers.empty(labels),
        images=tuple(Path(path) for _, _, path in rows),
        store=BagImages(places, source),
        stamps_s=np.array([stamp_s for _, stamp_s, _ in rows]),
        mount=_mount(contents, [contents.images[topic].frame for topic in cameras], tip),
        lens=one,
        lenses={} if one is not None else lenses,
        robot_document=None if robot is None else robot.document,
        columns=columns,
        stream=stream,
        notes=tuple(notes),
    )


def _namespace(topic: str) -> str:
    """The beginning of the topics of one camera."""
    parts = topic.strip("/").split("/")
    endings = ("compressed", "image_raw", "image_rect", "image_color", "image_rect_color", "image")
    while parts and parts[-1] in (*endings, "camera_info"):
        parts.pop()
    return "/".join(parts)


def _cameras(contents: BagContents, requested: ImportOptions) -> dict[str, str]:
    """The topics of images to take, and the cameras' names; the only one has none."""
    topics = list(contents.images)
    if requested.image is not None:
        named = [name.strip() for name in requested.image.split(",")]
        for name in named:
            _check_named(name, topics, "--image-key")
        topics = named
    # Of one camera, raw images come before compressed ones, and unrectified before rectified ones.
    topics.sort(key=lambda name: ("compressed" in name, "rect" in name))
    first = {_namespace(topic): topic for topic in reversed(topics)}
    if len(first) == 1:
        return dict.fromkeys(first.values(), "")
    names = {space: space.replace("/", "_").replace("-", "_") or "cam" for space in first}
    return {topic: names[space] for space, topic in sorted(first.items())}


def _depths(
    contents: BagContents, topic: str, rows: Sequence[tuple[float, str]], notes: list[str]
) -> dict[str, tuple[str, tuple[str, int]]]:
    """Paths and places of depth, by the paths of a topic's images with their times [s]."""
    images, found = contents.images[topic], dict[str, tuple[str, tuple[str, int]]]()
    aligned = {
        name: depth
        for name, depth in contents.depths.items()
        if (depth.frame, depth.size) == (images.frame, images.size)
    }
    if not aligned:
        others = [f"{name} ({at.frame}, {at.size})" for name, at in contents.depths.items()]
        if others:
            notes.append(
                f"{topic} ({images.frame}, {images.size}): no depth is aligned to it: "
                f"{some_of(others, 6)}. Record aligned depth (realsense2_camera: "
                "align_depth.enable:=true)."
            )
        return found
    # Distances come before clouds, which are larger.
    name = min(aligned, key=lambda name: (aligned[name].ending == "npy", name))
    depth, stamps_s = aligned[name], np.array(aligned[name].stamps_s)
    # Depth of the same picture is nearer than the next one.
    limit_s = 0.5 * float(np.median(np.abs(np.diff(stamps_s)))) if len(stamps_s) > 1 else 0.05
    for stamp_s, path in rows:
        nearest = int(np.argmin(np.abs(stamps_s - stamp_s)))
        if abs(stamps_s[nearest] - stamp_s) <= limit_s:
            depth_path = str(
                Path(path.replace("images/", "depth/", 1)).with_suffix(f".{depth.ending}")
            )
            found[path] = depth_path, (name, depth.received_ns[nearest])
    notes.append(f"{topic}: {len(found)} of {len(rows)} images have depth by {name}.")
    return found


def _check_named(name: str, names: Sequence[str], option: str) -> None:
    known_name("", name, names, next_step=f"Say {option} with one of these.", of="The bag")


def _lens(contents: BagContents, topic: str, notes: list[str]) -> dict[str, Any]:
    """The fields of `[camera]` of a topic's images, by the CameraInfo beside it."""
    size = list(contents.images[topic].size)
    space = _namespace(topic)
    info = next((at for name, at in contents.lenses.items() if _namespace(name) == space), None)
    # ROS 1 has them in capitals.
    fields = {name.lower(): value for name, value in vars(info).items()} if info else {}
    if not np.any(fields.get("k", 0.0)):
        notes.append(f"{topic}: no CameraInfo states its lens, which is estimated.")
        return {"resolution": size}
    content = {
        "camera_matrix": np.reshape(fields["k"], (3, 3)).tolist(),
        "distortion_coefficients": np.asarray(fields["d"]).tolist(),
        "distortion_model": fields["distortion_model"] or "plumb_bob",
    }
    if "rect" in topic:
        content |= {"distortion_coefficients": [0.0] * 5, "distortion_model": "plumb_bob"}
    lens, more = intrinsics_from(content, f"{topic}: CameraInfo")
    notes += more
    return lens | {"resolution": size}


def _motion(
    contents: BagContents, requested: ImportOptions
) -> tuple[ForeignStream, str, str, Robot | None]:
    """The robot's motion, where it is from, the tip's frame in TF if any, and the robot's model."""
    names, tip = requested.robot.names, ""
    if len(names) == 1 and names[0] not in contents.poses:
        # One frame alone is no pose.
        others = [name for name in contents.parents if name != names[0]]
        _check_named(names[0], [*contents.poses, *others], "--robot-key BASE,TIP")
    is_named_pose = len(names) == 1
    if not is_named_pose and contents.moving:
        base, tip = names[:2] if len(names) > 1 else _ends(contents)
        stamps_s, poses = _between(contents, base, tip)
        words = f"{tip} in {base} by TF"
    elif is_named_pose or len(contents.poses) == 1:
        topic = names[0] if is_named_pose else next(iter(contents.poses))
        stamps_s, poses = _rows(contents.poses[topic])
        words = f"topic {topic}"
    else:
        stamps_s, poses, words = np.zeros(0), np.zeros((0, 4, 4)), ""
    joints_s, joints, robot = _joint_rows(contents, requested, tip)
    if robot is not None and not len(stamps_s):
        stamps_s, poses = joints_s, robot.base_from_flange(joints)
        words = f"joint angles through /robot_description up to {robot.tip}"
    if not len(stamps_s):
        raise DataError(
            "The bag does not say where the robot was: it has "
            f"{some_of([*contents.poses, *contents.joints]) or 'no poses'}, and neither TF of a "
            f"moving arm nor joints with /robot_description.{_refused(contents)}",
            culprits=[*contents.poses, *contents.joints],
            next_step="Name its poses: --robot-key TOPIC (of PoseStamped) or BASE,TIP (frames "
            "of TF); or record /tf, /tf_static and /robot_description, too.",
        )
    every_s = np.union1d(stamps_s, joints_s)
    found = np.full((len(every_s), 4, 4), np.nan)
    found[np.searchsorted(every_s, stamps_s)] = poses
    q = None
    if robot is not None:
        q = np.full((len(every_s), robot.joint_count), np.nan)
        q[np.searchsorted(every_s, joints_s)] = joints
    labels = tuple(f"sample {at}" for at in range(len(every_s)))
    return ForeignStream(every_s, PoseNumbers.of_poses(found, labels), q), words, tip, robot


def _table(values: "array[float]", width: int) -> FloatArray:
    """(m, width) rows that begin with their time, in the order of time, each time once."""
    table = np.frombuffer(values, dtype=float).reshape(-1, width)
    return np.asarray(table[np.unique(table[:, 0], return_index=True)[1]])


def _rows(values: "array[float]") -> tuple[FloatArray, FloatArray]:
    """(m,) times and (m, 4, 4) poses, in the order of time, each time once."""
    table = _table(values, 8)
    rotations = Rotation.from_quat(table[:, 4:])
    poses = RigidTransform.from_components(table[:, 1:4], rotations)
    return table[:, 0], np.asarray(poses.as_matrix())


def _ends(contents: BagContents) -> tuple[str, str]:
    """The frames of the arm's base and tip: the ends of the longest chain of moving frames."""

    def moves(link: tuple[str, str]) -> bool:
        return link[::-1] in contents.moving

    # Frames and those above them, as long as each moves in the next.
    chains = [
        [child, *(above for _, above in takewhile(moves, pairwise(contents.chain(child))))]
        for _, child in contents.moving
        if not any(parent == child for parent, _ in contents.moving)
    ]
    if not chains:
        raise DataError(
            f"The moving frames of TF go round: {some_of([*contents.parents], 6)}.",
            culprits=[*contents.parents],
            next_step="Name the base and the tip of the arm: --robot-key base_link,tool0",
        )
    longest = max(map(len, chains))
    pairs = [f"{chain[-1]},{chain[0]}" for chain in chains if len(chain) == longest]
    if len(pairs) > 1:
        raise DataError(
            f"TF has several moving chains of {longest - 1} joints: {some_of(pairs, 6)}.",
            culprits=[pair.partition(",")[2] for pair in pairs],
            next_step=f"Say which is the robot's: --robot-key {pairs[0]}",
        )
    tip, *_, base = max(chains, key=len)
    below = [name for name in contents.parents if tip in contents.chain(name)]
    above = contents.chain(base)
    return (
        next((name for name in _BASES if name in above), base),
        next((name for name in _TIPS if name in below), tip),
    )


def _refused(contents: BagContents) -> str:
    names = some_of(sorted(contents.refused), 6)
    return f" Rows of {names} are no poses, and were left out." if names else ""


def _between(contents: BagContents, base: str, tip: str) -> tuple[FloatArray, FloatArray]:
    """(m,) times and (m, 4, 4) `base_from_tip` by TF."""
    known = {*contents.parents, *contents.parents.values()}
    for name in (base, tip):
        _check_named(name, sorted(known), "--robot-key BASE,TIP")
    up, down = contents.chain(base), contents.chain(tip)
    common = next((name for name in up if name in down), "")
    sides = [chain[: chain.index(common) + 1] if common else [] for chain in (up, down)]
    links = {(parent, child) for side in sides for child, parent in pairwise(side)}
    moving = links & contents.moving.keys()
    if not moving:
        raise DataError(
            f"TF does not move {tip} in {base}{'' if common else ': nothing joins them'}.",
            culprits=[base, tip],
            next_step="Name the base and the tip of the arm: --robot-key base_link,tool0",
        )
    tracks = {link: Trajectory(*_rows(contents.moving[link])) for link in moving}
    # Timestamps of the least frequent transform; the others are interpolated.
    at_s = min((track.stamps_s for track in tracks.values()), key=len)
    at_s = at_s[np.all([track.covers(at_s) for track in tracks.values()], axis=0)]
    from_common = []
    for side in sides:
        pose = np.eye(4)[None]
        for child, parent in pairwise(side):
            track = tracks.get((parent, child))
            rows = contents.still.get((parent, child), array("d"))
            pose = (_rows(rows)[1] if track is None else track.at(at_s)) @ pose
        from_common.append(pose)
    poses = invert(from_common[0]) @ from_common[1]
    return at_s, np.broadcast_to(poses, (len(at_s), 4, 4))


def _joint_rows(
    contents: BagContents, requested: ImportOptions, tip: str
) -> tuple[FloatArray, FloatArray, Robot | None]:
    """(m,) times and (m, n) joint angles in the order of the bag's own robot model, and that."""
    none = np.zeros(0), np.zeros((0, 0)), None
    if not contents.descriptions or requested.robot_model is not None:
        return none
    document = {"schema": 1, "name": "robot", "urdf": contents.descriptions[0]}
    robot: Robot | None = None
    for end in filter(None, (requested.tip or tip, *_TIPS)):
        with suppress(VisioncalError):
            robot = Robot.from_document(document | {"tip": end})
            break
    topics = requested.joints or tuple(contents.joints)
    tables = [rows for topic in topics for rows in contents.joints.get(topic, {}).items()]
    for names, values in tables:
        if robot is not None and {*robot.joint_names} <= {*names}:
            table = _table(values, 1 + len(names))
            order = [1 + names.index(name) for name in robot.joint_names]
            return table[:, 0], table[:, order], robot
    return none


def _chosen(stamps_s: FloatArray, flange: Trajectory) -> tuple[IntArray, str]:
    """Numbers of the frames to take, as `frames_to_take` has them."""
    order = np.argsort(stamps_s, kind="stable")
    still = order[is_standing_still(flange, stamps_s[order])]
    poses = flange.at(stamps_s[still])
    # Another stop: a milliradian or a millimetre further.
    moved = np.abs(log(invert(poses[:-1]) @ poses[1:])).max(axis=1) > 1e-3
    return frames_to_take(order, still, moved, 600)


def _mount(contents: BagContents, frames: Sequence[str], tip: str) -> Mount | None:
    """How the cameras are mounted, where TF has their frames beside the arm's."""
    moving = {child for _, child in contents.moving}
    hands = {
        bool(moving & {*contents.chain(frame)}) for frame in frames if frame in contents.parents
    }
    if not tip or len(hands) != 1:
        return None
    return "eye-in-hand" if hands.pop() else "eye-to-hand"


BAG = ForeignFormat("bag", "a bag of ROS 1 or ROS 2 (.bag, .mcap, or its folder)", _is_bag, _read)
