"""All export formats, and the selection of content for them."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.conventions import stated_pose
from visioncal.core.errors import DataError
from visioncal.core.number_format import known_name
from visioncal.core.transforms import adjoint, invert
from visioncal.core.types import FloatArray
from visioncal.core.verdict import AGAIN
from visioncal.dynamics import Identified
from visioncal.dynamics.identified import judge
from visioncal.frames.naming import PARENTS
from visioncal.interchange.exports.arm import ARMS, ArmFormat, select_arm, write_dynamics
from visioncal.interchange.exports.content import (
    HAND_EYE,
    OF_TRANSFORMS,
    Content,
    ExportFormat,
    Placements,
    Selection,
    Source,
    ends_of,
    is_camera,
    is_kind,
    placements,
    worst_of,
)
from visioncal.interchange.exports.halcon import HALCON
from visioncal.interchange.exports.lenses import poorer
from visioncal.interchange.exports.mujoco import MUJOCO
from visioncal.interchange.exports.robots import ROBOTS
from visioncal.interchange.exports.ros import FILES, ROS_FORMATS
from visioncal.results import Calibration, Edge, Verdict
from visioncal.session.frames import frame_name
from visioncal.session.selecting import ARM, EYE, PARTS

EXPORT_FORMATS: tuple[ExportFormat | ArmFormat, ...] = (
    *ROS_FORMATS,
    *FILES,
    *HALCON,
    MUJOCO,
    *ROBOTS,
    *ARMS,
)
_EVERYTHING = Selection()
# In place of a transform's name: all transforms.
_ALL = "all"
# Such a name needs no quotes in YAML, XML, Python or a shell, and is no command option.
_FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_/.\-]*", re.ASCII)
# Advice where a camera's body is named.
_OF_BODY = (
    "Say where that one is in {0}, as ros2 run tf2_ros tf2_echo {0} camera_color_optical_frame "
    "prints it: its offset in metres for the zeros below (all of 0,0,0,0,0,0,1 where the name is "
    f"that of the optical frame after all). Run: {AGAIN} --child-from-cam 0,0,0,-0.5,0.5,-0.5,0.5"
)
# Names of bodies, and of the frames beside optical ones in the drivers of depth cameras: their x is
# forward (REP 103).
_BODY = re.compile(r"(?:.*[_/])?(?:link|(?:color|depth|infra[12]?)_frame)", re.IGNORECASE)


@dataclass(frozen=True)
class Document:
    """A result in a foreign format."""

    text: str
    verdict: Verdict  # The worst verdict of what was written.
    # Further warnings for its user, each in plain words.
    warnings: tuple[str, ...] = ()
    # The heading of what was written, in a format without comments.
    notes: tuple[str, ...] = ()


@typed
def export(source: Source | Identified, to: str, selection: Selection = _EVERYTHING) -> str:
    """Writes a result in a foreign format.

    Args:
        source: A calibration, a file of frames, or an arm's identified dynamics.
        to: The name of a format among `EXPORT_FORMATS`.
        selection: The transform, its direction and its frames' names; or the form of an arm.

    Returns:
        The document.

    Raises:
        DataError: There is no such format, transform or calibrated arm, the format cannot hold the
            selection, or a name cannot be written safely.
    """
    return document(source, to, selection).text


def document(source: Source | Identified, to: str, selection: Selection = _EVERYTHING) -> Document:
    """Writes a result as `export` does, together with its warnings; raises DataError."""
    by_name = {form.name: form for form in EXPORT_FORMATS}
    step = "visioncal export --list says what each is."
    form = by_name[known_name("format", to, by_name, next_step=step)]
    if isinstance(source, Identified):
        return Document(write_dynamics(source, to, selection), judge(source))
    source, selection = _robot_part(source, selection, form)
    if isinstance(form, ArmFormat):
        arm = select_arm(source, selection, form)
        omitted = (f"{words}." for words in arm.omitted)
        return Document(form.write(arm), arm.calibration.verdict, (*form.warn(arm), *omitted))
    if selection.edge == _ALL:
        available = placements(source, selection.camera)
        _check_takes(form, selection)
        one = (getattr(selection, field) for field in OF_TRANSFORMS if field != "edge")
        if form.write_all is None or any(one):
            forms = [one.name for one in EXPORT_FORMATS if getattr(one, "write_all", None)]
            raise DataError(
                f"--edge all: all transforms are written as {', '.join(forms)}, without --inverse, "
                "--parent and --child.",
                culprits=["--edge"],
                next_step=f"Name one of {', '.join(available.by_name)}.",
            )
        # In a tree, a frame has one parent: the depth camera's is that of the images.
        names = {ends_of(name)[1]: name for name in available.by_name}
        contents = tuple(_content(form, selection, available, name) for name in names.values())
        text = form.write_all(contents)
    else:
        contents = (select(source, selection, form),)
        text = form.write(contents[0])
    worst = worst_of(content.verdict for content in contents)
    conditions = (condition.words for content in contents for condition in content.conditions)
    warnings = (words for content in contents for words in form.warn(content))
    notes = () if form.has_comments else tuple(contents[0].heading)
    return Document(text, worst, (*dict.fromkeys(conditions), *warnings), notes)


def _robot_part(
    source: Source, selection: Selection, form: ExportFormat | ArmFormat
) -> tuple[Source, Selection]:
    """Extracts one robot's part of a cell, where a robot is named or an arm is exported."""
    is_arm, names = isinstance(form, ArmFormat), (selection.robot, selection.target)
    if not isinstance(source, Calibration) or source.cell is None:
        if {*names, selection.camera} != {None}:
            raise DataError(
                "Only a whole cell takes --camera, --robot and --target: this is of one camera "
                "and robot.",
                culprits=["--camera", "--robot", "--target"],
                next_step="Leave it out.",
            )
        return source, selection
    if names == (None, None) and not is_arm:
        return source, selection
    of_robot = ARM if isinstance(form, ArmFormat) or form.holds in ("tool", "fixture") else EYE
    needs = PARTS if selection.target is not None and not is_arm else of_robot
    part = source.chosen(selection, needs)
    edge = selection.edge
    if edge is not None and selection.robot is not None:
        # The robot's part has its frames without its name.
        for kind in ("base", "flange"):
            edge = re.sub(f"^{frame_name(kind, selection.robot)}_from_", f"{kind}_from_", edge)
    return part, replace(selection, camera=None, robot=None, target=None, edge=edge)


