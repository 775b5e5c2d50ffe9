"""Runs every command that reads files on inputs with one thing broken, and says what went wrong.

A mutant is a number: it says by chance which reading of a command is taken, and what of its input
is broken. It runs in a process of its own pool, which is killed where it takes too long or too
much memory, and replaced.
"""

import io
import json
import os
import random
import re
import shlex
import shutil
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, replace
from hashlib import sha256
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from unittest.mock import patch

from support.commands import every_command
from support.fuzz.mutators import mutate
from support.fuzz.sound_inputs import MAKERS, Inputs, typed

from visioncal.cli import console
from visioncal.cli.app import main
from visioncal.core.errors import VisioncalError
from visioncal.present import viewer

LONGEST_S = 300.0
MOST_BYTES = 2 * 1024**3
# A page of text; longer messages are no message.
_MOST_LETTERS = 4000
# A process is replaced after so many mutants, so that what one leaves behind is not another's.
_MUTANTS_EACH = 150
_NAMED = re.compile(r"\[(.+?)\]")


@dataclass(frozen=True)
class Reading:
    """How a command is called on an input."""

    command: str  # As typed after `visioncal`.
    input: str  # The sound input that is broken: a name of `sound_inputs.MAKERS`.
    # The arguments: IT is what is broken, OUT an earlier result's folder, NEW a path where nothing
    # is, and [name] another sound input.
    words: str
    typed: bool = False  # Whether `sound_inputs.typed` is typed into it.
    is_kept: bool = False  # Whether what it had written before it failed stays, on purpose.
    sound: int = 0  # The exit status while nothing is broken.


def _each(command: str, words: str, *inputs: str) -> tuple[Reading, ...]:
    return tuple(Reading(command, name, words) for name in inputs)


# What reads no file of the user's, or only once a robot has answered.
# `batch` reads sessions as `calibrate` does, in processes of its own.
READS_NOTHING = ("batch", "demo", "simulate", "dynamics record")
_FEW = "-o OUT --candidates 20"
_PLAN = f"{_FEW} --stops 3 --guess-deg 2 --cam '0 -60 60 0 0 0' --board '500 0 5 180 0 0'"
_LENS = "--camera 1000,1000,640,400 --resolution 1280,800"
_ROBOT_COLUMNS = "--mount eye-in-hand --robot-key X,Y,Z,A,B,C --robot-form kuka --camera-key " \
    "cam_x,cam_y,cam_z,cam_qx,cam_qy,cam_qz,cam_qw"  # fmt: skip
_HAND = "IT NEW --mount eye-in-hand"
_SHOTS = f"IT NEW --mount eye-in-hand --target {'charuco_5x7_36.195mm_18.256mm_DICT_6X6_250'} " \
    "--robot-key x,y,z,qw,qx,qy,qz"  # fmt: skip
_STOOD = "--pose 0.5,0.1,0.4,0,1,0,0"
_BODY = "--mass-kg 2.8 --com-mm 20,-30,80"

