"""Runs every command that reads files on inputs with one thing broken, and says what went wrong.

A mutant is a number: it says which reading of a command is taken, and by chance what of its input
is broken.
"""

import io
import json
import os
import random
import re
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path
from unittest.mock import patch

from support import bags, foreign_samples, lerobot
from support.commands import Done, every_command, visioncal
from support.fuzz import spoken
from support.fuzz.looks import write_looks
from support.fuzz.mutators import mutate

from visioncal.cli import console
from visioncal.core.errors import VisioncalError
from visioncal.present import viewer
from visioncal.session import Session


def _bag(path: Path, folder: Path, form: str) -> None:
    options = bags.BagOptions(form, is_compressed=True, frames_s=0.8)
    bags.write_bag(path, Session.load(folder), folder, options)


def _data_set(path: Path, folder: Path, version: str) -> None:
    lerobot.write_dataset(path, Session.load(folder), folder, version, "ur10e_follower")


# What one mutant may take [s], and the most memory of its process [kB], libraries included.
LONGEST_S, MOST_KB = 300, 2 * 1024**2
# A page of text; longer messages are no message.
_MOST_LETTERS = 4000

# Sound inputs by the command that makes each: IT is where, [name] another one.
_PLAN = "--stops 3 --guess-deg 2 --cam '0 -60 60 0 0 0' --board '500 0 5 180 0 0' --candidates 20"
_LENS = "--target charuco_9x6_30mm --camera 1000,1000,640,400 --resolution 1280,800"
MADE = {
    "board": "simulate IT --views 7 --no-with-intrinsics",
    "held": "simulate IT --views 7 --mount eye-to-hand",
    "pairs": "simulate IT --no-images --views 12 --touches",
    "arm": "simulate IT --no-images --views 30 --arm-sigma-mm 0.5 --arm-sigma-mrad 1",
    "sweep": "simulate IT --sweep",
    "warm": "simulate IT --warm-up",
    "tracked": "simulate IT --instrument points",
    "network": "simulate IT --no-images --cell two-arms",
    "motions": "simulate IT --torques",
    "loaded": "simulate IT --torques --payload-kg 2.8",
    "empty_currents": "simulate IT --torques --currents",
    "loaded_currents": "simulate IT --torques --currents --payload-kg 2.8",
    **{f"{name}.rrd": f"convert [{name}] IT" for name in ("board", "pairs")},
    **{f"{name}_out": f"calibrate [{name}] -o IT"
       for name in ("pairs", "board", "held", "arm", "warm", "network")},
    "dynamics_out": "dynamics identify [motions] -o IT",
    "plan": f"plan ur5e {_PLAN} {_LENS} -o IT",
    "frames.json": "tcp [pairs/touches.csv] -o IT --name tool",
    "site.db": "history IT --add [pairs_out]",
    "arm.json": "export [arm_out] --to robot-json -o IT",
    "arm.urdf": "export [arm_out] --to robot-urdf -o IT",
    "lens.yaml": "export [board_out] --to camera-info -o IT",
    "guard.json": "guard --against [pairs_out] --state IT < [pairs.jsonl]",
}  # fmt: skip
# Sound inputs that are written from a session: which, and by what.
WRITTEN: dict[str, tuple[str, Callable[[Path, Path], object]]] = {
    **{f"{name}.jsonl": (name, write_looks) for name in ("pairs", "arm")},
    "typed.txt": ("board", spoken.write_typed),
    "stops.txt": ("board", spoken.write_stops),
    "requests.http": ("board", spoken.write_requests),
    "checks": ("board", spoken.write_checks),
    **{f"bags/{name}": ("board", partial(_bag, form=form))
       for name, form in (("ros1.bag", "ros1"), ("mcap", "mcap"), ("sqlite3", "sqlite3"))},
    **{f"lerobot/{version}": ("board", partial(_data_set, version=version))
       for version in ("v2.1", "v3.0")},
}  # fmt: skip
PACKAGED = {
    "arm.toml": "visioncal/robot/models/ur10e.toml", "board.toml": "targets/charuco_9x6_30mm.toml"
}  # fmt: skip

