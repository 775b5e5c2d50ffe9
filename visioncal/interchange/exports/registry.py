"""The formats that are known, and the way from a result to a document: what of it is meant."""

import re
from dataclasses import dataclass, replace
from typing import get_args

import numpy as np

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean
from visioncal.core.transforms import adjoint, invert
from visioncal.dynamics import Identified
from visioncal.interchange.exports.arm import ArmFormat, select_arm
from visioncal.interchange.exports.armfiles import ARMS, write_dynamics
from visioncal.interchange.exports.content import Content, ExportFormat, OfTransforms, Selection
from visioncal.interchange.exports.controllers import CONTROLLERS
from visioncal.interchange.exports.lens import CAMERA_INFO, KALIBR, OAK
from visioncal.interchange.exports.matrices import OPENCV, TEXT, ZIVID
from visioncal.interchange.exports.programs import PROGRAMS
from visioncal.interchange.exports.robots import ROBOTS
from visioncal.interchange.exports.ros import (
    EASY_HANDEYE,
    EASY_HANDEYE2,
    MOVEIT,
    ROS,
    ROS_LAUNCH,
    URDF,
)
from visioncal.interchange.exports.sources import (
    HAND_EYE,
    Kind,
    Placements,
    Source,
    ends_of,
    is_kind,
    placements,
)
from visioncal.results import Calibration, Edge, Verdict
from visioncal.session.choosing import ARM, EYE, PARTS, Choice

EXPORT_FORMATS: tuple[ExportFormat | ArmFormat, ...] = (
    ROS,
    ROS_LAUNCH,
    MOVEIT,
    EASY_HANDEYE,
    EASY_HANDEYE2,
    URDF,
    CAMERA_INFO,
    KALIBR,
    OAK,
    OPENCV,
    ZIVID,
    TEXT,
    *ROBOTS,
    *CONTROLLERS,
    *PROGRAMS,
    *ARMS,
)
_EVERYTHING = Selection()
# In the place of a transform's name: all of a cell's.
_ALL = "all"
# Such a name needs no quotes in YAML, XML, Python or a shell, and is no option of a command.
_FRAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_/.\-]*", re.ASCII)


@dataclass(frozen=True)
class Document:
    """A result in somebody else's format.

    Attributes:
        text: The document.
        warnings: What its user should know before it is used, each in plain words.
    """

    text: str
    warnings: tuple[str, ...]


@typed
def export(source: Source | Identified, to: str, selection: Selection = _EVERYTHING) -> str:
    """Writes a result in somebody else's format.

    Args:
        source: A calibration, frames alone, or an arm's identified dynamics.
        to: The name of a format among `EXPORT_FORMATS`.
        selection: Which transform, in which direction, and what its frames are to be called; of
            an arm, in which form.

    Returns:
        The document.

    Raises:
        DataError: There is no such format, transform or calibrated arm, the format cannot hold
            what is asked for, or a name cannot be written safely.
    """
    return document(source, to, selection).text


def document(source: Source | Identified, to: str, selection: Selection = _EVERYTHING) -> Document:
    """Writes a result as `export` does, with what is to be warned of.

    Raises:
        DataError: As `export` has it.
    """
    form = _find(to)
    if isinstance(source, Identified):
        return Document(write_dynamics(source, to, selection), ())
    source, selection = _of_whole(source, selection, form)
    if isinstance(form, ArmFormat):
        arm = select_arm(source, selection, form)
        omitted = tuple(f"{name}." for name in arm.omitted)
        return Document(form.write(arm), (*_of_verdict(arm.verdict), *form.warn(arm), *omitted))
    if selection.edge == _ALL:
        contents = _select_all(source, selection, form)
        written = "" if form.write_all is None else form.write_all(contents)
        return Document(written, _of_verdict(contents[0].verdict))
    content = select(source, selection, form)
    return Document(form.write(content), (*_of_verdict(content.verdict), *form.warn(content)))


