"""Storage of a recording on disk: each view is complete and flushed before the next is taken."""

import errno
import json
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import tomli_w

from visioncal.core.choices import POSE_FORMS
from visioncal.core.documents.toml import read_toml
from visioncal.core.errors import DataError
from visioncal.core.files import flush_folder, named_errors, read_bytes, write_atomically
from visioncal.core.temporary import remove_abandoned
from visioncal.core.types import Camera, Image, Image16, Mount, Target
from visioncal.core.version import __version__
from visioncal.live.capture.cell import LiveCell
from visioncal.live.capture.take import TakenView
from visioncal.live.drivers.protocols import ArmState
from visioncal.planning.cell import PlanCell
from visioncal.planning.plan_file import PlanFile
from visioncal.robot import Robot, load_robot
from visioncal.robot.files import robot_file, robot_names
from visioncal.session import Session, View
from visioncal.session.columns import pose_row
from visioncal.session.saving import refuse_filled
from visioncal.session.table import write_csv
from visioncal.vision.targets import load_target, stored_target, target_document, target_names

# File that names devices and plan; written before the first view.
PROVENANCE = "recorded.toml"
_IMAGES, _DEPTH, _TABLE, _TARGET_FILE = "images", "depth", "views.csv", "target.toml"
_SESSION = "session.toml"
# Columns that belong to a row's picture; all others belong to its pose.
_OF_PICTURE = re.compile("depth|stamp_s|blur_px|motion_px|exposure_ms|picture|device_.*")
# Column of the form in which a pose was typed or sent.
_FORM = "pose_form"
# End of the name of a picture that is to replace its row's.
_AGAIN = "-again.png"
_Cell = TypeVar("_Cell", float, str)
# Reserve for tables, folders and the disk's own use.
_SPARE_BYTES = 256_000


@dataclass(frozen=True, eq=False)
class RecordedCell:
    """The cell of a recording without a plan."""

    mount: Mount
    target: Target
    robot: Robot | None  # The arm's model; None where it is not known.


