"""Tree of a cell's frames: each frame's parent, as declared in `[frames]` or inferred.

The cell is the root. Bases, fixed cameras, instruments and boards on the floor or on fixtures are
its children; each flange is a child of its base, through the robot; cameras, boards and points may
be children of a flange.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import Mount
from visioncal.session.document import Declaration, Kind, RobotTable
from visioncal.session.kinds import (
    has_robot_state,
    is_camera_observation,
    is_instrument_reading,
    name_of,
)
from visioncal.session.table import View

CELL = "cell"
_WHERE = "session.toml: frames"
_FRAME: Mapping[str, str] = {"camera": "cam"}
# Kind of a place that boards and cameras are fixed to; by default fixed in the cell.
_FIXTURE = "fixture"


def frame_name(kind: str, name: str) -> str:
    """Name of the frame of a camera, target, instrument, point, base or flange: `cam_left`.

    An object without a name has its kind's: `cam`.
    """
    frame = _FRAME.get(kind, kind)
    return f"{frame}_{name}" if name else frame


def robots_of(
    declaration: Declaration, views: Sequence[View], *, in_streams: bool = False
) -> dict[str, RobotTable]:
    """Robots by name; one without a name where rows or streams have poses and none is declared."""
    declared = declaration.named("robot")
    if not declared and (in_streams or any(has_robot_state(view) for view in views)):
        return {"": RobotTable()}
    return {name: table for name, table in declared.items() if isinstance(table, RobotTable)}


def resolve_frames(
    declaration: Declaration, views: Sequence[View], robots: Iterable[str]
) -> dict[str, str]:
    """Determines the parent of each frame; raises DataError.

    Fixtures and other frames without own motion are skipped: parents are flanges, bases or the
    cell.

    Returns:
        The parent of every frame but `cell`, by the frame's name.
    """
    return _DeclaredTree(declaration, tuple(views), tuple(robots)).resolved()


def check_frames(declaration: Declaration, views: Sequence[View]) -> None:
    """Checks `[frames]`: names, cycles, and `mount`; raises DataError."""
    if declaration.frames:
        _ = _DeclaredTree(declaration, tuple(views), tuple(robots_of(declaration, views))).declared


def frames_of_kind(frames: Iterable[str], kind: str) -> tuple[str, ...]:
    """The frames of a kind among others: `cam` and `cam_left` of cameras."""
    bare = frame_name(kind, "")
    return tuple(frame for frame in frames if frame == bare or frame.startswith(f"{bare}_"))


def object_name(frame: str, kind: str) -> str:
    """Name of a frame's object: `left` for `cam_left`; its kind where it has no name."""
    return frame.partition("_")[2] or kind


def frame_of_object(frames: Iterable[str], kind: str, name: str) -> str:
    """Frame of a named object, the inverse of `object_name`; it may not be among the frames."""
    known = (word for word in frames_of_kind(frames, kind) if object_name(word, kind) == name)
    return next(known, frame_name(kind, "" if name == kind else name))


def robots_between(frames: Mapping[str, str], first: str, second: str) -> tuple[str, ...]:
    """Names of the robots between two frames, whose motion moves them relative to each other."""
    not_shared: set[str] = set()
    for frame in (first, second):
        while frame != CELL:
            not_shared ^= {frame}
            frame = frames[frame]  # noqa: PLW2901 - up to the cell
    flanges = sorted(frames_of_kind(not_shared, "flange"))
    return tuple(flange.removeprefix("flange").removeprefix("_") for flange in flanges)


