"""Tools and fixtures, as text: their poses, whether to trust them, and why not."""

from collections.abc import Iterator, Sequence

import rerun as rr

from visioncal.present.details import details
from visioncal.present.recording import paths
from visioncal.present.recording.notes import edge_line, plain
from visioncal.results import Calibration, Frame, Observation


def log_static(stream: rr.RecordingStream, calibration: Calibration) -> None:
    """Logs what is to be said of the frames, where there are any."""
    if calibration.frames:
        text = rr.TextDocument(markdown(calibration), media_type=rr.MediaType.MARKDOWN)
        stream.log(paths.TOOLS, text, static=True)


def markdown(calibration: Calibration) -> str:
    """All frames, each with its verdict, its pose, its observations and its figures."""
    return "\n".join(line for name, it in calibration.frames.items() for line in _frame(name, it))


def _frame(name: str, frame: Frame) -> Iterator[str]:
    yield from (f"# {plain(name)}: {frame.verdict.headline}", "")
    for reason in frame.verdict.reasons:
        yield f"- {plain(reason)}"
    yield from ("", "| x, y, z [mm] | rotation vector [deg] | sigma |", "|---|---|---|")
    yield edge_line(frame.edge)
    used = sum(it.used for it in frame.observations)
    yield ""
    yield (
        f"{used} of {len(frame.observations)} observations used, off by {frame.rms_mm:.2g} mm "
        f"(rms); noise {frame.noise_mm:.2g} mm per axis."
    )
    yield from ("", *_observations(frame.observations))
    yield f"- {plain(frame.method)}, {plain(frame.source)}, {plain(frame.created)}"
    for label, value, unit in details(frame.details):
        yield f"- {plain(label)}: {plain(value)} {unit}".rstrip()
    yield ""


def _observations(observations: Sequence[Observation]) -> Iterator[str]:
    """What is wrong with some, and a table of all; its cells have no room for reasons."""
    for it in observations:
        if it.reason or not it.used:
            reason = f": {plain(it.reason)}" if it.reason else ""
            state = "used" if it.used else "not used"
            yield f"- **{plain(f'{it.kind} {it.name}'.strip())} {state}**{reason}"
    if observations:
        yield from ("", "| observation | kind | mm | used |", "|---|---|---:|---|")
    for it in observations:
        away = "" if it.residual_mm is None else f"{it.residual_mm:.2g}"
        used = "yes" if it.used else "**no**"
        yield f"| {plain(it.name)} | {plain(it.kind)} | {away} | {used} |"
    yield ""
