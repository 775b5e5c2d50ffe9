"""The certificate: one page to print and sign."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from visioncal.core.files import write_atomically
from visioncal.core.limits import CalibrationLimits
from visioncal.core.number_format import figure
from visioncal.core.version import __version__
from visioncal.present.facts import readable_time
from visioncal.present.report.content import need_facts
from visioncal.present.report.templates import template
from visioncal.results import Calibration
from visioncal.session import Session

# Largest number of transforms that fit the page; the report has all.
_MOST_EDGES = 4
_Facts = list[tuple[str, str]]


@dataclass(frozen=True)
class CertificateEntries:
    """What a person adds to a certificate."""

    operator: str = ""  # Who made the calibration; empty to be filled in by hand.
    serials: Mapping[str, str] = field(default_factory=dict)  # Serial numbers by device.


def write_certificate(
    path: Path, calibration: Calibration, session: Session | None, signed: CertificateEntries
) -> None:
    """Writes the certificate as one HTML page that fits one sheet of A4.

    Args:
        path: The file; it appears whole or not at all.
        calibration: Calibration to certify.
        session: Session of the calibration; None if it is not at hand.
        signed: What a person adds to it.

    Raises:
        DataError: The file cannot be written.
    """
    verdict = calibration.verdict
    text = template("certificate.html.j2").render(
        name=calibration.session_name,
        status=verdict.status,
        says=verdict.top[:2],
        parts=(
            ("Cell", [*_cell(calibration, session, signed)]),
            ("Result", [*_result(calibration)]),
            ("Limits", [*_limits(calibration)]),
            ("Provenance", _provenance(calibration)),
        ),
    )
    write_atomically(path, text)


def _cell(
    calibration: Calibration, session: Session | None, signed: CertificateEntries
) -> Iterator[tuple[str, str]]:
    if calibration.cell is None:
        yield "Mount", calibration.mount
    if calibration.robot is not None:
        yield "Robot", calibration.robot.name
    if session is not None:
        robots = {
            name: robot.model for name, robot in session.robots.items() if name and robot.model
        }
        if robots:
            yield "Robots", "; ".join(f"{name} ({model})" for name, model in robots.items())
        cameras = [camera for camera in session.cameras if camera] or [session.camera_name]
        yield "Cameras" if len(cameras) > 1 else "Camera", "; ".join(cameras)
        boards = {
            f"{board.name}, {board.columns} x {board.rows}, {1e3 * board.square_m:g} mm"
            if board.columns
            else board.name
            for board in session.boards.values()
        }
        if boards:
            yield "Boards" if len(boards) > 1 else "Board", "; ".join(sorted(boards))
    yield from ((f"Serial number, {of}", number) for of, number in signed.serials.items())
    if signed.operator:
        yield "Operator", signed.operator


def _result(calibration: Calibration) -> Iterator[tuple[str, str]]:
    for fact in need_facts(calibration.need, calibration.verdict):
        yield fact.label[0].upper() + fact.label[1:], f"{fact.value} {fact.note}".strip()
    for condition in calibration.conditions:
        yield "Only where", condition.words
    for name, edge in [*calibration.placed.items()][:_MOST_EDGES]:
        rotation = edge.rotation_words(calibration.controller)
        yield name, f"{edge.place_words(3)}; {rotation}; {edge.sigma_words}"
    if (test := calibration.touch_test) is not None:
        largest = max(point.gap_mm for point in test.points)
        words = "passed" if test.passed else "not passed"
        yield "Touch test", f"{words}, largest gap {figure(largest)} mm, with {test.tool}"
    left_out = calibration.validation.held_out
    rotation_words = "" if left_out.deg is None else f" and {figure(left_out.deg)} deg"
    used = sum(view.used for view in calibration.views)
    yield "Views used", f"{used} of {len(calibration.views)}"
    yield "Left out, views are predicted to", f"{figure(left_out.mm)} mm{rotation_words} (rms)"


def _limits(calibration: Calibration) -> Iterator[tuple[str, str]]:
    if calibration.need is not None:
        yield "Good", "a pick lands within the need with 95 % or more, and nothing is unexplained"
        return
    limits = CalibrationLimits()
    yield (
        "Doubt begins at",
        f"views left out {limits.scatter_mm[0]:g} mm and {limits.scatter_deg[0]:g} deg; sigma of "
        f"a transform {limits.sigma_mm[0]:g} mm and {limits.sigma_deg[0]:g} deg; corners "
        f"{limits.pixel_px[0]:g} px; robot {limits.robot_mm:g} mm; under {limits.stops[0]} stops",
    )


def _provenance(calibration: Calibration) -> _Facts:
    return [
        ("Calibrated", readable_time(calibration.created)),
        ("SHA-256 of the session", calibration.session_sha256),
        ("Software", f"visioncal {__version__}"),
    ]