_HAND = "NEW --mount eye-in-hand"
_SHOTS = f"{_HAND} --target {foreign_samples.CHARUCO} --robot-key x,y,z,qw,qx,qy,qz"
_KUKA = "--robot-key X,Y,Z,A,B,C --robot-form kuka --camera-key " \
    "cam_x,cam_y,cam_z,cam_qx,cam_qy,cam_qz,cam_qw"  # fmt: skip
_LIVE = "--camera folder:[board]/images --target charuco_9x6_30mm --views 3"
_PAGE = "--page --address 127.0.0.1:PORT"
_STOOD = "--pose 0.5,0.1,0.4,0,1,0,0"
# How each command is called: {name} is the input that is broken, one of several; [name] another
# sound one, OUT an earlier result's folder, NEW a path where nothing is. What stands behind < is
# said to it: on its stdin, or at PORT, a free one, as a robot's program or a browser.
READINGS = tuple(
    f"{before}{{{name}}}{after}"
    for before, names, after in (re.split("[{}]", words) for words in (
        "calibrate {board|held|pairs|arm|sweep|warm|tracked|network|board.rrd|pairs.rrd} -o OUT",
        "calibrate {pairs} -o OUT --json",
        "doctor {board|pairs|arm}",
        "touch-test {board} -c [board_out] --tool none --clearance-mm 300",
        "show {pairs_out|board_out|network_out|warm_out} -o OUT/report.html",
        "show {pairs_out|plan|board.rrd} --viewer",
        "verify {pairs} --against [pairs_out] -o NEW",
        "verify [pairs] --against {pairs_out} -o NEW",
        "verify {board} --against [board_out]",
        "guard --against {board_out|arm_out}",
        "guard --against [pairs_out] < {pairs.jsonl}",
        "guard --against [arm_out] < {arm.jsonl}",
        "guard --against {pairs_out} < [pairs.jsonl]",
        "guard --against [pairs_out] --state {guard.json} < [pairs.jsonl]",
        f"record -o NEW --arm manual {_LIVE} < {{typed.txt}}",
        f"record -o NEW --arm socket:PORT {_LIVE} < {{stops.txt}}",
        f"record -o NEW {_PAGE} < {{requests.http}}",
        f"record -o {{board}} {_PAGE} --arm manual {_LIVE} < [requests.http]",
        f"verify {{checks}} --against [pairs_out] {_PAGE} < [requests.http]",
        f"verify [checks] --against {{pairs_out}} {_PAGE} < [requests.http]",
        "recover NEW --against {pairs_out} --stops [pairs] --count 9",
        "recover NEW --against [pairs_out] --stops {pairs} --count 9",
        "history {site.db} -o NEW.html",
        "history NEW --add {pairs_out|frames.json}",
        "diff {pairs_out|arm_out} [pairs_out]",
        "diff [board_out] {board_out} --json",
        "convert {board|pairs|sweep|network|motions|board.rrd|pairs.rrd|foreign/industrial} NEW",
        "convert {board|pairs|tracked|network|held} NEW.rrd",
        "convert {foreign/kinematics}/measurements.yaml NEW",
        f"convert {{foreign/visp|foreign/views_json}} {_HAND}",
        f"convert {{foreign/zivid}} {_HAND} --target checkerboard_9x6_25mm",
        f"convert {{foreign/views_npz}} {_HAND} --robot-unit mm",
        f"convert {{foreign/stacked_npz}}/all.npz {_HAND}",
        f"convert {{foreign/easy_handeye}}/cell.samples {_HAND}",
        f"convert {{foreign/moveit_json}}/pairs.json {_HAND}",
        f"convert {{foreign/opencv_matrices}}/poses.yml {_HAND}",
        f"convert {{foreign/kuka_csv}}/log.csv {_HAND} {_KUKA}",
        f"convert {{foreign/images_and_table}} {_SHOTS}",
        f"convert {{foreign/streams}}/robot.csv {_HAND} --camera-file [foreign/streams]/camera.csv",
        f"convert [foreign/images_and_table] {_SHOTS} --intrinsics {{lens.yaml}}",
        f"convert [foreign/zivid] {_HAND} --target {{board.toml}}",
        f"convert [foreign/easy_handeye]/cell.samples {_HAND} --robot-model {{arm.toml}}",
        "convert {bags/ros1.bag|bags/mcap|bags/sqlite3} NEW --target charuco_9x6_30mm",
        "convert {lerobot/v2.1|lerobot/v3.0} NEW --target charuco_9x6_30mm",
        "export {pairs_out} --to ros -o OUT/pose.yaml",
        "export {network_out} --to ros --edge all -o OUT/poses.yaml",
        "export {board_out} --to camera-info",
        "export {arm_out|dynamics_out} --to robot-urdf",
        "export {frames.json} --to kuka-tool --number 3 -o OUT/tool.dat",
        "tcp {pairs/touches.csv} -c OUT",
        "tcp {pairs/touches.csv} -o OUT/frames.json --json",
        "tcp [pairs/touches.csv] -c {pairs_out|board_out}",
        "tcp [pairs/touches.csv] -o {frames.json} --name gripper",
        "tcp [pairs/touches.csv] --robot-model {arm.toml|arm.urdf|arm.json} -o NEW.json",
        "tcp {held} -c [held_out] -o OUT/frames.json",
        "fixture {pairs/features.csv} --tool [frames.json] -c OUT",
        "fixture {pairs/points.csv} --cad [pairs/cad.csv] --tool [frames.json] -o OUT/f.json",
        "fixture [pairs/points.csv] --cad {pairs/cad.csv} --tool [frames.json] -o OUT/f.json",
        "fixture [pairs/features.csv] --tool {frames.json} -c OUT",
        "fixture [pairs/features.csv] --tool [frames.json] -c {pairs_out}",
        "locate {board} -c [board_out]",
        "locate [board] -c {board_out} --json",
        f"locate {{board/images/000.png}} -c [board_out] {_STOOD} --target charuco_9x6_30mm",
        "locate [board] -c [board_out] --target {board.toml}",
        "correct {pairs/views.csv} -c [arm_out] -o OUT/corrected.csv --force",
        "correct [pairs/views.csv] -c {arm_out} -o NEW.csv",
        "plan {board|board.rrd} --add 2 -o OUT --candidates 20",
        f"plan {{arm.toml|arm.urdf|arm.json}} {_PLAN} {_LENS} -o OUT",
        f"plan {{board_out}} {_PLAN} -o OUT",
        f"plan ur5e {_PLAN} --target charuco_9x6_30mm --camera {{lens.yaml|board_out}} -o OUT",
        "target make {board.toml} -o OUT",
        "target check {board/images/000.png}",
        "dynamics plan {arm.toml} -o OUT --seconds 1 --duration 10 --acceleration-deg 400",
        "dynamics identify {motions} -o OUT",
        "dynamics validate {motions} --against [dynamics_out]",
        "dynamics validate [motions] --against {dynamics_out}",
        "dynamics payload {loaded} --against [dynamics_out]",
        "dynamics gains {empty_currents} --loaded [loaded_currents] --mass-kg 2.8 --com-mm 20,0,80",
    ))
    for name in names.split("|")
)  # fmt: skip
# What reads no file of the user's, or in processes of its own, or once a device has answered.
READS_NOTHING = {"audit", "batch", "demo", "simulate", "dynamics record"}
# What a sound input may be exchanged with.
_OTHERS = ("pairs", "pairs_out", "arm.toml", "pairs/touches.csv", "foreign/visp")
_NAMED, _BROKEN = re.compile(r"\[([a-z][\w./]+)\]"), re.compile(r"\{(.+?)\}")


