"""Recordings that were cut, damaged, or left by a process that died."""

import os
import random
import struct
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from support.kept import assert_same, cells
from support.samples import Sample, made_up

from visioncal.core.errors import DataError
from visioncal.present.recording import RecordingWriter, paths, read_calibration, read_session
from visioncal.present.recording.reader import chunks
from visioncal.present.recording.rrd_messages import MessageFrame, scan
from visioncal.present.viewer import blueprint
from visioncal.session import MemoryImages, Session


@dataclass(frozen=True)
class Recorded:
    """A recording, and how long it was when its declaration and each of its views were written."""

    path: Path
    data: bytes
    declared: int
    written: tuple[int, ...]
    results: int


@pytest.fixture(scope="module")
def sample() -> Sample:
    return made_up()


@pytest.fixture(scope="module")
def recorded(sample: Sample, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    session, sizes = sample.session, []
    with RecordingWriter(
        path, session, announced=len(session.views), blueprint=blueprint(session)
    ) as writer:
        sizes.append(path.stat().st_size)
        for view in session.views:
            writer.add_view(cells(session, view), session.images.read(view.image))
            sizes.append(path.stat().st_size)
        writer.add_results(session, sample.calibration, sample.evidence)
        results = path.stat().st_size
    return Recorded(path, path.read_bytes(), sizes[0], tuple(sizes[1:]), results)


def placed(recorded: Recorded, entity: str) -> list[MessageFrame]:
    return [frame for frame, _, _ in chunks(scan(recorded.path), (entity,), [])]


def test_every_complete_view_before_a_cut_is_there(
    sample: Sample, recorded: Recorded, tmp_path: Path
) -> None:
    rng = random.Random(3)
    places = [rng.randrange(recorded.declared, len(recorded.data)) for _ in range(40)]
    # The edges of what was written, and the views themselves, which are a third of the file.
    places += [rng.randrange(recorded.declared, recorded.written[-1]) for _ in range(15)]
    places += [size + step for size in recorded.written[:3] for step in (-1, 0, 1)]
    cut = tmp_path / "cut.rrd"
    for size in places:
        cut.write_bytes(recorded.data[:size])
        session = Session.load(cut)
        views = sum(end <= size for end in recorded.written)
        assert_same(replace(sample.session, views=sample.session.views[:views]), session)
        assert session.warnings[-1].startswith("cut.rrd: ")
        lost = len(sample.session.views) - views
        assert not lost or f"{lost} of 9 views are lost" in session.warnings[-1]


def test_cut_before_the_end_of_the_declaration_is_refused(
    recorded: Recorded, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.rrd"
    (declaration,) = placed(recorded, paths.SESSION)
    for size in (12, 13, 40, declaration.offset, declaration.end - 1):
        cut.write_bytes(recorded.data[:size])
        with pytest.raises(DataError, match="before the session's declaration was complete"):
            read_session(cut)


def test_lost_results_do_not_touch_the_session(
    sample: Sample, recorded: Recorded, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.rrd"
    cut.write_bytes(recorded.data[: (recorded.written[-1] + recorded.results) // 2])
    session = read_session(cut)
    assert_same(sample.session, session)
    assert "not closed, but all 9 views are complete" in session.warnings[-1]
    assert read_calibration(cut) is None


def test_zeros_that_a_loss_of_power_left_are_a_cut(recorded: Recorded, tmp_path: Path) -> None:
    cut = tmp_path / "cut.rrd"
    size = recorded.written[5]
    cut.write_bytes(recorded.data[:size] + bytes(len(recorded.data) - size))
    assert len(read_session(cut).views) == 6


def test_flipped_bytes_in_images_are_named(
    sample: Sample, recorded: Recorded, tmp_path: Path
) -> None:
    rng = random.Random(4)
    broken = tmp_path / "broken.rrd"
    for _ in range(30):
        view = rng.choice(sample.session.views)
        content = sample.session.images.read(view.image)
        # A PNG cannot be compressed further, so that most of it lies in the file as it is.
        place = -1
        while place < 0:
            start = rng.randrange(len(content) - 16)
            place = recorded.data.find(content[start : start + 16])
        data = bytearray(recorded.data)
        data[place + rng.randrange(16)] ^= 1 << rng.randrange(8)
        broken.write_bytes(data)
        with pytest.raises(DataError, match="SHA-256") as error:
            Session.load(broken)
        assert error.value.culprits == (view.image,)


@pytest.mark.parametrize("entity", [paths.SESSION, paths.ROWS, paths.IMAGE, paths.END])
def test_no_flipped_bit_changes_a_session_silently(
    entity: str, sample: Sample, recorded: Recorded, tmp_path: Path
) -> None:
    rng = random.Random(5)
    broken = tmp_path / "broken.rrd"
    refused = 0
    frames = placed(recorded, entity)
    for _ in range(40):
        frame = rng.choice(frames)
        data = bytearray(recorded.data)
        # The 16 bytes before the payload are the message's kind and length.
        data[rng.randrange(frame.offset - 16, frame.end)] ^= 1 << rng.randrange(8)
        broken.write_bytes(data)
        try:
            session = Session.load(broken)
        except DataError:
            refused += 1
        else:
            assert_same(sample.session, session)
    # Bits that mean nothing are in the padding, and in times of day that nobody reads.
    assert refused > 10 or entity == paths.END


def test_changed_number_is_noticed(sample: Sample, recorded: Recorded, tmp_path: Path) -> None:
    number = struct.pack("<d", sample.session.views[5].numbers["qy"])
    other = struct.pack("<d", -sample.session.views[5].numbers["qy"])
    assert number in recorded.data
    broken = tmp_path / "broken.rrd"
    broken.write_bytes(recorded.data.replace(number, other))
    with pytest.raises(DataError, match="row 6 of the table") as error:
        read_session(broken)
    assert error.value.culprits == ("row 6",)


KILLED = """
import sys
from pathlib import Path
from support.samples import made_up
from support.kept import cells
from visioncal.present.recording import RecordingWriter

session = made_up().session
with RecordingWriter(Path(sys.argv[1]), session) as writer:
    for view in session.views[:5]:
        writer.add_view(cells(session, view), session.images.read(view.image))
    print("written", flush=True)
    sys.stdin.read()
"""


def test_killed_process_loses_no_view_that_it_added(sample: Sample, tmp_path: Path) -> None:
    path = tmp_path / "killed.rrd"
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == b"written"
        process.kill()
    session = read_session(path)
    assert_same(replace(sample.session, views=sample.session.views[:5]), session)
    assert "not closed" in session.warnings[-1]
    assert "5 views are complete" in session.warnings[-1]


def small(views: Sequence[Sequence[str]] = ()) -> Session:
    document = {"schema": 1, "name": "small", "mount": "eye-in-hand", "camera": {}}
    document["target"] = "charuco_9x6_30mm"
    return Session.assemble(document, ["view", "image", "stamp_s"], views, MemoryImages({}))


@pytest.mark.parametrize(
    ("row", "image", "words"),
    [
        (["1", "b.png", "2"], b"b", "view 1 is already there"),
        (["2", "a.png", "2"], b"b", r"another image is already there by the name a\.png"),
        (["2", "b.png", "soon"], b"b", "'soon' is no finite number"),
        (["2", "../b.png", "2"], b"b", "leaves the session's folder"),
        (["2", "b.png"], b"b", "it has 2 fields"),
    ],
)
def test_view_that_could_not_be_read_again_is_refused(
    row: list[str], image: bytes, words: str, tmp_path: Path
) -> None:
    path = tmp_path / "small.rrd"
    first = ["1", "a.png", "1.5"]
    with RecordingWriter(path, small()) as writer:
        writer.add_view(first, b"a")
        with pytest.raises(DataError, match=words):
            writer.add_view(row, image)
    session = read_session(path)
    assert [view.number for view in session.views] == [1]
    assert session.warnings == small().warnings


def test_error_leaves_an_open_recording_and_never_replaces_one(tmp_path: Path) -> None:
    path = tmp_path / "small.rrd"

    def interrupted() -> None:
        with RecordingWriter(path, small(), announced=3) as writer:
            writer.add_view(["1", "a.png", ""], b"a")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert "2 of 3 views are lost" in read_session(path).warnings[-1]
    with pytest.raises(DataError, match=r"small\.rrd cannot be written: File exists"):
        RecordingWriter(path, small())


def test_a_pipe_is_no_recording(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.rrd")
    with pytest.raises(DataError, match="is no regular file"):
        read_session(tmp_path / "pipe.rrd")