@dataclass(frozen=True, eq=False)
class CaptureFacts(RecordedCell):
    """Facts of a recording that are the same for all views."""

    name: str
    arm: str  # The name that the arm reports.
    camera: str  # The name that the camera reports.
    resolution: tuple[int, int]  # (width, height) of its pictures [px].
    lens: Camera | None  # Intrinsics that it reports, to be refined; None to have them estimated.
    settings: Mapping[str, str | float]
    plan: str  # Digest of the plan that is driven; empty for none.

    @classmethod
    def of(
        cls, cell: LiveCell, name: str, recorded: RecordedCell | PlanCell, plan: PlanFile | None
    ) -> "CaptureFacts":
        """Facts of a recording by a cell's devices."""
        camera = cell.camera
        return cls(
            recorded.mount,
            recorded.target,
            recorded.robot,
            name or "session",
            cell.arm.name,
            camera.name,
            camera.resolution,
            camera.factory,
            dict(camera.settings),
            "" if plan is None else plan.digest,
        )

    def texts(self) -> dict[str, str | bytes]:
        """Files of the session besides its views, by name; session.toml is the last."""
        texts: dict[str, str | bytes] = {}
        target, robot, lens = self.target, self.robot, self.lens
        document: dict[str, Any] = {"schema": 1, "name": self.name, "mount": self.mount}
        # Boards and arms that come with visioncal are named.
        document["target"] = target.name
        if target.name not in target_names() or load_target(target.name) != target:
            document["target"] = _TARGET_FILE
            content, tables = stored_target(target_document(target), Path(_TARGET_FILE).stem)
            texts |= {**tables, _TARGET_FILE: tomli_w.dumps(content)}
        camera: dict[str, Any] = {"name": self.camera, "resolution": list(self.resolution)}
        if lens is not None:
            camera |= {"model": lens.model, "matrix": lens.matrix.tolist()}
            camera["distortion"] = lens.distortion.tolist()
        if "depth_unit_m" in self.settings:
            camera["depth_unit_m"] = self.settings["depth_unit_m"]
        document["camera"] = camera
        if robot is not None:
            arms = {name: load_robot(name) for name in robot_names()}
            same = (
                name
                for name, arm in arms.items()
                if arm.name == robot.name and dict(arm.document) == dict(robot.document)
            )
            model = next(same, "")
            if not model:
                named = "robot.json" if "kind" in robot.document else ""
                model, text = robot_file(robot.document, named)
                texts[model] = text
            document["robot"] = {"model": model, "tip": robot.tip}
        texts[_SESSION] = tomli_w.dumps(document)
        return texts

    def provenance(self) -> dict[str, Any]:
        """Facts that a resumed recording must share with its beginning."""
        return {
            "arm": self.arm,
            "camera": self.camera,
            "resolution": list(self.resolution),
            "mount": self.mount,
            "target": target_document(self.target),
            "robot": "" if self.robot is None else self.robot.name,
            "plan": self.plan,
        }

    def view_of(
        self, number: int, files: Sequence[str], taken: TakenView, unix_offset_s: float
    ) -> View:
        """Builds the row of a view in views.csv.

        Args:
            number: The view's.
            files: Paths of its image, and of its depth where it has one.
            taken: What was taken.
            unix_offset_s: From monotonic to UNIX time [s].
        """
        image, *depth = files
        state, frame = taken.state, taken.frame
        numbers = {
            "stamp_s": round(frame.stamp_s + unix_offset_s, 6),
            **pose_row(state.base_from_flange),
        }
        joints = range(1, 100)
        for form, names, values in (
            ("q{}_rad", joints, state.q),
            ("current{}_a", joints, state.currents_a),
            ("temp{}_c", joints, state.temperatures_c),
            ("payload{}_kg", [""], None if state.payload_kg is None else [state.payload_kg]),
            ("payload_{}_m", "xyz", state.payload_m),
        ):
            if values is not None:
                numbers |= {
                    form.format(name): float(value)
                    for name, value in zip(names, values, strict=False)
                }
        # Columns that calibration passes through: what the devices report.
        texts = {
            "safety": state.safety,
            "blur_px": f"{taken.corners.blur_px:.2f}",
            "motion_px": f"{taken.motion_px:.3f}",
        }
        named = {
            "depth": "".join(depth),
            "picture": frame.name,
            "typed": state.typed,
            _FORM: state.pose_form,
        }
        texts |= {name: text for name, text in named.items() if text}
        if state.flange_from_tool is not None:
            tcp = pose_row(state.flange_from_tool).values()
            texts["tcp"] = " ".join(f"{value:.9g}" for value in tcp)
        if frame.exposure_s is not None:
            texts["exposure_ms"] = f"{1e3 * frame.exposure_s:.3f}"
        texts |= {f"device_{name}": str(value) for name, value in self.settings.items()}
        return View(number, image=image, numbers=numbers, text=texts)


def posed(view: View, pose: View | ArmState) -> View:
    """A row with its own picture, and the pose of another row, or one that was typed."""
    numbers, text = (
        (pose.numbers, pose.text)
        if isinstance(pose, View)
        else (
            pose_row(pose.base_from_flange),
            {"safety": pose.safety, "typed": pose.typed, _FORM: pose.pose_form},
        )
    )

    def paired(picture_row: Mapping[str, _Cell], arm_row: Mapping[str, _Cell]) -> dict[str, _Cell]:
        kept = {name: cell for name, cell in picture_row.items() if _OF_PICTURE.fullmatch(name)}
        return kept | {k: cell for k, cell in arm_row.items() if not _OF_PICTURE.fullmatch(k)}

    return replace(view, numbers=paired(view.numbers, numbers), text=paired(view.text, text))


def _form_of(views: Sequence[View]) -> str:
    """The maker's form in which all poses were typed or sent; empty where there is none."""
    forms = {view.text.get(_FORM, "") for view in views}
    form = POSE_FORMS.get(forms.pop()) if len(forms) == 1 else None
    # Those of libraries are no controller's.
    return form.name if form and form.models else ""


def picture_name(view: View) -> str:
    """Name that the picture of a row had in its folder; empty for none."""
    return view.text.get("picture", "")


def state_of(view: View) -> ArmState | None:
    """Joints and pose of a row; None where it has no pose."""
    pose = view.base_from_flange()
    if pose is None:
        return None
    return ArmState(view.stamp_s or 0.0, np.asarray(pose.as_matrix()), view.joints_rad)