READINGS: tuple[Reading, ...] = (
    *_each("calibrate", "IT -o OUT", "board", "board", "held", "pairs", "pairs", "arm", "sweep"),
    *_each("calibrate", "IT -o OUT", "warm", "tracked", "board.rrd", "pairs.rrd"),
    Reading("calibrate", "pairs", "IT -o OUT --json"),
    *_each("calibrate", "IT -o OUT", "network", "network", "pairs"),
    # Its seven views are fewer than doctor wants.
    Reading("doctor", "board", "IT", sound=3),
    *_each("doctor", "IT", "pairs", "arm"),
    Reading("touch-test", "board", "IT -c [board_out] --tool none --clearance-mm 300"),
    *_each("show", "IT -o OUT/report.html", "out", "board_out", "network_out", "warm_out"),
    Reading("show", "arm_out", "IT/calibration.json -o OUT/report.html"),
    Reading("verify", "pairs", "IT --against [out] -o NEW"),
    Reading("verify", "board", "IT --against [board_out]"),
    Reading("verify", "out", "[pairs] --against IT -o NEW"),
    Reading("verify", "arm_out", "[pairs] --against IT -o NEW", sound=3),
    *_each("diff", "IT [out]", "out", "arm_out"),
    Reading("diff", "board_out", "[board_out] IT --json"),
    *_each("convert", "IT NEW", "board", "pairs", "sweep", "network", "motions"),
    *_each("convert", "IT NEW.rrd", "board", "pairs", "tracked", "network", "held"),
    *_each("convert", "IT NEW", "board.rrd", "pairs.rrd", "foreign/industrial"),
    Reading("convert", "foreign/kinematics", "IT/measurements.yaml NEW"),
    *_each("convert", _HAND, "foreign/visp", "foreign/views_json"),
    Reading("convert", "foreign/zivid", f"{_HAND} --target checkerboard_9x6_25mm"),
    Reading("convert", "foreign/views_npz", f"{_HAND} --robot-unit mm"),
    Reading("convert", "foreign/easy_handeye", "IT/cell.samples NEW --mount eye-in-hand"),
    Reading("convert", "foreign/moveit_json", "IT/pairs.json NEW --mount eye-in-hand"),
    Reading("convert", "foreign/kuka_csv", f"IT/log.csv NEW {_ROBOT_COLUMNS} --guess --yes"),
    Reading("convert", "foreign/images_and_table", _SHOTS),
    Reading("convert", "foreign/images_and_table", f"IT/robot.csv {_SHOTS[3:]} --images IT"),
    Reading(
        "convert",
        "foreign/streams",
        "IT/robot.csv NEW --mount eye-in-hand --camera-file IT/camera.csv",
    ),
    Reading("convert", "lens.yaml", f"[foreign/images_and_table] {_SHOTS[3:]} --intrinsics IT"),
    Reading("convert", "target.toml", "[foreign/zivid] NEW --mount eye-in-hand --target IT"),
    Reading(
        "convert",
        "arm.toml",
        "[foreign/easy_handeye]/cell.samples NEW --mount eye-in-hand --robot-model IT",
    ),
    Reading("export", "out", "IT --to ros -o OUT/pose.yaml"),
    Reading("export", "network_out", "IT --to ros --edge all -o OUT/poses.yaml"),
    Reading("export", "board_out", "IT --to camera-info"),
    Reading("export", "board_out", "IT --to opencv"),
    *_each("export", "IT --to robot-urdf", "arm_out", "dynamics_out"),
    Reading("export", "arm_out", "IT --to robot-dh --convention standard"),
    Reading("export", "arm_out", "IT --to ur-kinematics"),
    Reading("export", "frames.json", "IT --to kuka-tool --number 3 -o OUT/tool.dat"),
    Reading("tcp", "touches.csv", "IT -c OUT"),
    Reading("tcp", "touches.csv", "IT -o OUT/frames.json --json"),
    *_each("tcp", "[touches.csv] -c IT", "out", "board_out"),
    Reading("tcp", "frames.json", "[touches.csv] -o IT --name gripper"),
    *_each("tcp", "[joints.csv] --robot-model IT -o NEW.json", "arm.toml", "arm.urdf", "arm.json"),
    Reading("tcp", "joints.csv", "IT --robot-model ur10e -c OUT"),
    Reading("tcp", "held", "IT -c [held_out] -o OUT/frames.json"),
    *_each("fixture", "IT --tool [frames.json] -c OUT", "features.csv"),
    Reading("fixture", "points.csv", "IT --cad [drawing.csv] --tool [frames.json] -o OUT/f.json"),
    Reading("fixture", "drawing.csv", "[points.csv] --cad IT --tool [frames.json] -o OUT/f.json"),
    Reading("fixture", "frames.json", "[features.csv] --tool IT -c OUT"),
    Reading("fixture", "out", "[features.csv] --tool [frames.json] -c IT"),
    Reading("fixture", "board", "IT -c [board_out] -o OUT/f.json"),
    *_each("locate", "IT -c [board_out]", "board"),
    Reading("locate", "board_out", "[board] -c IT --json"),
    Reading("locate", "photo.png", f"IT -c [board_out] {_STOOD} --target charuco_9x6_30mm"),
    Reading("locate", "board_out", f"--pixel 300,200 --plane z=20 -c IT {_STOOD}"),
    Reading("locate", "target.toml", "[board] -c [board_out] --target IT"),
    *_each("correct", "IT -c [arm_out] -o OUT/corrected.csv --force", "targets.csv"),
    *_each("correct", "[targets.csv] -c IT -o NEW.csv", "arm_out"),
    Reading("correct", "arm_out", "[targets.csv] -c IT -o - --json"),
    *_each("plan", f"IT --add 2 {_FEW}", "board", "board.rrd"),
    *_each(
        "plan", f"IT {_PLAN} {_LENS} --target charuco_9x6_30mm", "arm.toml", "arm.urdf", "arm.json"
    ),
    Reading("plan", "board_out", f"IT {_PLAN}"),
    Reading("plan", "target.toml", f"ur5e {_PLAN} {_LENS} --target IT"),
    *_each("plan", f"ur5e {_PLAN} --target charuco_9x6_30mm --camera IT", "lens.yaml", "board_out"),
    Reading(
        "record",
        "pictures",
        "-o NEW --arm manual --camera folder:IT --target charuco_9x6_30mm",
        typed=True,
        is_kept=True,
    ),
    Reading(
        "record",
        "plan",
        "-o NEW --arm manual --camera folder:[pictures] --plan IT",
        typed=True,
        is_kept=True,
    ),
    Reading(
        "record",
        "target.toml",
        "-o NEW --arm manual --camera folder:[pictures] --target IT",
        typed=True,
        is_kept=True,
    ),
    Reading(
        "record",
        "recorded",
        "-o IT --resume --arm manual --camera folder:[pictures] --target charuco_9x6_30mm",
        typed=True,
        is_kept=True,
        sound=2,
    ),
    *_each("show", "IT --viewer", "out", "plan", "board.rrd"),
    Reading("target make", "target.toml", "IT -o OUT"),
    Reading("target check", "photo.png", "IT"),
    Reading("target check", "photo.png", "IT --square-mm 30 -o OUT/seen.toml --json"),
    *_each(
        "dynamics plan",
        "IT -o OUT --seconds 0 --duration 10 --acceleration-deg 400",
        "arm.toml",
        "arm.urdf",
    ),
    *_each("dynamics identify", "IT -o OUT", "motions", "motions"),
    Reading("dynamics validate", "motions", "IT --against [dynamics_out]"),
    Reading("dynamics validate", "dynamics_out", "[motions] --against IT"),
    Reading("dynamics payload", "loaded", "IT --against [dynamics_out]"),
    Reading("dynamics payload", "dynamics_out", "[loaded] --against IT --json"),
    Reading("dynamics gains", "currents/empty", f"IT --loaded [currents/loaded] {_BODY}"),
    Reading("dynamics gains", "currents/loaded", f"[currents/empty] --loaded IT {_BODY}"),
)
# What a sound input may be exchanged with.
EXCHANGED = ("pairs", "out", "board.rrd", "another.rrd", "touches.csv", "frames.json",
             "target.toml", "photo.png", "arm.toml", "plan", "dynamics_out",
             "network_out", "arm.json")  # fmt: skip