def select(source: Source, selection: Selection, form: ExportFormat) -> Content:
    """Selects the content to export; raises DataError."""
    available, name = placements(source, selection.camera), selection.edge
    _check_takes(form, selection)
    why = _camera_fault(form, selection, available)
    if name is None and not why and form.holds == "lens" and available.cell is not None:
        frame = next(name for name, lens in available.lenses.items() if lens is available.lens)
        name = f"{available.cell.tree.parents[frame]}_from_{frame}"
    elif name is None and not why:
        name = available.chosen(form.holds)
    if form.holds == "tool" or form.holds == "fixture":
        what = f"the inverse of {name}" if selection.inverse else name
        if selection.inverse or not is_kind(name or "", form.holds):
            why = f"writes a {form.holds}, {PARENTS[form.holds]}_from_*, and {what} is none"
    if why or name is None:
        raise DataError(
            f"{form.name} {why}.",
            culprits=[form.name],
            next_step="Choose another format, as --to ros, or other options.",
        )
    return _content(form, selection, available, name)


def _camera_fault(form: ExportFormat, selection: Selection, available: Placements) -> str:
    """Why a format of the camera, or of its transform, cannot hold a selection; else empty."""
    of_lens, cell, edge = form.holds == "lens", available.cell, selection.edge
    if form.holds not in ("lens", "hand-eye"):
        return ""
    if not (of_lens and cell is not None) and available.mount in (None, "instrument"):
        return f"holds the camera, and {available.words} has none"
    if of_lens and (selection.inverse or edge or selection.parent or selection.child_from_cam):
        return "holds the lens and no transform; --child names the camera"
    if of_lens and cell is not None and available.lens is None:
        return f"holds one camera; this cell has {', '.join(available.lenses) or 'none'}"
    if not of_lens and (selection.inverse or edge not in (None, *HAND_EYE.values())):
        return "holds the camera's pose on the flange or in the base, and nothing else"
    return ""


