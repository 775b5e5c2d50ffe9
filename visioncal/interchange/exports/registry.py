"""The formats that are known, and the way from a result to a document."""

from dataclasses import dataclass, replace

from visioncal.core.errors import DataError
from visioncal.core.files import did_you_mean
from visioncal.dynamics import Identified
from visioncal.interchange.exports.arm import ArmFormat, select_arm
from visioncal.interchange.exports.armfiles import ARMS
from visioncal.interchange.exports.choosing import select, select_all
from visioncal.interchange.exports.content import Selection
from visioncal.interchange.exports.controllers import CONTROLLERS
from visioncal.interchange.exports.dynamics import write_dynamics
from visioncal.interchange.exports.format import ExportFormat
from visioncal.interchange.exports.launch import MOVEIT, ROS_LAUNCH
from visioncal.interchange.exports.lens import CAMERA_INFO, KALIBR, OAK
from visioncal.interchange.exports.matrices import OPENCV, TEXT, ZIVID
from visioncal.interchange.exports.programs import PROGRAMS
from visioncal.interchange.exports.robots import ROBOTS
from visioncal.interchange.exports.ros import EASY_HANDEYE, EASY_HANDEYE2, ROS
from visioncal.interchange.exports.sources import Source
from visioncal.interchange.exports.urdf import URDF
from visioncal.results import Alignment, Calibration, Verdict
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


@dataclass(frozen=True)
class Document:
    """A result in somebody else's format.

    Attributes:
        text: The document.
        warnings: What its user should know before it is used, each in plain words.
    """

    text: str
    warnings: tuple[str, ...]


def export(source: Source | Identified, to: str, selection: Selection = _EVERYTHING) -> str:
    """Writes a result in somebody else's format.

    Args:
        source: A calibration, frames alone, an aligned cell, or an arm's identified dynamics.
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
        omitted = tuple(f"{it}." for it in arm.omitted)
        return Document(form.write(arm), (*_of_verdict(arm.verdict), *form.warn(arm), *omitted))
    if selection.edge == _ALL:
        contents = select_all(source, selection, form)
        written = "" if form.write_all is None else form.write_all(contents)
        return Document(written, _of_verdict(contents[0].verdict))
    content = select(source, selection, form)
    warning = form.warn(content)
    return Document(
        form.write(content), (*_of_verdict(content.verdict), *([warning] if warning else []))
    )


def _of_whole(
    source: Source, selection: Selection, form: ExportFormat | ArmFormat
) -> tuple[Source, Selection]:
    """Takes one robot's part out of a whole cell, where one is named or an arm is asked for."""
    whole = Calibration.whole(source) if isinstance(source, Alignment) else source
    if not isinstance(whole, Calibration) or whole.cell is None:
        if selection.robot is not None or selection.target is not None:
            raise DataError(
                "Which robot or target is meant is said of a whole cell alone, and this is none.",
                culprits=["--robot", "--target"],
                next_step="Leave it out.",
            )
        return source, selection
    named = selection.robot is not None or selection.target is not None
    if not named and not isinstance(form, ArmFormat):
        return whole.cell, selection
    of_arm = isinstance(form, ArmFormat) or form.holds in ("tool", "fixture")
    needs = PARTS if selection.target is not None else ARM if of_arm else EYE
    choice = Choice(selection.camera, selection.robot, selection.target)
    chosen = whole.chosen(choice, ARM if isinstance(form, ArmFormat) else needs)
    return chosen, replace(selection, camera=None, robot=None, target=None)


def _of_verdict(verdict: Verdict) -> tuple[str, ...]:
    if verdict.status != "bad":
        return ()
    return (f"the verdict on this result is bad. {' '.join(verdict.reasons)}",)


def _find(name: str) -> ExportFormat | ArmFormat:
    by_name = {it.name: it for it in EXPORT_FORMATS}
    if name in by_name:
        return by_name[name]
    hint = did_you_mean(name, by_name)
    raise DataError(
        f"There is no format named {name!r}; the names are {', '.join(by_name)}.",
        culprits=[name],
        next_step=f"{hint} visioncal export --list says what each is.".strip(),
    )