@dataclass(frozen=True)
class Ended:
    """How a command ended on a broken input."""

    number: int  # The mutant's.
    reading: Reading  # What was called.
    kind: str  # What was broken: a key of `mutators.KINDS`, or `file system`.
    change: str  # What was done to it.
    status: int  # The exit status; -1 where it was killed.
    message: str  # What it wrote to stderr.
    faults: tuple[str, ...]  # What must not be.
    seconds: float  # How long it took.
    peak_bytes: int  # Most memory, of the whole process.
    notes: tuple[str, ...] = ()  # What libraries wrote past the command.

    def __str__(self) -> str:
        words = f"{self.number}: {self.reading.command} {self.reading.words} [{self.reading.input}]"
        return f"{words}; {self.change}; status {self.status}; {'; '.join(self.faults)}"


def mutant(number: int, seed: int, readings: Sequence[Reading]) -> tuple[Reading, random.Random]:
    """Which reading a mutant is of, and the chance that breaks its input."""
    return readings[number % len(readings)], random.Random(f"{seed}/{number}")


def run_mutant(
    number: int,
    seed: int,
    readings: Sequence[Reading],
    inputs: Inputs,
    folder: Path,
    *,
    told: Callable[[tuple[str, str]], None] = lambda _: None,
) -> Ended:
    """Breaks an input, calls the command on it, and looks at what came of it.

    Args:
        number: The mutant's; a negative one has its input left sound.
        seed: Of all mutants.
        readings: What is called in turn.
        inputs: The sound ones.
        folder: Where the broken one, and what is written, are for a while.
        told: Takes the kind of what is broken, and what was done to it, before the call.
    """
    reading, chance = mutant(number, seed, readings)
    place = folder / f"{os.getpid()}-{number}"
    place.mkdir(parents=True)
    copy, out = place / Path(reading.input).name, place / "earlier"
    _copy(inputs[reading.input], copy)
    _copy(inputs["out"], out)
    broken = ("none", "sound")
    if number >= 0:
        broken = mutate(copy, chance, [inputs[name] for name in exchanged(readings)])
    told(broken)
    words = [*reading.command.split(), *_words(reading, copy, out, place / "new", inputs)]
    before = digests(place)
    done, seconds, peak = _timed(words, typed() if reading.typed else "")
    faults = [*done.faults]
    if done.status == 2:
        after = digests(place)
        changed = sorted(name for name in {*before, *after} if before.get(name) != after.get(name))
        if reading.is_kept:
            changed = [name for name in changed if not name.startswith("new")]
        faults += [f"status 2 changed {', '.join(changed[:5])}"] if changed else []
    faults += _not_json(place, before) if done.status in (0, 3) else []
    shutil.rmtree(place)
    return Ended(number, reading, *broken, done.status, done.message, tuple(faults), seconds, peak)


