"""Walks the commands through an ordinary cell, and looks at what they leave behind."""

import json
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from unittest.mock import patch

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2, norm
from support.commands import Done
from support.commands import visioncal as run
from support.fuzz.varied_cells import Cell, cell, write

import visioncal.cli.console
from visioncal import Session
from visioncal.cli.show import find_recording
from visioncal.core.errors import VisioncalError
from visioncal.interchange.outputs import CALIBRATION, RECORDING, REPORT
from visioncal.interchange.result_files import load_calibration
from visioncal.present.viewer import blueprint

POSES = ("ros", "ros-launch", "easy-handeye2", "urdf", "opencv", "zivid", "text", "ur",
         "kuka", "fanuc", "abb", "staubli", "yaskawa", "doosan")  # fmt: skip
LENSES = ("camera-info", "kalibr", "oak")
ARMS = ("robot-urdf", "robot-dh", "robot-json")


@dataclass(frozen=True)
class Step:
    """How a command ended: its status, the error's class and message, and the time it took [s]."""

    command: str
    status: int
    error: str = ""
    message: str = ""
    culprits: tuple[str, ...] = ()
    trace: str = ""
    seconds: float = 0.0


@dataclass(frozen=True)
class Error:
    """The error of a result in units of its own sigma."""

    # Mean square over all free directions, which is 1 where the covariance tells it.
    per_dof: float
    sigmas: float  # The same as the deviation of one normal number that is as unlikely.


@dataclass
class Walk:
    """What came of a cell."""

    seed: int
    facts: dict[str, str] = field(default_factory=dict)
    steps: list[Step] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    verdict: str = ""
    error: Error | None = None
    warned: list[str] = field(default_factory=list)
    drawn_s: float = 0.0


def walk(seed: int, beside: Path, *, whole: bool = True) -> Walk:
    """Draws a cell and runs the commands through it.

    Args:
        seed: Of the cell.
        beside: An empty folder.
        whole: Whether all commands run; otherwise those after `report` by the seed's chance.
    """
    done = Walk(seed)
    begun = time.perf_counter()
    drawn = cell(seed)
    (beside / "first").mkdir()
    session = write(drawn, beside / "first")
    done.drawn_s = time.perf_counter() - begun
    done.facts = drawn.facts | session.facts
    rng = np.random.default_rng([seed, 3])
    out = beside / "out ü"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if _run(done, "calibrate", session.folder, "-o", out, *(["-v"] if seed % 2 else [])):
            _look_at(done, drawn, out)
            _use(done, drawn, rng, session.folder, out, beside, whole=whole)
        if whole or rng.random() < 0.3:
            _convert(done, session.folder, beside)
    done.warned = sorted({f"{Path(w.filename).name}:{w.lineno} {w.message}" for w in caught})
    return done


def _use(done: Walk, item: Cell, rng: np.random.Generator, folder: Path, out: Path, beside: Path,
         *, whole: bool) -> None:  # fmt: skip
    """All that is done with a result."""
    if (whole or rng.random() < 0.2) and _run(done, "show", out, "-o", beside / "again.html"):
        _check_page(done, beside / "again.html")
    with _stepped(done, "review"):
        recording = find_recording(out)
        blueprint(Session.load(recording), load_calibration(recording))
    formats = [*rng.choice(POSES, 2, replace=False)]
    if item.camera is not None and item.seen_sigma is None:
        formats.append(rng.choice(LENSES))
    if item.arm is not None:
        formats.append(rng.choice(ARMS))
    edge = str(rng.choice(list(item.truth)))
    for at, name in enumerate(formats):
        chosen = ["--edge", edge] if at == 0 else []
        _run(done, "export", out, "--to", name, *chosen, "--force", "-o", beside / f"export {at}")
    if whole or rng.random() < 0.25:
        (beside / "second").mkdir()
        begun = time.perf_counter()
        fresh = write(item, beside / "second", visit=1)
        done.drawn_s += time.perf_counter() - begun
        _run(done, "verify", fresh.folder, "--against", out, "-o", beside / "check")
        _run(done, "locate", fresh.folder, "-c", out, "--force")
    if whole or rng.random() < 0.2:
        add = ["plan", folder, "--add", 3, "-o", beside / "plan", "--candidates", 200]
        _run(done, *add)