@dataclass(frozen=True, eq=False)
class _DeclaredTree:
    """Declared frames of a session, and the inference of the others."""

    declaration: Declaration
    views: tuple[View, ...]
    robots: tuple[str, ...]

    @cached_property
    def frames(self) -> dict[str, tuple[str, str]]:
        """All frames but the cell, with their kinds and names."""
        listed = [(kind, robot) for kind in ("base", "flange") for robot in self.robots]
        kinds: tuple[Kind, ...] = ("camera", "target", "instrument")
        for kind in kinds:
            test = is_instrument_reading if kind == "instrument" else is_camera_observation
            # One without a name, where rows are of the kind and none is declared.
            unnamed = [""] if any(map(test, self.views)) else []
            listed += [(kind, name) for name in [*self.declaration.named(kind)] or unnamed]
        points = dict.fromkeys(view.point for view in self.views if is_instrument_reading(view))
        listed += [("point", name) for name in points]
        return {frame_name(kind, name): (kind, name) for kind, name in listed}

    @cached_property
    def fixtures(self) -> tuple[str, ...]:
        """Fixtures that `[frames]` introduces."""
        words = [*self.declaration.frames, *map(str, self.declaration.frames.values())]
        return frames_of_kind(dict.fromkeys(words), _FIXTURE)

    @cached_property
    def declared(self) -> dict[str, str]:
        """Checked parents by `[frames]`, with those of flanges, bases and fixtures."""
        known = [CELL, *self.frames, *self.fixtures]
        declared: dict[str, str] = {}
        for child, parent in self.declaration.frames.items():
            for frame in (child, parent):
                if frame not in known:
                    what = f"{frame!r}" if frame == child else f"{child} hangs on {frame!r}, which"
                    raise _contradiction(
                        f"{what} must be a frame of this session: {', '.join(known)}",
                        child,
                        did_you_mean(str(frame), known)
                        or "A fixture is named fixture_NAME; cameras, robots, targets and "
                        "instruments as their tables.",
                    )
            declared[child] = parent
        for robot in self.robots:
            base, flange = frame_name("base", robot), frame_name("flange", robot)
            if declared.setdefault(flange, base) != base:
                words = f"{flange} hangs on {declared[flange]}, but it hangs on {base} by its robot"
                raise _contradiction(words, flange)
            declared.setdefault(base, CELL)
        for frame in self.fixtures:
            declared.setdefault(frame, CELL)
        if CELL in declared:
            raise _contradiction(
                f"{CELL} hangs on {declared[CELL]}, but all else stands in it: it hangs on nothing",
                CELL,
            )
        self._check(declared)
        return declared

    def _check(self, declared: Mapping[str, str]) -> None:
        """Refuses frames that are their own ancestors, or contradict `mount`."""
        for start in declared:
            chain = [start]
            while (above := declared.get(chain[-1])) is not None:
                if above in chain:
                    cycle = [*chain[chain.index(above) :], above]
                    raise _contradiction(f"it goes round in a circle: {' on '.join(cycle)}", above)
                chain.append(above)
        mount = self.declaration.mount
        for child in self.declaration.frames if mount is not None else ():
            parent = _carrier(declared, child, self)
            if self.frames.get(child, ("", ""))[0] != "camera" or parent is None:
                continue
            if bool(frames_of_kind([parent], "flange")) != (mount == "eye-in-hand"):
                where = "on a flange" if mount == "eye-in-hand" else "beside the robots"
                raise _contradiction(
                    f'{child} hangs on {parent}, but mount = "{mount}" has the cameras {where}',
                    child,
                    "Leave mount out where [frames] says what cameras hang on, or correct one of "
                    "the two.",
                )

    def resolved(self) -> dict[str, str]:
        """Parent of each frame; see `resolve_frames`."""
        parents = dict(self.declared)
        undeclared = [frame for frame in self.frames if frame not in parents]
        # Two passes, since a frame may be inferred from those that it observes or is observed by.
        for _ in range(2):
            for frame in [name for name in undeclared if name not in parents]:
                parent = self._inferred_parent(frame, parents)
                if parent is not None:
                    parents[frame] = parent
        missing = [name for name in undeclared if name not in parents]
        if not missing:
            return {frame: _carrier(parents, frame, self) or CELL for frame in self.frames}
        mount = self.declaration.mount
        if mount is not None and not self.robots:
            raise DataError(
                f'views.csv: no row says where the robot is, which mount = "{mount}" needs.',
                culprits=["views.csv: x_m", "views.csv: q1_rad"],
                next_step="Give each row the flange's pose, as x_m, y_m, z_m, qx, qy, qz, qw, or "
                "the joints' angles, as q1_rad, q2_rad and so on with [robot] in session.toml; or "
                "its time, as stamp_s, and the poses by their times in streams/robot.csv.",
            )
        places = [*(frame_name("flange", robot) for robot in self.robots), CELL]
        example = "\n".join(f'{name} = "{places[0]}"' for name in missing)
        among = ", ".join(f'"{place}"' for place in places)
        raise DataError(
            f"session.toml: the frame that carries {some_of(missing)} is not stated, and does not "
            "follow from the rest.",
            culprits=[f"{_WHERE}.{name}" for name in missing],
            next_step=f"State it, each by one of {among}:\n[frames]\n{example}",
        )

    def _inferred_parent(self, frame: str, parents: Mapping[str, str]) -> str | None:
        """Inferred parent of a frame; None where ambiguous."""
        kind, name = self.frames[frame]
        if kind == "instrument":
            return CELL
        if kind == "point":
            # The flange of the robot in its rows; fixed where rows have no pose.
            read = [row for row in self.views if is_instrument_reading(row) and row.point == name]
            moved = [row for row in read if has_robot_state(row)]
            if moved:
                return self._flange_of(frame) if len(moved) == len(read) else None
            is_single = len(self.robots) < 2 and not self.declaration.is_network
            return self._flange_of(frame) if is_single else CELL
        moves = {"eye-in-hand": "camera", "eye-to-hand": "target"}.get(self.declaration.mount or "")
        if moves is not None:
            return self._flange_of(frame) if kind == moves else CELL
        if len(self.robots) == 1:
            seen = [view for view in self.views if is_camera_observation(view)]
            pairs = [observed(self.declaration, view) for view in seen if not view.is_of_lens]
            others = {other for pair in pairs if frame in pair for other in pair} - {frame}
            carriers = {_carrier(parents, other, self) for other in others if other in parents}
            # Camera and board are not on the same flange: they would not move relatively.
            return CELL if frame_name("flange", self.robots[0]) in carriers else None
        return None

    def _flange_of(self, frame: str) -> str | None:
        """Flange of the only robot, or of the only one in the rows of a frame."""
        if len(self.robots) == 1:
            return frame_name("flange", self.robots[0])
        named = {
            name_of(self.declaration, "robot", view)
            for view in self.views
            if has_robot_state(view) and frame in observed(self.declaration, view)
        }
        return frame_name("flange", named.pop()) if len(named) == 1 else None