def missing_commands() -> set[str]:
    """Commands that nobody says how to call."""
    every = {name for name, _ in every_command()}
    called = {name for name in every for words in READINGS if words.startswith(f"{name} ")}
    return every - called - READS_NOTHING


def sound(folder: Path, name: str) -> Path:
    """A sound input, made once."""
    path = folder / name
    if path.exists():
        return path
    folder.mkdir(parents=True, exist_ok=True)
    if name in MADE:
        words = shlex.split(_NAMED.sub(lambda found: str(sound(folder, found[1])), MADE[name]))
        with _typed(_said(words)):
            done = visioncal(*(path if word == "IT" else word for word in words))
        if done.status not in (0, 3):
            raise RuntimeError(f"{name}: {done.err}")
    elif name in WRITTEN:
        source, written = WRITTEN[name]
        path.parent.mkdir(parents=True, exist_ok=True)
        written(path, sound(folder, source))
    elif name in PACKAGED:
        shutil.copyfile(Path(__file__).parents[3] / PACKAGED[name], path)
    elif name.startswith("foreign/"):
        makers = foreign_samples.RECORDINGS | foreign_samples.MORE_RECORDINGS
        makers[name.removeprefix("foreign/")](path)
    else:
        sound(folder, name.partition("/")[0])
    return path