class Journal:
    """Session folder that grows view by view.

    The table of views is replaced atomically for each view, after its image is on the disk: at any
    moment the folder holds a session of all acknowledged views, or, before the first, none. If the
    process is killed, at most the view that is being written is lost. A row's picture is replaced
    by way of another file, so that no picture is ever beside a pose that is not its own.
    """

    def __init__(self, folder: Path, facts: CaptureFacts, unix_offset_s: float) -> None:
        """Uses a folder that `begin` or `resume` has prepared."""
        self.folder = folder
        self.views: tuple[View, ...] = ()
        self._columns: tuple[str, ...] = ()
        self._facts, self._offset_s = facts, unix_offset_s
        self._document: dict[str, Any] = {}
        # The maker's form in which all poses were typed or sent; empty where there is none.
        self.form = ""

    @classmethod
    def begin(
        cls, folder: Path, facts: CaptureFacts, unix_offset_s: float, views: int
    ) -> "Journal":
        """Begins a session in a new or empty folder.

        Args:
            folder: The folder.
            facts: Facts of the recording.
            unix_offset_s: Offset from the host's monotonic clock to UNIX time [s].
            views: Number of views to come; 0 where it is not known.

        Raises:
            DataError: The folder holds something, cannot be written, or has no room for the views.
        """
        journal = cls(folder, facts, unix_offset_s)
        resumes = (folder / PROVENANCE).is_file()
        with named_errors(folder):
            refuse_filled(folder, "; or go on with its recording by --resume" if resumes else "")
            folder.mkdir(parents=True, exist_ok=True)
        width, height = facts.resolution
        journal._check_room(views * width * height, f"{views} views")
        with named_errors(folder):
            (folder / _IMAGES).mkdir(exist_ok=True)
        journal._write_facts()
        return journal

    @classmethod
    def resume(
        cls, folder: Path, facts: CaptureFacts, unix_offset_s: float, views: int
    ) -> "Journal":
        """Resumes a session, or begins it where nothing was recorded; arguments are as for `begin`.

        Partly written files of a killed process are removed.

        Raises:
            DataError: The folder holds views of another recording, or something else.
        """
        path = folder / PROVENANCE
        for place in (folder, folder / _IMAGES, folder / _DEPTH):
            remove_abandoned(place)
        if not path.is_file():
            with named_errors(folder), suppress(FileNotFoundError):
                (folder / _IMAGES).rmdir()
            return cls.begin(folder, facts, unix_offset_s, views)
        before, now = read_toml(path, str(path)), facts.provenance()
        differ = [name for name, value in now.items() if before.get(name) != value]
        is_begun = (folder / _TABLE).is_file()
        if differ and is_begun:
            words = "; ".join(
                f"{name} was {_short(before.get(name))} and is {_short(now[name])}"
                for name in differ
            )
            raise DataError(
                f"{folder} was recorded of something else: {words}.",
                culprits=[f"{path}: {name}" for name in differ],
                next_step="Go on with the same, or record into a new folder.",
            )
        journal = cls(folder, facts, unix_offset_s)
        journal._document = before
        with named_errors(folder):
            (folder / _IMAGES).mkdir(exist_ok=True)
        if differ:
            journal._write_facts()
        if is_begun:
            session = Session.load(folder)
            journal.views, journal._columns = session.views, session.columns
            journal.form = _form_of(session.views)
        journal._settle()
        return journal

    def remove_unbegun(self) -> None:
        """Removes the folder of a recording without a view, with nothing else in it."""
        if {path.name for path in self.folder.rglob("*")} == {PROVENANCE, _IMAGES}:
            shutil.rmtree(self.folder, ignore_errors=True)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of a folder's pictures that are no view's and not to be given."""
        names, used = self._document.get("left_out", []), set(map(picture_name, self.views))
        return tuple(str(name) for name in names if name not in used)

    def leave_out(self, names: Iterable[str]) -> None:
        """Remembers which pictures are left out, instead of those before; raises DataError."""
        if (names := sorted(names)) != self._document.get("left_out", []):
            self._document["left_out"] = names
            self._write(PROVENANCE, tomli_w.dumps(self._document))

    def store(self, taken: Mapping[int, TakenView]) -> None:
        """Writes views by their numbers, all of them or none, in place of those that have them.

        When this returns, they are flushed to the disk.

        Raises:
            DataError: They cannot be written; the session is unchanged.
        """
        rows = {view.number: view for view in self.views}
        for number, view in taken.items():
            image = f"{_IMAGES}/{number:03d}{_AGAIN if number in rows else '.png'}"
            pictures: dict[str, Image | Image16] = {image: view.frame.image}
            if view.frame.depth is not None:
                with named_errors(self.folder):
                    (self.folder / _DEPTH).mkdir(exist_ok=True)
                pictures[image.replace(_IMAGES, _DEPTH, 1)] = view.frame.depth
            for name, pixels in pictures.items():
                # Low compression: noise hardly compresses, and speed matters more.
                _, png = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
                self._check_room(len(png), f"view {number}")
                self._write(name, png.tobytes())
            rows[number] = self._facts.view_of(number, [*pictures], view, self._offset_s)
        self.rewrite([*rows.values()])

    def rewrite(self, views: Sequence[View]) -> None:
        """Replaces the table by rows of it, of which some may be left out or have other poses.

        When this returns, they are flushed to the disk; a process that is killed meanwhile leaves
        the table before or this one. Raises DataError.
        """
        known = self._columns if views and self._columns else ("view", "image")
        filled = (name for view in views for name in (*view.numbers, *view.text))
        columns = tuple(dict.fromkeys([*known, *filled]))
        form = _form_of(views)
        if views and not self.views:
            self.form = ""
            for name, text in self._facts.texts().items():
                self._write(name, text)
        if views and form != self.form:
            # Whoever edits the file meanwhile keeps all else.
            document = read_toml(self.folder / _SESSION, _SESSION)
            robot = {k: v for k, v in document.pop("robot", {}).items() if k != "form"}
            robot |= {"form": form} if form else {}
            self._write(_SESSION, tomli_w.dumps(document | ({"robot": robot} if robot else {})))
            self.form = form
        if views:
            self._write(_TABLE, write_csv(columns, views))
        before, after = ({path for view in of for path in view.files} for of in (self.views, views))
        # A table without rows is none, and one whose images are gone is no session.
        for name in (*(() if views else (_TABLE,)), *(before - after)):
            with named_errors(self.folder / name):
                (self.folder / name).unlink(missing_ok=True)
        self.views, self._columns = tuple(views), columns if views else ()
        self._settle()

    def _settle(self) -> None:
        """Gives pictures that replaced others their rows' own names; raises DataError."""
        if any(view.image.endswith(_AGAIN) for view in self.views):
            views = [*self.views]
            for row, view in enumerate(views):
                if view.image.endswith(_AGAIN):
                    final_names = {path: f"{path.removesuffix(_AGAIN)}.png" for path in view.files}
                    for before, name in final_names.items():
                        self._write(name, read_bytes(self.folder / before))
                    depth = {"depth": final_names[view.depth]} if view.depth else {}
                    views[row] = replace(
                        view, image=final_names[view.image], text={**view.text, **depth}
                    )
            self._write(_TABLE, write_csv(self._columns, views))
            self.views = tuple(views)
        for path in self.folder.glob(f"*/*{_AGAIN}"):
            with named_errors(path):
                path.unlink(missing_ok=True)

    def check_room(self) -> None:
        """Checks that the disk has room for one more view; raises DataError."""
        width, height = self._facts.resolution
        self._check_room(width * height, "the next view")

    def image(self, view: View) -> bytes:
        """Reads the image of a view that is on the disk."""
        return read_bytes(self.folder / view.image)

    def _write(self, name: str, data: bytes | str) -> None:
        path = self.folder / name
        try:
            write_atomically(path, data)
            with named_errors(path):
                flush_folder(path.parent)
        except DataError as error:
            cause = error.__cause__
            if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT):
                raise self._full(len(data), path.name) from error
            raise

    def _write_facts(self) -> None:
        """Begins the provenance of a recording without a view."""
        facts, settings = self._facts.provenance(), self._facts.settings
        self._document = {"visioncal": __version__, **facts, "settings": settings}
        self._write(PROVENANCE, tomli_w.dumps(self._document))

    def _check_room(self, needed: int, what: str) -> None:
        with named_errors(self.folder):
            free = shutil.disk_usage(self.folder).free
        if free < needed + _SPARE_BYTES:
            raise self._full(needed, what)

    def _full(self, needed: int, what: str) -> DataError:
        free = shutil.disk_usage(self.folder).free
        return DataError(
            f"{self.folder}: too little room: {free / 1e6:.1f} MB are free, and "
            f"{(needed + _SPARE_BYTES) / 1e6:.1f} MB must be free for {what}.",
            culprits=[str(self.folder)],
            next_step="Make room on that disk.",
        )


def _short(value: object) -> str:
    """A value in a message; digests of 64 letters are shortened."""
    if isinstance(value, str) and len(value) == 64:
        return f"{value[:8]}..."
    return json.dumps(value) if value not in ("", None) else "none"
