"""`--page` of `record` and `verify`: what a page asks, and the task that its answers make."""

import socket
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import date
from functools import partial
from pathlib import Path
from typing import get_args

import numpy as np

from visioncal.cli.console import say
from visioncal.cli.live_cell import check_order, opened, recorded_cell, taking_of
from visioncal.cli.result_options import VerifyOptions
from visioncal.cli.session_options import RecordOptions
from visioncal.core.choices import CameraMount
from visioncal.core.codec import read
from visioncal.core.conventions import POSE_FORMS, controller_form
from visioncal.core.documents.jsons import parse_stored, read_json
from visioncal.core.errors import DataError, DriverError
from visioncal.core.extras import client_library
from visioncal.core.files import read_text, write_json
from visioncal.core.limits import CheckLimits
from visioncal.core.number_format import counted
from visioncal.core.parsing import refuse_given
from visioncal.interchange.outputs import CALIBRATION, VERIFY
from visioncal.interchange.result_files import load_calibration
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.devices import ARMS, CAMERAS
from visioncal.live.capture.journal import CaptureFacts, Journal, RecordedCell, picture_name
from visioncal.live.drivers.manual import ManualArm
from visioncal.live.drivers.protocols import StoredPictures
from visioncal.live.drivers.uvc import without_password
from visioncal.live.page.outcome import Light
from visioncal.live.page.state import PageText, Setup, Task
from visioncal.live.page.station import Station
from visioncal.live.page.suggestion import NextPose
from visioncal.planning.cell import PlanCell, seen_from
from visioncal.planning.path import short_order
from visioncal.planning.plan_file import PlanFile, read_plan
from visioncal.planning.repeated import stops_to_repeat
from visioncal.robot.files import robot_names
from visioncal.vision.targets import target_from_document, target_names

# The last choice, beside the views.
_REMEMBERED = "page.json"
# Addresses that a browser of the network may have OpenCV open.
_STREAMS = ("http://", "https://", "rtsp://", "rtsps://")
# Labels of the setup's fields, and what may be chosen; anything else may be typed.
_FIELDS: Mapping[str, tuple[str, Sequence[str]]] = {
    "target": ("Board (a name, or its .toml)", target_names()),
    "mount": ("Where the camera is", get_args(CameraMount)),
    "robot": ("Robot's model, where it is known", robot_names()),
    "arm": ("Its poses: typed, or by address", [*ARMS]),
    "camera": ("Camera", [*CAMERAS]),
    "pose_form": ("The pendant's form of poses", [*POSE_FORMS]),
}
_DEVICES = ("arm", "camera", "pose_form")


def record_on_page(options: RecordOptions) -> None:
    """Runs `visioncal record --page`."""
    driven = {"--dry-run": options.dry_run or None, "--yes": options.yes or None}
    refuse_given({**driven, "--json": options.as_json or None}, "a page moves no arm")
    plan = None if options.plan is None else read_plan(options.plan)
    described = () if plan else ("target", "mount", "robot")

    def prepare(setup: Setup) -> Task:
        chosen = _with_devices(options, setup)
        if plan is None:
            mounts: dict[str, CameraMount] = {mount: mount for mount in get_args(CameraMount)}
            if setup.mount not in mounts:
                raise DataError(f"The camera is {' or '.join(mounts)}, not {setup.mount!r}.")
            robot, mount = setup.robot or None, mounts[setup.mount]
            chosen = replace(chosen, target=setup.target or None, mount=mount, robot=robot)
        recorded, out = recorded_cell(plan, chosen), options.out
        stops = () if plan is None else _planned(plan)
        return Task(
            partial(_begun, setup, chosen, recorded, plan, out),
            recorded,
            None if plan is None else plan.cell.camera,
            stops,
            options.views or len(stops),
            taking_of(chosen, is_driven=False),
            ("calibrate", str(out)),
            out.with_name(f"{out.name}-result"),
            None if recorded.robot is None else controller_form(recorded.robot.name),
        )

    words = (*described, *_DEVICES)
    given = {name: value for name in words if (value := getattr(options, name)) is not None}
    is_known = {"arm", "camera"} <= given.keys() and (plan is not None or "target" in given)
    fields = {name: _FIELDS[name] for name in words}
    text = PageText(f"Record {options.out.name}", fields, "Calibrate")
    setup = replace(_remembered(options.out), **given)
    _serve(options.address, prepare, setup, text, given.values(), begins=is_known)