@dataclass(frozen=True)
class Ended:
    """How a command ended on a broken input."""

    number: int
    reading: str
    change: str  # What was done to its input.
    status: int
    faults: tuple[str, ...]  # What must not be.
    seconds: float


def run_mutant(number: int, seed: int, readings: Sequence[str], inputs: Path) -> Ended:
    """Breaks an input (a negative number's is left sound), and calls the command on it."""
    reading, chance = readings[number % len(readings)], random.Random(f"{seed}/{number}")
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (broken,) = _BROKEN.findall(reading)
        copy, out = place / Path(broken).name, place / "earlier"
        for source, dest in ((sound(inputs, broken), copy), (sound(inputs, "pairs_out"), out)):
            (shutil.copytree if source.is_dir() else shutil.copyfile)(source, dest)
        change = "sound"
        if number >= 0:
            change = mutate(copy, chance, [sound(inputs, other) for other in _OTHERS])
        words = _BROKEN.sub(str(copy), reading).replace("OUT", str(out))
        words = re.sub(r"\bNEW\b", str(place / "new"), words)
        words = _NAMED.sub(lambda found: str(sound(inputs, found[1])), words)
        before, begun = digests(place), time.perf_counter()
        signal.signal(signal.SIGALRM, _too_long)
        signal.alarm(LONGEST_S)
        # Whatever ran before in this process may have needed more.
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        done, faults = _called(shlex.split(words))
        signal.alarm(0)
        seconds, after = time.perf_counter() - begun, digests(place)
        if (most := resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) > max(MOST_KB, peak):
            faults.append(f"{most} kB of memory")
        changed = [name for name in {*before, *after} if before.get(name) != after.get(name)]
        # Of the guard, whose status is that of its lines, the others count; what a recording has
        # taken stays.
        if done.status == 2 and words.split()[0] not in ("guard", "record"):
            faults += [f"status 2 changed {name}" for name in changed]
        for written in changed:
            if written.endswith(".json") and written in after:
                json.loads((place / written).read_bytes(), parse_constant=float.fromhex)
    return Ended(number, reading, change, done.status, tuple(faults), seconds)


def _too_long(*_: object) -> None:
    raise TimeoutError(f"longer than {LONGEST_S} s")