def _content(form: ExportFormat, selection: Selection, available: Placements, name: str) -> Content:
    placement, frames = available.find(name)
    rotation_of = placement.rotation_of or frames[0]
    # The poses of tools, fixtures and targets depend on no convention of a lens.
    of_camera = any(map(is_camera, frames))
    edge, lens, optical = placement.edge, available.lens, ""
    given = (selection.parent, selection.child)
    named = given[::-1] if selection.inverse else given
    if selection.child_from_cam is not None:
        child = named[1]
        child_from_cam = _child_from_cam(selection.child_from_cam, child, frames[1])
        # T exp(x) C^-1 = T C^-1 exp(adjoint(C) x).
        edge = _carried(edge, edge.matrix @ invert(child_from_cam), adjoint(child_from_cam))
        stated = ", ".join(f"{value:g}" for value in selection.child_from_cam)
        optical = f"{child} is another frame than the optical one, which stands in it at ({stated})"
        name, frames = f"{name} * cam_from_{child}", (frames[0], "")
    if form.holds != "lens":
        _check_optical(frames[0], named[0], "Give it the name of an optical frame.")
        _check_optical(frames[1], named[1], _OF_BODY)
    if selection.inverse:
        # (T exp(x))^-1 = T^-1 exp(-adjoint(T) x): the lever arm turns rotation into translation.
        edge = _carried(edge, invert(edge.matrix), adjoint(edge.matrix))
        name, frames = f"inverse of {name}", (frames[1], frames[0])
    parent, child = (
        form.frames.get(frame, frame) if stated is None else stated
        for frame, stated in zip(frames, given, strict=True)
    )
    for frame in (parent, child):
        if not _FRAME.fullmatch(frame):
            raise DataError(
                f"{frame!r} cannot be a frame's name: it must have letters, digits and _ / - . "
                "alone, and begin with a letter, a digit or _.",
                culprits=[frame],
                next_step="Choose other names with --parent and --child.",
            )
    if parent == child:
        raise DataError(
            f"parent and child are both named {parent!r}, but a transform joins two frames.",
            culprits=[parent],
            next_step="Give them different names with --parent and --child.",
        )
    if available.cell is not None:
        lens = available.lenses.get(frames[1], lens)
    camera, words = None if lens is None else lens.camera, ""
    if camera is not None and selection.lens is not None:
        camera, words = poorer(camera, selection.lens)
    conditions = tuple(
        condition
        for condition in placement.conditions
        if form.holds != "lens" and (of_camera or condition.kind != "own-lens")
    )
    return Content(
        **vars(replace(placement, edge=edge, rotation_of=rotation_of, conditions=conditions)),
        name=name,
        parent=parent,
        child=child,
        frames=frames,
        mount=available.mount,
        lens=lens,
        camera=camera,
        poorer=words,
        optical=optical,
        number=selection.number,
        load=selection.load,
        onto=selection.onto,
    )


def _carried(edge: Edge, matrix: FloatArray, jacobian: FloatArray) -> Edge:
    """Another transform, with the covariance that the edge's has by the (6, 6) Jacobian."""
    return Edge(matrix, np.asarray(jacobian @ edge.covariance @ jacobian.T))


def _child_from_cam(numbers: Sequence[float], child: str | None, frame: str) -> FloatArray:
    """(4, 4) pose of a camera's optical frame in the frame that is exported; raises DataError."""
    # No part of a camera is farther away [m].
    named = f"under the name {child!r}" if child else "without a name"
    if child is None or not is_camera(frame) or max(map(abs, numbers[:3])) > 3.0:
        raise DataError(
            f"--child-from-cam is ({', '.join(f'{value:g}' for value in numbers)}), for {frame} "
            f"{named}, but must be the pose of a camera's optical frame in a named frame, in "
            "metres, at most 3 m away.",
            culprits=["--child-from-cam"],
            next_step="Give x,y,z,qx,qy,qz,qw and a name, as --child camera_link, of a camera "
            "(with --inverse it is the parent: --parent camera_link).",
        )
    return stated_pose(numbers, "--child-from-cam")


def _check_optical(frame: str, name: str | None, next_step: str) -> None:
    """Refuses the name of a camera's body for its optical frame; raises DataError."""
    if name and is_camera(frame) and _BODY.fullmatch(name):
        raise DataError(
            f"{name!r} is by its name the frame of a camera's body, x forward, and what was "
            "calibrated is its optical frame, z forward and x right: under that name it would be "
            "wrong by a turn of 90 degrees or more.",
            culprits=[name],
            next_step=next_step.format(name),
        )


def _check_takes(form: ExportFormat, selection: Selection) -> None:
    form.check(selection, OF_TRANSFORMS)
    number, load = selection.number, selection.load
    is_load = load is None or (0.0 < load.mass_kg < np.inf and np.isfinite(load.centre_mm).all())
    if not is_load or (number is not None and number < 1):
        raise DataError(
            f"{load} and the number {number} must be a mass above 0 with three numbers, and a "
            "number from 1 on.",
            culprits=["--number", "--mass-kg", "--cog-mm"],
        )