def verify_on_page(options: VerifyOptions) -> None:
    """Runs `visioncal verify --page`."""
    checks, found = options.session, _calibrations(options.against)

    def prepare(setup: Setup) -> Task:
        against = Path(setup.against)
        calibration = load_calibration(against, options)
        fit, lens = calibration.joint_fit, calibration.camera
        boards = {} if fit is None else fit.targets
        if lens is None or len(boards) != 1:
            raise DataError(
                f"{against}: a page checks the calibration of a camera with one board; this one "
                f"has {counted(len(boards), 'board')}.",
                culprits=[str(against)],
                next_step="Record stops, and check them with visioncal verify.",
            )
        (board,) = boards.values()
        target = target_from_document(board, "board")
        recorded = RecordedCell(calibration.mount, target, calibration.robot)
        x, z = (edge.matrix for edge in calibration.edges.values())
        poses = stops_to_repeat(calibration, None, 2 * CheckLimits.stops).poses
        # The first of them are the widest apart; the others are for where one cannot be reached.
        first = short_order(None, poses[: CheckLimits.stops, :3, 3], 0)
        poses = np.concatenate([poses[first], poses[CheckLimits.stops :]])
        words = "Stand where the calibration stood: the board then fills the orange outline."
        seen = seen_from(calibration.mount, x, z, poses)
        stops = tuple(map(partial(NextPose, words), seen, poses))
        # An unfinished check of this day goes on.
        name = f"{date.today().isoformat()}-{against.resolve().name}"
        names = (name if at == 1 else f"{name}-{at}" for at in range(1, 1000))
        out = next(checks / name for name in names if not _result(checks / name).exists())
        moved = ("--board-moved",) if options.board_moved else ()
        stated = {"--history": options.history, "--cell": options.cell}
        entered = [word for name, to in stated.items() if to for word in (name, str(to))]
        chosen = _with_devices(RecordOptions(out=out), setup)
        return Task(
            partial(_begun, setup, chosen, recorded, None, checks),
            *(recorded, lens.camera, stops, CheckLimits.stops),
            taking_of(chosen, is_driven=False),
            ("verify", str(out), "--against", str(against), *moved, *entered),
            *(_result(out), calibration.controller()),
        )

    form_fields = {"against": ("Cell", found), **{name: _FIELDS[name] for name in _DEVICES}}
    text = PageText(f"Check {checks.name}", form_fields, "Check", partial(_history, checks))
    last = _remembered(checks)
    setup = last if last.against in found else replace(last, against=found[0])
    _serve(options.address, prepare, setup, text)


def _serve(
    address: tuple[str, int] | None,
    prepare: Callable[[Setup], Task],
    setup: Setup,
    text: PageText,
    stated: Collection[str] = (),
    *,
    begins: bool = False,
) -> None:
    """Serves a page until Ctrl-C."""
    client_library("nicegui", "page")
    # It imports NiceGUI, which an extra brings.
    from visioncal.live.page.access import Admission, address_of
    from visioncal.live.page.server import serve

    host, port = address or ("127.0.0.1", 8321)
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        raise DriverError(
            f"the page cannot be served at {host}:{port}: {error.strerror}.",
            culprits=["--address"],
            next_step="Another page may be open there: end it, or name another port, as --address "
            "127.0.0.1:8322; the host is an address of this computer.",
        ) from error
    site, invite, ends = Path.cwd().resolve(), None, "Ctrl-C ends. Views are on the disk at once."
    if host == "localhost" or getattr(address_of(host), "is_loopback", False):
        say(f"The page is at http://{host}:{port}; {ends} Whoever uses this machine can open it.")
    else:
        prepare, at = partial(_confined, prepare, stated, text, site), f"{_reached(host)}:{port}"
        say(
            f"{ends} Whoever opens the page can take and undo views, use this machine's cameras "
            f"and robots, and read what is below {site}. Nothing is encrypted."
        )

        def invite(query: str) -> None:
            say(f"For one browser more, the page is at http://{at}/?{query}")

    admission = Admission(host, port, invite)
    station = Station(prepare, setup, begins=begins)
    try:
        serve(station, text, host, port, admission, opens=sys.stdin.isatty())
    finally:
        station.close()


def _reached(host: str) -> str:
    """The host of a page's address: of all addresses, the one by which this machine is reached."""
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        # Nothing is sent: this asks for the route to an address of no machine.
        link.connect(("192.0.2.1", 9))
        return str(link.getsockname()[0]) if host == "0.0.0.0" else host
    return socket.gethostname() if host == "0.0.0.0" else host