def _of_whole(
    source: Source, selection: Selection, form: ExportFormat | ArmFormat
) -> tuple[Source, Selection]:
    """Takes one robot's part out of a whole cell, where one is named or an arm is asked for."""
    if not isinstance(source, Calibration) or source.cell is None:
        if selection.robot is not None or selection.target is not None:
            raise DataError(
                "Which robot or target is meant is said of a whole cell alone, and this is none.",
                culprits=["--robot", "--target"],
                next_step="Leave it out.",
            )
        return source, selection
    named = selection.robot is not None or selection.target is not None
    if not named and not isinstance(form, ArmFormat):
        return source, selection
    of_arm = isinstance(form, ArmFormat) or form.holds in ("tool", "fixture")
    needs = PARTS if selection.target is not None else ARM if of_arm else EYE
    choice = Choice(selection.camera, selection.robot, selection.target)
    chosen = source.chosen(choice, ARM if isinstance(form, ArmFormat) else needs)
    return chosen, replace(selection, camera=None, robot=None, target=None)


def _of_verdict(verdict: Verdict) -> tuple[str, ...]:
    if verdict.status != "bad":
        return ()
    return (f"the verdict on this result is bad. {' '.join(verdict.reasons)}",)


def _find(name: str) -> ExportFormat | ArmFormat:
    by_name = {export_format.name: export_format for export_format in EXPORT_FORMATS}
    if name in by_name:
        return by_name[name]
    hint = did_you_mean(name, by_name)
    raise DataError(
        f"There is no format named {name!r}; the names are {', '.join(by_name)}.",
        culprits=[name],
        next_step=f"{hint} visioncal export --list says what each is.".strip(),
    )


def select(source: Source, selection: Selection, form: ExportFormat) -> Content:
    """Picks what is to be exported.

    Args:
        source: A calibration, or frames alone.
        selection: What is asked for.
        form: The format that is to hold it.

    Raises:
        DataError: There is no such transform, the format cannot hold what is asked for, or a
            frame's name cannot be written safely.
    """
    there = placements(source, selection.camera)
    _check_takes(form, selection)
    _check_camera(form, selection, there)
    return _content(form, selection, there, _named(form, selection, there))


def _select_all(source: Source, selection: Selection, form: ExportFormat) -> tuple[Content, ...]:
    """Picks all transforms of an aligned cell, each frame's in that on which it hangs."""
    there = placements(source, selection.camera)
    _check_takes(form, selection)
    why = ""
    if form.write_all is None:
        why = f"{form.name} holds one transform"
    elif selection.inverse or selection.parent is not None or selection.child is not None:
        why = "--inverse, --parent and --child are of one transform"
    elif there.cell is None:
        why = f"{there.words} is of no whole cell"
    if why:
        raise DataError(
            f"--edge all: {why}.",
            culprits=["--edge"],
            next_step=f"Name one of {', '.join(there.by_name)}.",
        )
    return tuple(_content(form, selection, there, name) for name in there.by_name)


def _content(form: ExportFormat, selection: Selection, there: Placements, name: str) -> Content:
    placed, frames = there.find(name)
    rotation_of = None if placed.oriented else placed.turned_as or frames[0]
    edge = placed.edge
    if selection.inverse:
        edge, frames = _inverted(edge), (frames[1], frames[0])
        name = f"inverse of {name}"
    parent, child = (
        _frame(form.frames.get(frame, frame) if chosen is None else chosen)
        for frame, chosen in zip(frames, (selection.parent, selection.child), strict=True)
    )
    if parent == child:
        raise DataError(
            f"parent and child are both named {parent!r}, but a transform joins two frames.",
            culprits=[parent],
            next_step="Give them different names with --parent and --child.",
        )
    return Content(
        name,
        edge,
        parent,
        child,
        frames,
        there.mount,
        there.lenses.get(frames[1], there.lens) if there.cell is not None else there.lens,
        placed.origin,
        placed.verdict,
        rotation_of,
        selection.number,
        selection.load,
        selection.onto,
    )


