"""Data sets of LeRobot, versions 2 and 3, of a session with joint angles."""

import json
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from visioncal.session import Session

KEY, FPS, REST, WAY = "observation.images.wrist", 10, 12, 6
_PATHS = {
    "v2.1": (
        "data/chunk-000/episode_000000.parquet",
        "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
    ),
    "v3.0": (
        "data/chunk-000/file-000.parquet",
        "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
    ),
}
_ZEROS = {"episode_chunk": 0, "episode_index": 0, "chunk_index": 0, "file_index": 0}


def write_dataset(folder: Path, session: Session, images: Path, version: str, robot: str) -> Path:
    """Writes a data set whose arm stands at each view, and moves on to the next."""
    stops = np.array([view.joints_rad for view in session.views])
    rows, shown = [], []
    for view, joints, next_joints in zip(
        session.views, stops, [*stops[1:], stops[-1]], strict=True
    ):
        ways = np.linspace(0.0, 1.0, WAY)[:, None]
        rows += [*np.tile(joints, (REST, 1)), *(joints + (next_joints - joints) * ways)]
        shown += [view.image] * (REST + WAY)
    state = np.rad2deg(np.array(rows)) + np.random.default_rng(0).normal(0.0, 1e-3, (len(rows), 1))
    state = np.column_stack([state, np.zeros(len(state))]).astype(np.float32)
    names = [*(f"joint_{at}.pos" for at in range(stops.shape[1])), "gripper.pos"]
    data, video = _PATHS[version]
    info = {
        "codebase_version": version, "robot_type": robot, "fps": FPS, "total_episodes": 1,
        "chunks_size": 1000, "data_path": data, "video_path": video,
        "features": {"observation.state": {"dtype": "float32", "names": names},
                     KEY: {"dtype": "video"}},
    }  # fmt: skip
    count = np.arange(len(state))
    columns = {"observation.state": list(state), "timestamp": count / FPS, "frame_index": count}
    tables = {data: columns | {"episode_index": np.zeros(len(state), int)}}
    if version == "v3.0":
        of_video = {f"videos/{KEY}/{name}": [0] for name in ("chunk_index", "file_index")}
        of_video[f"videos/{KEY}/from_timestamp"] = [0.0]
        tables["meta/episodes/chunk-000/file-000.parquet"] = {"episode_index": [0]} | of_video
    for name, table in tables.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(table), folder / name)
    (folder / "meta").mkdir(exist_ok=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    film = folder / video.format(video_key=KEY, **_ZEROS)
    film.parent.mkdir(parents=True)
    frames = {name: cv2.imread(str(images / name)) for name in dict.fromkeys(shown)}
    size = next(iter(frames.values())).shape[1::-1]
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"mp4v"), FPS, size)
    for name in shown:
        writer.write(frames[name])
    writer.release()
    return folder