def _confined(
    prepare: Callable[[Setup], Task], stated: Collection[str], text: PageText, site: Path, to: Setup
) -> Task:
    """Makes the task that a browser of the network chose, with files of the site alone.

    Values that the command states or offers may be elsewhere; all else is read as a path, names,
    too.

    Raises:
        DataError: It names others.
    """
    for name, (label, choices) in text.fields.items():
        value = getattr(to, name)
        kind, _, address = value.partition(":") if name == "camera" else ("", "", value)
        # OpenCV opens files by many kinds of addresses, and a producer of GenTL is a program.
        is_right = kind != "uvc" or address.startswith(_STREAMS) or (address or "0").isdecimal()
        with suppress(OSError, ValueError, RuntimeError):
            path = Path(address).resolve()
            is_inside = path.is_relative_to(site) and ".cti" not in address
            if (is_right and is_inside) or value in (*stated, *choices):
                continue
        raise DataError(
            f"{label}: {value[:80]!r} is not below {site}, to which a networked page is kept.",
            culprits=[value[:80]],
            next_step="Start the command in a folder above it, or name it there with --camera, "
            "--target or --robot.",
        )
    return prepare(to)


def _with_devices(recording: RecordOptions, setup: Setup) -> RecordOptions:
    form = setup.pose_form or None
    return replace(recording, arm=setup.arm, camera=setup.camera, pose_form=form)


def _remembered(folder: Path) -> Setup:
    """The last choice; the defaults where nothing is remembered that can be read."""
    try:
        return read(Setup, read_json(folder / _REMEMBERED), _REMEMBERED)
    except DataError:
        return Setup()


@contextmanager
def _begun(
    setup: Setup,
    chosen: RecordOptions,
    recorded: RecordedCell | PlanCell,
    plan: PlanFile | None,
    remembered: Path,
) -> Iterator[tuple[LiveCell, Journal]]:
    """Opens the devices and begins or resumes the session; a folder remembers what was chosen."""
    given = ManualArm(lambda _: "") if setup.arm == "manual" else None
    with opened(chosen, is_moved=False, given=given) as cell:
        check_order(cell, is_resumed=False)
        facts = CaptureFacts.of(cell, chosen.out.name, recorded, plan)
        journal = Journal.resume(chosen.out, facts, cell.clock.unix_offset_s(), 0)
        is_known = given is not None and all(map(picture_name, journal.views))
        if journal.views and isinstance(cell.camera, StoredPictures) and not is_known:
            # Those of the views so far, and of poses that gave none.
            cell.camera.skip()
        # Of a camera's URL without its user and password.
        kept = replace(setup, camera=without_password(setup.camera))
        remembered.mkdir(parents=True, exist_ok=True)
        write_json(remembered / _REMEMBERED, asdict(kept))
        yield cell, journal


def _planned(plan: PlanFile) -> tuple[NextPose, ...]:
    """The stops of a plan, in their order."""
    q = np.array([stop.q for stop in plan.stops])
    poses, seen = plan.cell.robot.base_from_flange(q), plan.cell.cam_from_target(q)
    joints = (", ".join(f"{angle:.2f}" for angle in np.rad2deg(stop.q)) for stop in plan.stops)
    return tuple(
        NextPose(f"Stop {stop.view} of the plan; its joints: {angles} deg.", view, pose)
        for stop, angles, view, pose in zip(plan.stops, joints, seen, poses, strict=True)
    )


def _calibrations(against: Path) -> list[str]:
    """The calibration in a folder, or those in the folders in it."""
    found = [against] if (against / CALIBRATION).is_file() or against.suffix else []
    found = found or sorted(path.parent for path in against.glob(f"*/{CALIBRATION}"))
    if not found:
        raise DataError(
            f"{against} holds no {CALIBRATION}, nor does a folder in it.",
            culprits=[str(against)],
            next_step="Name an output folder of visioncal calibrate, or the folder that has them.",
        )
    return [str(path) for path in found]


def _result(check: Path) -> Path:
    return check.with_name(f"{check.name}-verified")


@dataclass(frozen=True)
class _Checked:
    """Content of a verify.json, as a page shows it."""

    passed: bool
    sentences: tuple[str, ...]


def _history(checks: Path) -> list[tuple[Light, str, str]]:
    """The checks of a folder, the newest first: light, name, first reason."""
    lines: list[tuple[Light, str, str]] = []
    found = checks.glob(f"*-verified/{VERIFY}")
    for path in sorted(found, key=lambda path: path.stat().st_mtime_ns, reverse=True):
        with suppress(DataError):
            check = read(_Checked, parse_stored(read_text(path), str(path)), str(path))
            light: Light = "green" if check.passed else "red"
            name = path.parent.name.removesuffix("-verified")
            lines += ((light, name, words) for words in check.sentences[:1])
    return lines
