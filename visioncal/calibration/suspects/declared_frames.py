"""Cameras and boards that another robot carries than the frames of a session declare."""

from collections import defaultdict
from collections.abc import Iterable, Iterator

import numpy as np

from visioncal.calibration.guess.fit import is_about_one_axis
from visioncal.calibration.guess.recording import FEWEST_ROWS
from visioncal.calibration.pipeline.guess_inputs import chain_fit
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cell import stops_by_view
from visioncal.calibration.stages.robots import CameraTargetPair
from visioncal.core.number_format import robot_words
from visioncal.core.types import MOUNTS, FloatArray
from visioncal.core.verdict import Finding, calibrating
from visioncal.session import frame_name
from visioncal.session.kinds import is_camera_observation
from visioncal.vision.pnp import ViewPoses


def _poses_at(run: RunState, robot: str, views: Iterable[int]) -> dict[int, FloatArray]:
    """(4, 4) poses of a robot at the stops of some views; empty where it hardly turned there."""
    stops = stops_by_view(run.session)
    by_stop = {stops[view]: pose for view, pose in run.robots[robot].base_from_flange.items()}
    poses = {view: by_stop[stops[view]] for view in views if stops[view] in by_stop}
    # A robot that waited, or turned about one axis, agrees with much.
    turns = np.array([pose[:3, :3] for pose in poses.values()]).reshape(-1, 3, 3)
    return {} if len(turns) < FEWEST_ROWS or is_about_one_axis(turns) else poses


def carried(run: RunState) -> Iterator[Finding]:
    """The finding that a robot carries a camera or a target that [frames] declares to be fixed."""
    fixed = defaultdict[tuple[str, str], dict[int, ViewPoses]](dict)
    for row in run.timed.observations:
        if is_camera_observation(row.view) and not (row.robots or row.missing_robots):
            seen = {row.view.number} & run.poses.keys()
            fixed[row.seer, row.seen] |= {view: run.poses[view] for view in seen}
    for (seer, seen_frame), poses in fixed.items():
        for robot in run.robots:
            flanges = _poses_at(run, robot, poses)
            for frame, mount in zip((seer, seen_frame), MOUNTS, strict=True):
                found = chain_fit(flanges, poses, mount)
                if found is not None and found.closes:
                    yield _declared_elsewhere(
                        frame,
                        robot,
                        f"{frame} moves with {robot_words(robot)}, and does not stand still as "
                        "[frames] declares: on its flange, robot and camera agree to "
                        f"{found.figures}.",
                    )


def _declared_elsewhere(frame: str, robot: str, words: str) -> Finding:
    do = f'Write {frame} = "{frame_name("flange", robot)}" in [frames] of session.toml, and'
    return Finding("misread_poses", words, calibrating(do))


def on_another(run: RunState, robot: str, pair: CameraTargetPair) -> Finding | None:
    """The finding that a camera or a target is on another robot's flange than is declared."""
    declared = chain_fit(run.robots[robot].base_from_flange, pair.poses, pair.mount)
    for other in (name for name in run.robots if name != robot):
        found = chain_fit(_poses_at(run, other, pair.poses), pair.poses, pair.mount)
        if found is not None and declared is not None and found.closes:
            frame = pair.camera if pair.mount == "eye-in-hand" else pair.target
            return _declared_elsewhere(
                frame,
                other,
                f"{frame} is on robot {other}, and not on robot {robot} as [frames] declares: "
                f"with the poses of robot {other}, robot and camera agree to {found.figures}, "
                f"with those of robot {robot} to {declared.figures}.",
            )
    return None