def exchanged(readings: Sequence[Reading]) -> list[str]:
    """Names what a broken input may be exchanged with, of what is there anyhow."""
    there = {reading.input for reading in readings} | {"another.rrd"}
    return [name for name in EXCHANGED if name in there]


def _copy(source: Path, dest: Path) -> None:
    if source.is_dir():
        shutil.copytree(source, dest)
    else:
        shutil.copyfile(source, dest)


def _words(reading: Reading, file: Path, out: Path, new: Path, inputs: Inputs) -> list[str]:
    places = {"IT": file, "OUT": out, "NEW": new}
    words = []
    for word in shlex.split(reading.words):
        for name, path in places.items():
            word = re.sub(rf"\b{name}\b", str(path), word)  # noqa: PLW2901 - one after the other
        words.append(_NAMED.sub(lambda found: str(inputs[found[1]]), word))
    return words


def digests(folder: Path) -> Mapping[str, str]:
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


def _not_json(place: Path, before: Mapping[str, str]) -> list[str]:
    """JSON that was written, and that others could not read."""
    faults = []
    for name, digest in digests(place).items():
        if name.endswith(".json") and before.get(name) != digest:
            try:
                json.loads((place / name).read_bytes(), parse_constant=float.fromhex)
            except ValueError as error:
                faults.append(f"{name} is no JSON: {error}")
    return faults