def observed(declaration: Declaration, view: View) -> tuple[str, str]:
    """Frames of observer and observed object in a row; empty for a row without observation."""
    if is_camera_observation(view):
        camera = name_of(declaration, "camera", view)
        return frame_name("camera", camera), frame_name(
            "target", name_of(declaration, "target", view)
        )
    if is_instrument_reading(view):
        instrument = name_of(declaration, "instrument", view)
        return frame_name("instrument", instrument), frame_name("point", view.point)
    return "", ""


def _carrier(parents: Mapping[str, str], frame: str, tree: _DeclaredTree) -> str | None:
    """The cell, base or flange that a frame is fixed to; None where unknown."""
    parent = parents.get(frame)
    while (
        parent is not None
        and parent != CELL
        and tree.frames.get(parent, ("", ""))[0] not in ("base", "flange")
    ):
        parent = parents.get(parent)
    return parent


def _contradiction(words: str, frame: str, next_step: str = "") -> DataError:
    return DataError(
        f"session.toml, [frames]: {words}.",
        culprits=[f"{_WHERE}.{frame}"],
        next_step=next_step or "Correct [frames].",
    )


def edge_names(mount: Mount) -> tuple[str, str]:
    """Names of the edges of the camera and of a single target."""
    if mount == "instrument":
        return "base_from_instrument", "flange_from_probe"
    if mount == "eye-in-hand":
        return "flange_from_cam", "base_from_target"
    return "base_from_cam", "flange_from_target"
