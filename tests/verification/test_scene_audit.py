"""Moves of a camera in the episodes of a data set: named by episode and frame, and no other."""

import json

import cv2
import numpy as np
import pytest
from support.commands import visioncal
from support.lerobot import KEY
from support.scenes import CAMERA, Scene, disturbed, texture, turned

from visioncal.verification.scene_audit import Episode, assumed_camera, scene_moves

WIDTH, HEIGHT = CAMERA.resolution
LENGTH = 7


@pytest.fixture(scope="module")
def lights():
    """A scene before, after a small move, and after one that leaves nothing of it in the image."""
    scene = Scene(3)
    turns = (0.0, 0.0, 0.0), (0.1, -0.2, 0.1), (1.0, 60.0, 0.0)
    return [scene.light(turned(np.array(turn))) for turn in turns]


def frame(light, at, rng, grain):
    """The scene with an arm that turns before it, as no other frame shows it."""
    part, tip = np.zeros((HEIGHT, WIDTH), np.uint8), (240 + int(150 * np.cos(at)), 180)
    cv2.line(part, (240, HEIGHT), tip, 1, 45)
    return disturbed(np.where(part > 0, grain[:HEIGHT, :WIDTH], light), rng, bright=(0.9, 1.1))


def episodes(lights, courses):
    """Episodes, each with the lights of its frames by number."""
    rng = np.random.default_rng(4)
    grain = texture(rng)
    return [
        [frame(lights[each], 0.3 * at, rng, grain) for at, each in enumerate(course)]
        for course in courses
    ]


def moves(shown, **options):
    """Episode and frame of each move that is found."""
    source = [
        Episode(f"{number}", len(frames), frames.__getitem__) for number, frames in enumerate(shown)
    ]
    camera = assumed_camera(shown[0][0])
    return [
        (int(move.episode.name), move.frame, move.found.reason == "")
        for move in scene_moves(source, camera, **options)
    ]


@pytest.mark.slow
def test_a_camera_that_stood_still_is_not_accused(lights):
    # Noise, light and an arm that moves are in every frame.
    assert moves(episodes(lights, [[0] * LENGTH] * 4)) == []


@pytest.mark.slow
@pytest.mark.parametrize("at", [0, 5, LENGTH - 1])
def test_a_move_is_named_by_its_frame(lights, at):
    courses = [[0] * LENGTH, [0] * at + [1] * (LENGTH - at), [1] * LENGTH, [1] * LENGTH]
    assert moves(episodes(lights, courses)) == [(1, at, True)]


@pytest.mark.slow
def test_a_camera_that_looks_elsewhere_and_back_moved_twice(lights):
    courses = [[0] * LENGTH, [0] * 5 + [2] * 2, [2] * LENGTH, [0] * LENGTH, [0] * LENGTH]
    assert moves(episodes(lights, courses)) == [(1, 5, False), (3, 0, False)]


@pytest.mark.slow
def test_a_hand_before_the_camera_is_no_move(lights):
    shown = episodes(lights, [[0] * LENGTH] * 4)
    shown[1] = [np.full_like(shown[1][0], 9) for _ in shown[1]]
    assert moves(shown) == []


def written(folder, shown):
    """A folder of videos, and of pictures for the last episode."""
    folder.mkdir()
    for number, frames in enumerate(shown[:-1]):
        code = cv2.VideoWriter.fourcc(*"mp4v")
        video = cv2.VideoWriter(str(folder / f"{number}.mp4"), code, 10.0, (WIDTH, HEIGHT))
        for image in frames:
            video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        video.release()
    (folder / "last").mkdir()
    for number, image in enumerate(shown[-1]):
        cv2.imwrite(str(folder / f"last/{number}.png"), image)
    return folder


def test_the_command_names_each_move(lights, tmp_path):
    courses = [[0] * LENGTH, [0] * 4 + [1] * 3, [1] * LENGTH]
    folder = written(tmp_path / "set", episodes(lights, courses))
    done = visioncal("audit", folder)
    assert done.status == 3
    assert done.out.startswith("1.mp4, frame 4 (0.4 s): the camera moved: the image's middle by ")
    assert "1 move in 3 episodes, 21 frames" in done.out
    (found,) = json.loads(visioncal("audit", folder, "--json").out)["moves"]
    assert (found["episode"], found["frame"]) == ("1.mp4", 4)
    # By the true lens: 2.0 px and 0.24 deg; a lens that is assumed makes the turn a few per cent.
    assert np.linalg.norm(found["turn_deg"]) == pytest.approx(np.sqrt(0.06), rel=0.15)
    visioncal("audit", folder, "--image-key", "0.mp4").good()
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((10, 20), 255, np.uint8))
    visioncal("audit", folder, "--mask", tmp_path / "mask.png").refused("20 x 10 px")
    visioncal("audit", folder, "--image-key", "wrist").refused("no episodes of wrist")
    visioncal("audit", folder / "last").good()
    visioncal("audit", tmp_path / "none").refused("none")


@pytest.mark.slow
def test_a_data_set_of_lerobot_is_read_by_its_episodes(lights, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    table = pytest.importorskip("pyarrow").table
    courses = [[0] * LENGTH, [0] * 3 + [1] * 4, [1] * LENGTH]
    shown = episodes(lights, courses)
    cells = [
        {"bytes": cv2.imencode(".png", image)[1].tobytes(), "path": ""}
        for frames in shown
        for image in frames
    ]
    (tmp_path / "meta").mkdir()
    info = {"features": {KEY: {"dtype": "image"}}, "fps": 10}
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    (tmp_path / "data/chunk-000").mkdir(parents=True)
    numbers = {"episode_index": np.repeat([0, 1, 2], LENGTH), KEY: cells}
    parquet.write_table(table(numbers), tmp_path / "data/chunk-000/file-000.parquet")
    done = visioncal("audit", tmp_path)
    assert done.out.startswith("episode 1, frame 3 (0.3 s): the camera moved")
    visioncal("audit", tmp_path, "--image-key", "observation.images.top").refused("no images")