@dataclass(frozen=True)
class _Done:
    status: int
    message: str
    faults: tuple[str, ...]


def _timed(words: Sequence[str], answers: str) -> tuple[_Done, float, int]:
    Path("/proc/self/clear_refs").write_text("5")
    begun = time.perf_counter()
    done = _called(words, answers)
    return done, time.perf_counter() - begun, _memory(os.getpid(), "VmHWM")


def _memory(pid: int, field: str) -> int:
    """The memory of a process [bytes]: VmRSS now, or VmHWM the most so far; 0 where it is gone."""
    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0
    found = re.search(rf"{field}:\s+(\d+) kB", text)
    return 1024 * int(found[1]) if found else 0


def _called(words: Sequence[str], answers: str) -> _Done:
    """Calls the application as its entry point does."""
    out, err, errors = io.StringIO(), io.StringIO(), []
    report = console.report_error

    def reported(error: VisioncalError, *, as_json: bool) -> None:
        errors.append(error)
        report(error, as_json=as_json)

    faults: list[str] = []
    status = 0
    with (
        patch.object(sys, "argv", ["visioncal", *words]),
        patch.object(sys, "stdin", io.StringIO(answers)),
        patch.object(console, "report_error", reported),
        patch.object(viewer, "review_native", lambda *_: None),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as stop:
            status = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        except BaseException:  # noqa: BLE001 - what escapes is what is looked for
            faults.append(f"traceback: {traceback.format_exc(limit=-6)}")
            status = 1
    message = err.getvalue()
    if "Warning:" in message:
        faults.append(f"warning: {message[max(0, message.index('Warning:') - 120) :][:400]}")
    if status == 2:
        faults += _unclear(errors, message, out.getvalue(), as_json="--json" in words)
    elif status not in (0, 3) and not faults:
        faults.append(f"status {status}: {message[-600:]}")
    if status == 2 and errors:
        message = str(errors[-1])
    return _Done(status, message, tuple(faults))


def _unclear(
    errors: Sequence[VisioncalError], message: str, out: str, *, as_json: bool
) -> Iterator[str]:
    """What is wrong with a refusal."""
    if len(errors) != 1:
        yield f"{len(errors)} errors for one refusal: {message[:300]}"
        return
    (error,) = errors
    if not error.message.strip():
        yield "an empty message"
    if len(str(error)) > _MOST_LETTERS:
        yield f"a message of {len(str(error))} letters: {str(error)[:200]}"
    if not error.culprits:
        yield f"no culprit: {error}"
    if as_json:
        if json.loads(out).keys() != {"error"}:
            yield f"--json printed {out[:100]}"
    elif out:
        yield f"a refusal with a result: {out[:100]}"


# --- The pool.


@dataclass
class _Worker:
    process: BaseProcess
    pipe: Connection
    number: int | None = None
    broken: tuple[str, str] = ("?", "?")
    begun: float = 0.0
    done: int = 0
    most: int = 0


def _work(
    pipe: Connection, seed: int, readings: Sequence[Reading], inputs: Path, folder: Path
) -> None:
    """Runs mutants as their numbers come; libraries' own words go to a file."""
    words = folder / f"words-{os.getpid()}"
    with words.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    said = 0
    while (number := pipe.recv()) is not None:
        ended = run_mutant(number, seed, readings, Inputs(inputs), folder, told=pipe.send)
        new = words.read_bytes()[said:].decode("utf-8", errors="replace")
        said += len(new.encode())
        if new.strip():
            ended = replace(ended, notes=(new[:300],))
        pipe.send(ended)


def walk(
    numbers: Sequence[int],
    folder: Path,
    *,
    seed: int = 0,
    processes: int = 1,
    readings: Sequence[Reading] = READINGS,
) -> Iterator[Ended]:
    """Runs mutants, each within `LONGEST_S` and `MOST_BYTES`.

    Args:
        numbers: Which.
        folder: For the inputs, which are made where they are missing, and for what is written.
        seed: Other mutants for every number.
        processes: How many run at once.
        readings: What is called in turn.

    Yields:
        How they ended, as they do.
    """
    inputs, places = Inputs(folder / "sound"), folder / "places"
    for reading in readings:
        for name in ("out", reading.input, *_NAMED.findall(reading.words)):
            inputs[name]
    for name in exchanged(readings):
        inputs[name]
    places.mkdir(parents=True, exist_ok=True)
    waiting = list(reversed(numbers))

    def start() -> _Worker:
        here, there = get_context("spawn").Pipe()
        arguments = (there, seed, readings, inputs.folder, places)
        process = get_context("spawn").Process(target=_work, args=arguments, daemon=True)
        process.start()
        there.close()
        return _Worker(process, here)

    with _ended([start() for _ in range(min(processes, len(numbers)))]) as workers:
        while waiting or any(worker.number is not None for worker in workers):
            for at, worker in enumerate(workers):
                ended = _looked_at(worker, seed, readings)
                if ended is not None:
                    yield ended
                if not worker.process.is_alive() or worker.done >= _MUTANTS_EACH:
                    worker.process.kill()
                    workers[at] = worker = start()  # noqa: PLW2901 - replaced
                if worker.number is None and waiting:
                    worker.number, worker.begun, worker.most = waiting.pop(), time.monotonic(), 0
                    worker.pipe.send(worker.number)
            time.sleep(0.005)


@contextmanager
def _ended(workers: list[_Worker]) -> Iterator[list[_Worker]]:
    try:
        yield workers
    finally:
        for worker in workers:
            worker.process.kill()
            worker.process.join()


def _looked_at(worker: _Worker, seed: int, readings: Sequence[Reading]) -> Ended | None:
    """How a worker's mutant ended, if it did; it is killed where it goes beyond its limits."""
    if worker.number is None:
        return None
    if worker.pipe.poll():
        try:
            ended = worker.pipe.recv()
        except EOFError:
            return _killed(worker, seed, readings, "the process died")
        if not isinstance(ended, Ended):
            worker.broken, worker.begun = ended, time.monotonic()
            return None
        worker.number, worker.done = None, worker.done + 1
        over = ended.seconds > LONGEST_S or ended.peak_bytes > MOST_BYTES
        return replace(ended, faults=(*ended.faults, "beyond its limits")) if over else ended
    worker.most = max(worker.most, _memory(worker.process.pid or 0, "VmHWM"))
    if worker.most > MOST_BYTES:
        return _killed(worker, seed, readings, f"{worker.most / 1e9:.1f} GB")
    if time.monotonic() - worker.begun > LONGEST_S:
        return _killed(worker, seed, readings, f"longer than {LONGEST_S:.0f} s")
    return None


def _killed(worker: _Worker, seed: int, readings: Sequence[Reading], why: str) -> Ended:
    worker.process.kill()
    worker.process.join()
    number, worker.number = worker.number or 0, None
    reading, _ = mutant(number, seed, readings)
    seconds = time.monotonic() - worker.begun
    faults = (f"killed: {why}",)
    return Ended(number, reading, *worker.broken, -1, "", faults, seconds, worker.most)


def missing_commands() -> tuple[str, ...]:
    """Commands that nobody says how to call, and calls of commands that there are not."""
    said = {reading.command for reading in READINGS} | set(READS_NOTHING)
    return tuple(sorted(said.symmetric_difference(dict(every_command()))))


def unknown_inputs() -> set[str]:
    """Inputs that nobody makes."""
    named = {reading.input for reading in READINGS}.union(
        *(_NAMED.findall(reading.words) for reading in READINGS), EXCHANGED
    )
    return named - set(MAKERS)
