"""Converts damaged recordings within bounded memory, and says how each ended; run as a script.

Usage: python foreign_damage.py FOLDER COUNT
"""

import io
import json
import pickle
import random
import resource
import shutil
import sys
import traceback
import zipfile
from pathlib import Path

import numpy as np
from support.foreign_samples import MORE_RECORDINGS, RECORDINGS, Recording

from visioncal.core.errors import DataError
from visioncal.interchange.formats import convert

# Over what the libraries themselves take: a few copies of a file of the largest size read.
ROOM_BYTES = 700_000_000


class Bomb:
    """What a pickle would do: leave a file behind."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return (open, (self.path, "w"))


def truncated(data, chance):
    return data[: chance.randrange(len(data) + 1)]


def flipped(data, chance):
    changed = bytearray(data)
    for _ in range(chance.randrange(1, 30)):
        changed[chance.randrange(len(changed))] = chance.randrange(256)
    return bytes(changed)


def _number_replaced(data, chance, words):
    places = [at for at, byte in enumerate(data) if chr(byte).isdigit()]
    if not places:
        return data
    at = chance.choice(places)
    return data[:at] + words + data[at + 1 :]


def huge_number(data, chance):
    return _number_replaced(data, chance, b"9" * chance.choice([10, 400, 6000]))


def odd_number(data, chance):
    words = [
        b"nan",
        b".nan",
        b"inf",
        b"1e999",
        b"-",
        b"0x1",
        b"null",
        b"true",
        b'"x"',
        b"[]",
        b"{}",
    ]
    return _number_replaced(data, chance, chance.choice(words))


def line_doubled(data, chance):
    lines = data.split(b"\n")
    at = chance.randrange(len(lines))
    return b"\n".join([*lines[:at], lines[at], *lines[at:]])


def line_lost(data, chance):
    lines = data.split(b"\n")
    del lines[chance.randrange(len(lines))]
    return b"\n".join(lines)


def part_moved(data, chance):
    a, b = sorted(chance.randrange(len(data) + 1) for _ in range(2))
    return data[b:] + data[a:b] + data[:a]


def deep(data, chance):
    opening = chance.choice([b"[", b'{"a":', b"- ", b"<a>", b"(", b"{a: "])
    return data[: chance.randrange(len(data) + 1)] + opening * chance.choice([100, 100_000])


def binary(_, chance):
    return chance.randbytes(chance.choice([1, 100, 100_000]))


def nothing(_, chance):
    return chance.choice([b"", b"\n", b"\0" * 100, b"# only a comment\n"])


def other_encoding(data, chance):
    text = data.decode("latin-1")
    return text.encode(chance.choice(["utf-16", "utf-32"])) + b"\xff\xfe\xe9"


def repeated(data, chance):
    return data * chance.choice([2, 200])


def many_cells(_, chance):
    return chance.choice([b"1,", b"[],", b"1 ", b"a: 1\n", b"- 1\n", b"<a/>"]) * 3_000_000


def laughs(_, chance):
    yaml = b"a: &a [1,1,1,1,1,1,1,1,1]\n" + b"".join(
        b"%c: &%c [*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c]\n" % (at + 1, at + 1, *([at] * 8))
        for at in range(ord("a"), ord("m"))
    )
    xml = b'<!DOCTYPE l [<!ENTITY a "aaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;">]><r>&b;</r>'
    outside = b'<!DOCTYPE l [<!ENTITY a SYSTEM "file:///etc/passwd">]><r>&a;</r>'
    return chance.choice([yaml, xml, outside])


def constructor(data, chance):
    tags = [
        b"!!python/object/apply:os.system ['touch executed']",
        b"!!python/name:os.system x",
        b"!!opencv-matrix {rows: 100000, cols: 100000, dt: d, data: [1]}",
        b"!!opencv-matrix {rows: -1, cols: 1.5, dt: 9999d, data: {}}",
        b"!!binary aGVsbG8=",
    ]
    at = data.find(b": ") + 2
    return data[:at] + chance.choice(tags) + b"\n" + data[at:]


def lying_array(_, chance):
    file = io.BytesIO()
    if chance.random() < 0.5:
        header = "{'descr': '<f8', 'fortran_order': False, 'shape': (%s,), }" % (10**12)
        np.save(file, np.zeros(3))
        data = bytearray(file.getvalue())
        return bytes(data[:10]) + header.ljust(118).encode() + bytes(data[128:])
    np.save(file, np.array([Bomb("executed")], dtype=object), allow_pickle=True)
    return file.getvalue()


def zip_bomb(_, chance):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for at in range(chance.choice([1, 3])):
            archive.writestr(f"R_gripper2base{at}.npy", b"\0" * 60_000_000)
    return file.getvalue()


def pickled(_, chance):
    return pickle.dumps(Bomb("executed"), protocol=chance.choice([0, 4]))


def not_a_file(data, chance):
    del data, chance


COMMON = (
    truncated,
    flipped,
    huge_number,
    odd_number,
    line_doubled,
    line_lost,
    part_moved,
    deep,
    binary,
    nothing,
    other_encoding,
    repeated,
    constructor,
    laughs,
    pickled,
    lying_array,
    not_a_file,
)
# These take a second each.
RARE = (many_cells, zip_bomb)


def damage(recording: Recording, kind, chance) -> Path:
    """Damages one file of a recording, and says which."""
    source = recording.source
    files = [source] if source.is_file() else [path for path in source.rglob("*") if path.is_file()]
    files += [path for path in (recording.requested.camera_file,) if path is not None]
    files += [Path(name) for name in (recording.requested.intrinsics,) if name is not None]
    texts = sorted(file for file in files if file.suffix != ".png") or files
    path = chance.choice(texts)
    data = kind(path.read_bytes() or b"0", chance)
    path.unlink()
    if data is None:
        path.mkdir()
    else:
        path.write_bytes(data)
    return path


def ending(recording: Recording, dest: Path) -> str:
    """Converts, and says how it ended."""
    try:
        convert(recording.source, dest, requested=recording.requested)
    except DataError as error:
        return "" if str(error).strip() and len(str(error)) < 1500 else f"message: {error}"[:300]
    except BaseException:  # noqa: BLE001 - what escapes is what is looked for
        return traceback.format_exc(limit=-4)
    return "session"


def main(folder: Path, count: int) -> None:
    chance = random.Random(20)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM_BYTES, used + ROOM_BYTES))
    wrong, sessions = [], 0
    makers = list((RECORDINGS | MORE_RECORDINGS).items())
    for at in range(count):
        name, make = makers[at % len(makers)]
        rare = at % 50 == 49
        kind = chance.choice(RARE if rare else COMMON)
        place = folder / f"{at:03d}"
        recording = make(place / "in")
        path = damage(recording, kind, chance)
        end = ending(recording, place / "out")
        if end == "session":
            sessions += 1
        elif end:
            wrong.append(f"{at}: {name}, {kind.__name__} in {path.name}: {end}")
        shutil.rmtree(place)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    grown = (peak - before) / 1e3
    print(json.dumps({"wrong": wrong, "sessions": sessions, "count": count, "grown_mb": grown}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