def _named(form: ExportFormat, selection: Selection, there: Placements) -> str:
    if form.holds == "tool" or form.holds == "fixture":
        name = there.only(form.holds) if selection.edge is None else selection.edge
        there.find(name)
        _check_kind(form, form.holds, name, inverse=selection.inverse)
        return name
    if selection.edge is not None:
        return selection.edge
    if form.holds == "lens" and there.cell is not None:
        frame = next(name for name, lens in there.lenses.items() if lens is there.lens)
        return f"{there.cell.tree.parents[frame]}_from_{frame}"
    return there.default()


def _check_kind(form: ExportFormat, kind: Kind, name: str, *, inverse: bool) -> None:
    """Refuses a tool as a fixture, a fixture as a tool, and anything upside down as either."""
    if is_kind(name, kind) and not inverse:
        return
    wanted = "a tool, flange_from_*" if kind == "tool" else "a fixture, base_from_*"
    other: Kind = "fixture" if kind == "tool" else "tool"
    if inverse:
        what, step = f"the inverse of {name} is none", "Leave --inverse out"
    elif is_kind(name, other):
        what, step = f"{name} is a {other}", f"Write it with --to {form.counterpart}"
    else:
        what = f"{name} has its parent in {ends_of(name)[0]}"
        step = "Choose a format of any poses for it, as --to ros"
    raise DataError(
        f"{form.name} writes {wanted}; {what}.",
        culprits=[name],
        next_step=f"{step}.",
    )


def _check_takes(form: ExportFormat, selection: Selection) -> None:
    form.check(selection, get_args(OfTransforms))
    if selection.number is not None and selection.number < 1:
        raise DataError(
            f"The number is {selection.number}; controllers count tools and bases from 1.",
            culprits=["--number"],
        )
    if selection.load is not None and not (
        0.0 < selection.load.mass_kg < np.inf and np.isfinite(selection.load.centre_mm).all()
    ):
        raise DataError(
            f"The load is {selection.load.mass_kg:g} kg at {selection.load.centre_mm}; a mass "
            "above 0 and three numbers are needed.",
            culprits=["--mass-kg", "--cog-mm"],
        )


def _check_camera(form: ExportFormat, selection: Selection, there: Placements) -> None:
    """Refuses what the formats of the camera do not hold."""
    if form.holds not in ("lens", "hand-eye"):
        return
    if form.holds == "lens" and there.cell is not None:
        _check_lens_alone(form, selection)
        if there.lens is None:
            known = ", ".join(there.lenses) or "none"
            raise DataError(
                f"{form.name} holds one camera; this cell has {known}.",
                culprits=[form.name],
                next_step="Name one with --camera." if there.lenses else "",
            )
        return
    if there.mount is None or there.mount == "instrument":
        raise DataError(
            f"{form.name} holds the camera, and {there.words} has none.",
            culprits=[form.name],
            next_step="Name the calibration instead, or choose a format of poses: --to ros.",
        )
    if form.holds == "lens":
        _check_lens_alone(form, selection)
    hand_eye = selection.edge in (None, *HAND_EYE.values())
    if form.holds == "hand-eye" and (selection.inverse or not hand_eye):
        raise DataError(
            f"{form.name} holds the camera's pose on the flange or in the base, and nothing else.",
            culprits=[form.name],
            next_step="Leave --edge and --inverse out, or choose --to ros.",
        )


def _check_lens_alone(form: ExportFormat, selection: Selection) -> None:
    if selection.inverse or selection.edge is not None or selection.parent is not None:
        raise DataError(
            f"{form.name} holds the lens and no transform: --edge, --inverse and --parent do not "
            "go with it.",
            culprits=[form.name],
            next_step="Leave them out; --child names the camera.",
        )


def _inverted(edge: Edge) -> Edge:
    # (T exp(x))^-1 = T^-1 exp(-adjoint(T) x): the lever arm turns rotation into translation.
    carried = adjoint(edge.matrix)
    return Edge(invert(edge.matrix), np.asarray(carried @ edge.covariance @ carried.T))


def _frame(name: str) -> str:
    if _FRAME.fullmatch(name):
        return name
    raise DataError(
        f"{name!r} cannot be a frame's name: letters, digits and _ / - . are needed, the first a "
        "letter, a digit or _.",
        culprits=[name],
        next_step="Choose other names with --parent and --child.",
    )
