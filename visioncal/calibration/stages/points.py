"""Hand-eye from points that a 3D sensor measures, such as a ball's centre, and not from boards.

A camera on the flange that measures a point fixed in the base stands to it as an instrument on the
base stands to a point of the flange, where the arm is taken from its other end:

    point_cam = flange_from_cam^-1 * base_from_flange^-1 * point_base

A fixed camera is an instrument as it is. Such sessions are therefore solved as those of an
instrument whose noise is unknown, and the answer is named again.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from visioncal.core.errors import DataError, VisioncalError
from visioncal.core.transforms import invert
from visioncal.core.types import CameraMount
from visioncal.results import Calibration
from visioncal.session import Session
from visioncal.session.columns import INSTRUMENT_POSITION, POSE, pose_row
from visioncal.session.frames import edge_names
from visioncal.session.table import reported_matrices

_OTHERS = ("camera", "cameras", "mount", "target", "targets", "robot", "robots", "frames", "prior")
_EDGES = edge_names("instrument")


def as_instrument(session: Session) -> Session:
    """The session in which an instrument sees what the camera sees.

    Raises:
        DataError: It has several cameras, or rows without points or poses of the flange.
    """
    flanges = reported_matrices(session.views)
    seen = [row for row in session.views if row.reading_m is not None and row.number in flanges]
    if len(session.cameras) > 1 or len(session.robots) > 1 or not seen:
        raise DataError(
            'session.toml: a camera with model = "points" must be the only one, of one robot, and '
            "its rows must have the point (meas_x_m, meas_y_m, meas_z_m) and the flange's pose "
            f"(x_m to qw); {len(seen)} of {len(session.views)} rows have both.",
            culprits=["session.toml: camera", "views.csv: meas_x_m"],
        )
    is_held = _mount(session) == "eye-in-hand"
    columns = ("view", "role", "stop", "point", *POSE, *INSTRUMENT_POSITION)
    cells = []
    for row in seen:
        pose = invert(flanges[row.number]) if is_held else flanges[row.number]
        cell = {name: row.cell(name) for name in columns}
        cells.append([*(cell | {key: repr(at) for key, at in pose_row(pose).items()}).values()])
    names = dict(zip(edge_names(_mount(session)), _EDGES, strict=True))
    prior = {
        names.get(edge, edge): table for edge, table in session.document.get("prior", {}).items()
    }
    document = {key: value for key, value in session.document.items() if key not in _OTHERS}
    # Noise of the instrument, far under that of the arm, which is estimated with it [m].
    return session.with_content(
        document={**document, "instrument": {"sigma_m": 1e-6}, "prior": prior},
        columns=columns,
        cells=cells,
        target_document=None,
        robot_document=None,
        corners=None,
    )


def as_hand_eye(found: Calibration, session: Session) -> Calibration:
    """The result of `as_instrument` as that of the session's own camera."""
    names = edge_names(_mount(session))
    noise = {"combined_translation_mm": found.noise["robot_translation_mm"]}
    findings = tuple(
        replace(finding, words=_said(finding.words, session)).with_do(
            lambda do: replace(do, words=_said(do.words, session))
        )
        for finding in found.verdict.findings
    )
    return replace(
        found,
        session_sha256=session.digest(),
        mount=_mount(session),
        edges=dict(zip(names, found.edges.values(), strict=True)),
        solvers={
            name: replace(one, matrices=dict(zip(names, one.matrices.values(), strict=False)))
            for name, one in found.solvers.items()
        },
        noise=noise,
        verdict=replace(found.verdict, findings=findings),
        robot_form=next((robot.form for robot in session.robots.values()), None),
        instrument=None,
        points=(),
        joint_fit=None,
    )


def _mount(session: Session) -> CameraMount:
    # The session's own mount is that of an instrument, as rows have readings.
    return session.declaration.mount or "eye-in-hand"


@contextmanager
def named(session: Session) -> Iterator[None]:
    """Raises errors about the instrument as those about the camera."""
    try:
        yield
    except VisioncalError as error:
        culprits = [_said(culprit, session) for culprit in error.culprits]
        message, step = (_said(words, session) for words in (error.message, error.next_step))
        raise error.but(message, culprits=culprits, next_step=step) from error


def _said(words: str, session: Session) -> str:
    """A sentence about the instrument as one about the camera, with base and tool exchanged.

    Names in quotes and parts of paths stay, whatever they are.
    """
    said = dict(zip(_EDGES, edge_names(_mount(session)), strict=True)) | {"instrument": "camera"}
    said |= {"probe": "point", "tracker": "sensor"}
    if _mount(session) == "eye-in-hand":
        said |= {"base": "tool", "tool": "base"}
    pattern = rf"(?<![\w/'\"])(?:{'|'.join(said)})(?![\w/])"
    return re.sub(pattern, lambda found: said[found[0]], words)