def digests(folder: Path) -> dict[str, str]:
    """What every file below a folder holds, by its place; what is no plain file by what it is."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_symlink():
            digest = f"link to {path.readlink()}"
        elif path.is_file():
            digest = sha256(path.read_bytes()).hexdigest()
        else:
            digest = "folder" if path.is_dir() else "special"
        found[str(path.relative_to(folder))] = digest
    return found


def _said(words: list[str]) -> bytes:
    """What is said to the command by the file after <, which both leave its words."""
    if "<" not in words:
        return b""
    at = words.index("<")
    path = Path(words[at + 1])
    del words[at:]
    # Anything but a file a shell would not type, or without end.
    return path.read_bytes() if path.is_file() and not path.is_symlink() else b""


def _typed(data: bytes) -> AbstractContextManager[object]:
    return patch.object(sys, "stdin", io.TextIOWrapper(io.BytesIO(data)))


def _called(words: list[str]) -> tuple[Done, list[str]]:
    """Calls the application as its entry point does: how it ended, and its faults."""
    errors: list[VisioncalError] = []
    report = console.report_error

    def reported(error: VisioncalError, *, as_json: bool) -> None:
        errors.append(error)
        report(error, as_json=as_json)

    lines, port = _said(words), spoken.free_port()
    words = [word.replace("PORT", str(port)) for word in words]
    if "--page" in words:
        done, faults = spoken.served(words, lines, port)
        # Where it serves, Ctrl-C ended it.
        is_known = done.status in (2, 130)
        return done, [*faults, *[f"status {done.status}: {done.err[-600:]}"] * (not is_known)]
    is_robot = any(word.startswith("socket:") for word in words)
    try:
        with (
            _typed(b"" if is_robot else lines),
            patch.object(console, "report_error", reported),
            patch.object(viewer, "review_native", lambda *_: None),
            spoken.robot_says(lines, port) if is_robot else nullcontext(),
        ):
            done = visioncal(*words)
    except BaseException:  # noqa: BLE001 - what escapes is what is looked for
        return Done(1, "", ""), [f"traceback: {traceback.format_exc(limit=-6)}"]
    if words[0] == "guard" and not errors:
        return done, [*_unanswered(done)]
    if done.status == 2:
        return done, [*_unclear(errors, done, as_json="--json" in words)]
    return done, [f"said {done.err[-600:]}"] * (done.status == 1 or "Warning:" in done.err)


def _unclear(errors: Sequence[VisioncalError], done: Done, *, as_json: bool) -> Iterator[str]:
    """What is wrong with a refusal."""
    if len(errors) != 1:
        yield f"{len(errors)} errors for one refusal: {done.err[:300]}"
        return
    (error,) = errors
    if not error.message.strip() or len(str(error)) > _MOST_LETTERS:
        yield f"a message of {len(str(error))} letters: {str(error)[:200]}"
    if not error.culprits:
        yield f"no culprit: {error}"
    if as_json != bool(done.out) or (as_json and json.loads(done.out).keys() != {"error"}):
        yield f"a refusal printed {done.out[:100]!r}"


def _unanswered(done: Done) -> Iterator[str]:
    """What is wrong with the guard's answers to lines."""
    answers = [json.loads(line, parse_constant=float.fromhex) for line in done.out.splitlines()]
    holds = [answer["holds"] for answer in answers if "holds" in answer]
    wrong = any("error" in answer for answer in answers)
    if done.err:
        yield f"said {done.err[-600:]}"
    if False in holds and any(holds[holds.index(False) :]):
        yield "an alarm that was not acknowledged ended"
    if done.status != (3 if holds and not holds[-1] else 2 if wrong else 0):
        yield f"status {done.status}, and the last of {len(answers)} answers is {answers[-1:]}"


def walk(
    numbers: Sequence[int], folder: Path, *, seed: int = 0, readings: Sequence[str] = READINGS
) -> Iterator[Ended]:
    """Runs mutants in processes of their own, as many as there are processors."""
    for reading in readings:
        for name in ("pairs_out", *_OTHERS, *_NAMED.findall(reading), *_BROKEN.findall(reading)):
            sound(folder, name)
    at_once = min(len(os.sched_getaffinity(0)), 1 + len(numbers) // 100)
    with ProcessPoolExecutor(at_once, get_context("spawn"), max_tasks_per_child=100) as pool:
        yield from pool.map(run_mutant, numbers, repeat(seed), repeat(readings), repeat(folder))
