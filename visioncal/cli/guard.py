"""`visioncal guard`."""

import json
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from typing import Any

import numpy as np
import typer
from scipy.spatial.transform import Rotation

from visioncal.cli.console import EXIT_BAD, EXIT_NO_RESULT, say
from visioncal.cli.result_options import GuardOptions
from visioncal.core.documents.jsons import parse_json, parse_stored
from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.files import MOST_BYTES, read_text, write_atomically
from visioncal.core.transforms import compose
from visioncal.core.types import Corners, FloatArray, Target
from visioncal.frames.target_in_image import corners_seen
from visioncal.interchange.result_files import load_result
from visioncal.results import select_matching
from visioncal.session import Session
from visioncal.verification.guard import Guard, Look
from visioncal.verification.scene_guard import scene_looks
from visioncal.vision.boards.imaging import read_image


def guard_command(options: GuardOptions) -> None:
    """Runs `visioncal guard`."""
    if options.scene is not None:
        _by_scene(options, options.scene)
        return
    calibration = load_result(options.against).chosen(options)
    guard = Guard(calibration, false_alarm_looks=options.false_alarm_looks, slow_mm=options.slow_mm)
    if options.state is not None and options.state.exists():
        try:
            guard.restore(parse_stored(read_text(options.state), str(options.state)))
        except DataError as error:
            step = "Delete it, if it is the guard's, which then learns anew; else name another."
            raise error.but(culprits=[str(options.state)], next_step=step) from error
    if sys.stdin.isatty():
        say("Looks are read from the keyboard, a JSON line each; Ctrl-D ends them.")
    holds, is_refused, count = guard.holds, False, 0
    answers: list[dict[str, Any]] = []
    try:
        for count, answer in enumerate(_answers(guard), 1):
            typer.echo(json.dumps(answer, allow_nan=False))
            sys.stdout.flush()
            is_refused = is_refused or "error" in answer
            answers += [answer] * (options.recording is not None)
            # A program that is killed loses fewer than 50 looks of what it has learned.
            if count % 50 == 0 or guard.holds != holds:
                holds = guard.holds
                _keep(guard, options.state)
    finally:
        _keep(guard, options.state)
        if options.recording is not None and answers:
            from visioncal.present.recording.timeline import record_looks

            record_looks(options.recording, answers, f"guard of {calibration.session_name}")
    if not count:
        raise DataError(
            "stdin held no look, so nothing was judged.",
            culprits=["stdin"],
            next_step="Write one JSON line per look, as in: visioncal guard --example | visioncal "
            f"guard --against {shlex.quote(str(options.against))}",
        )
    if not guard.holds or is_refused:
        raise typer.Exit(EXIT_NO_RESULT if guard.holds else EXIT_BAD)


def _by_scene(options: GuardOptions, images: Path) -> None:
    """Answers each of a session's images of the standing scene."""
    session, calibration = select_matching(
        Session.load(images), load_result(options.against), options
    )
    looks = scene_looks(
        session,
        calibration,
        mask=None if options.mask is None else read_image(options.mask) > 127,
        plane=options.plane or "",
        steady_px=options.steady_px,
        false_alarm_looks=options.false_alarm_looks,
    )
    holds, is_refused = True, False
    for look in looks:
        typer.echo(json.dumps(look.document, allow_nan=False))
        sys.stdout.flush()
        holds, is_refused = look.holds, is_refused or bool(look.found.reason)
    if not holds or is_refused:
        raise typer.Exit(EXIT_NO_RESULT if holds else EXIT_BAD)


def _keep(guard: Guard, path: Path | None) -> None:
    if path is not None:
        write_atomically(path, json.dumps(guard.document, allow_nan=False) + "\n")


def _answers(guard: Guard) -> Iterator[dict[str, Any]]:
    """Answers the lines of stdin; one that cannot be used changes nothing."""
    if isinstance(sys.stdin, TextIOWrapper):
        sys.stdin.reconfigure(encoding="utf-8", errors="replace")
    # A line that never ends comes in pieces, none of which is a look.
    lines = iter(partial(sys.stdin.readline, MOST_BYTES), "")
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            document = parse_json(line, "the look")
            if not isinstance(document, dict):
                raise DataError(f"the look is {line.strip()[:60]}, but must be a JSON object.")
            if document == {"acknowledge": True}:
                guard.acknowledge()
                yield {"acknowledged": True}
            else:
                yield guard.update(_look(document, guard.prior.targets)).document
        except VisioncalError as error:
            yield {"error": {"message": f"line {number}: {error.message}", "next": error.next_step}}


def _look(document: dict[str, Any], targets: Mapping[str, Target]) -> Look:
    """A look of a line's JSON object, in which null is as good as absent.

    In an image that it names, the target is looked for.

    Raises:
        DataError: It has other keys or values.
    """
    if unknown := [key for key in document if key not in _KEYS]:
        raise DataError(
            f"the look has {unknown[0]!r}; the keys are {', '.join(_KEYS)}; or acknowledge alone, "
            "true.",
            culprits=unknown,
        )
    given = {key: value for key, value in document.items() if value is not None}
    if "time_s" not in given:
        raise DataError("the look has no time_s, in seconds.", culprits=["time_s"])
    content: dict[str, Any] = {}
    for key, value in given.items():
        read, needed = _KEYS[key]
        try:
            content[key] = read(value)
        except (TypeError, ValueError):
            words = f"the look's {key} is {json.dumps(value)[:60]}; it has to be {needed}."
            raise DataError(words, culprits=[key]) from None
    if "image" in content:
        content |= {"corners": _found(content.pop("image"), content, targets)}
    return Look(**content)


def _found(path: Path, content: Mapping[str, Any], targets: Mapping[str, Target]) -> Corners:
    if "corners" in content:
        raise DataError("the look has image and corners, but must have one of the two.")
    names = [content["target"]] if "target" in content else list(targets)
    if len(names) != 1 or names[0] not in targets:
        known = ", ".join(filter(None, targets)) or "none, or one without a name"
        raise DataError(
            f"the look's image shows one of the targets calibrated with, which are {known}.",
            culprits=["target"],
            next_step="Name it as target; where there is none, send cam_from_target.",
        )
    return corners_seen(read_image(path), targets[names[0]], str(path))


def _pose(value: Any) -> FloatArray:  # noqa: ANN401 - of JSON
    numbers = _numbers(value)
    if numbers.shape == (7,):
        return compose(Rotation.from_quat(numbers[3:]).as_matrix(), numbers[:3])
    return numbers


def _corners(value: Any) -> Corners:  # noqa: ANN401 - of JSON
    table = _numbers(sorted(value)).reshape(-1, 3)
    if not (np.diff(table[:, 0]) >= 1.0).all() or (table[:, 0] % 1.0 != 0.0).any():
        raise ValueError
    return Corners(0, table[:, 0].astype(np.int64), table[:, 1:], 0.0)


_numbers = partial(np.asarray, dtype=float)
_A_POSE = (_pose, "a 4 x 4 matrix or x, y, z, qx, qy, qz, qw, in metres")
# By key what reads its value, and what that has to be.
_KEYS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "time_s": (float, "a number of seconds"),
    "base_from_flange": _A_POSE,
    "cam_from_target": _A_POSE,
    "corners": (_corners, "a list of [number, x, y] in pixels, each whole number once"),
    "image": (Path, "the path of an image"),
    "joints_rad": (_numbers, "a list of radians"),
    "target": (str, "a name"),
}
