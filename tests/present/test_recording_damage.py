"""Recordings that were cut or damaged: refused, or the same to the last bit."""

import os
import random

import pytest
from support.kept import assert_same, assert_same_evidence
from support.samples import made_up

from visioncal.core.errors import DataError
from visioncal.present.recording import paths, read_calibration, read_evidence, write_recording
from visioncal.present.recording.reader import chunks
from visioncal.session import Session


@pytest.fixture(scope="module")
def sample():
    return made_up()


@pytest.fixture(scope="module")
def recorded(sample, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    write_recording(path, sample.session, sample.calibration, sample.evidence, None)
    return path


def test_a_cut_recording_is_refused(recorded, tmp_path):
    rng, data, cut = random.Random(3), recorded.read_bytes(), tmp_path / "cut.rrd"
    for size in (12, 13, len(data) - 20, *(rng.randrange(len(data)) for _ in range(30))):
        # A loss of power leaves zeros.
        for rest in (b"", bytes(len(data) - size)):
            cut.write_bytes(data[:size] + rest)
            with pytest.raises(DataError, match=r"cut\.rrd (was cut off|is no recording)"):
                Session.load(cut)


def test_flipped_bytes_in_images_are_named(sample, recorded, tmp_path):
    rng, broken = random.Random(4), tmp_path / "broken.rrd"
    for _ in range(20):
        view = rng.choice(sample.session.views)
        content = sample.session.images.read(view.image)
        # A PNG cannot be compressed further, so that most of it lies in the file as it is.
        place, data = -1, bytearray(recorded.read_bytes())
        while place < 0:
            start = rng.randrange(len(content) - 16)
            place = data.find(content[start : start + 16])
        data[place + rng.randrange(16)] ^= 1 << rng.randrange(8)
        broken.write_bytes(data)
        with pytest.raises(DataError, match="SHA-256") as error:
            Session.load(broken)
        assert error.value.culprits == (view.image,)


@pytest.mark.parametrize("entity", [paths.SESSION, paths.IMAGE, paths.CALIBRATION])
def test_no_flipped_bit_changes_anything_silently(entity, sample, recorded, tmp_path):
    rng, broken = random.Random(5), tmp_path / "broken.rrd"
    frames = [frame for frame, _, _ in chunks(recorded, (entity,))]
    refused = 0
    for _ in range(40):
        frame = rng.choice(frames)
        data = bytearray(recorded.read_bytes())
        # The 16 bytes before the payload are the message's kind and length.
        data[rng.randrange(frame.offset - 16, frame.end)] ^= 1 << rng.randrange(8)
        broken.write_bytes(data)
        try:
            assert_same(sample.session, Session.load(broken))
            calibration = read_calibration(broken)
            assert calibration is not None
            assert calibration.text == sample.calibration.text
            assert_same_evidence(sample.evidence, read_evidence(broken))
        except DataError:
            refused += 1
    # Bits that mean nothing are in the padding, and in times of day that nobody reads.
    assert refused > 10


def test_changed_result_leaves_the_session(sample, recorded, tmp_path):
    data, path = recorded.read_bytes(), tmp_path / "changed.rrd"
    assert data.count(b"2026-11-20T10:11:12") == 1
    path.write_bytes(data.replace(b"2026-11-20T10:11:12", b"2026-11-20T10:11:13"))
    with pytest.raises(DataError, match="its result cannot be read or was changed"):
        read_calibration(path)
    assert_same(sample.session, Session.load(path))


def test_a_pipe_is_no_recording(tmp_path):
    os.mkfifo(tmp_path / "pipe.rrd")
    with pytest.raises(DataError, match="is no regular file"):
        Session.load(tmp_path / "pipe.rrd")