def _convert(done: Walk, folder: Path, beside: Path) -> None:
    """A session becomes a recording and a folder again, with nothing lost."""
    recording, again = beside / "it.rrd", beside / "again"
    there = _run(done, "convert", folder, recording)
    back = there and _run(done, "convert", recording, again)
    if there and back and _digest(there) != _digest(back):
        done.missing.append("convert: another digest")


def _digest(done: Done) -> str:
    return done.err.rpartition("sha256 ")[2].split()[0]


@contextmanager
def _stepped(done: Walk, command: str) -> Iterator[None]:
    begun = time.perf_counter()
    try:
        yield
    except VisioncalError as error:
        step = Step(command, 2, type(error).__name__, error.message, error.culprits)
    except Exception:  # noqa: BLE001 - a bug of any kind is what is looked for
        step = Step(command, 1, trace=traceback.format_exc())
    else:
        step = Step(command, 0, seconds=time.perf_counter() - begun)
    done.steps.append(step)


def _run(done: Walk, command: str, *arguments: object) -> Done | None:
    """Runs a command; None where there is no result. A check that says no is one."""
    told: list[VisioncalError] = []
    report = visioncal.cli.console.report_error

    def noted(error: VisioncalError, *, as_json: bool) -> None:
        told.append(error)
        report(error, as_json=as_json)

    begun = time.perf_counter()
    try:
        with patch.object(visioncal.cli.console, "report_error", noted):
            end = run(command, *arguments)
    except Exception:  # noqa: BLE001 - a bug of any kind is what is looked for
        done.steps.append(Step(command, 1, trace=traceback.format_exc()))
        return None
    words = [type(visioncal_error).__name__ for visioncal_error in told] or [""]
    message = told[0].message if told else end.err if end.status == 2 else ""
    culprits = told[0].culprits if told else ()
    if end.status == 2 and not end.err.strip():
        done.missing.append(f"{command}: a message")
    taken = time.perf_counter() - begun
    done.steps.append(Step(command, end.status, words[0], message, culprits, seconds=taken))
    return end if end.status in (0, 3) else None


def _look_at(done: Walk, item: Cell, out: Path) -> None:
    """The three files, and how far the result is from the truth."""
    done.missing += [
        name for name in (CALIBRATION, REPORT, RECORDING) if not (out / name).is_file()
    ]
    if done.missing:
        return
    _check_page(done, out / REPORT)
    text = (out / CALIBRATION).read_text(encoding="utf-8")
    document = json.loads(text, parse_constant=lambda word: done.missing.append(f"JSON: {word}"))
    if _has_null(document):
        done.missing.append("JSON: null")
    done.verdict = document["verdict"]["status"]
    done.error = error_of(item, document)


def error_of(item: Cell, document: dict) -> Error:
    """The error of all free transforms together; a checkerboard's frame as it fits best."""
    order = document["joint_covariance"]["order"]
    covariance = np.array(document["joint_covariance"]["matrix"])
    found = {name: np.array(edge["matrix"]) for name, edge in document["transforms"].items()}
    size = 6 * len(order)
    least = np.inf
    for truth in item.turned():
        away = [np.linalg.inv(truth[name]) @ found[name] for name in order]
        error = RigidTransform.from_matrix(np.array(away)).as_exp_coords().ravel()
        least = min(least, float(error @ np.linalg.solve(covariance, error)))
    return Error(least / size, float(norm.isf(0.5 * max(chi2.sf(least, size), 1e-300))))


def _has_null(value: object) -> bool:
    if isinstance(value, dict):
        return any(_has_null(number) for number in value.values())
    if isinstance(value, list):
        return any(_has_null(number) for number in value)
    return value is None


class _Page(HTMLParser):
    """Notes which tags a page has."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list) -> None:  # noqa: ARG002
        self.tags.add(tag)


def _check_page(done: Walk, path: Path) -> None:
    page = _Page()
    page.feed(path.read_text(encoding="utf-8"))
    if not {"html", "head", "body", "h1"} <= page.tags:
        done.missing.append(f"{path.name}: not a page")
