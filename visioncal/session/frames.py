"""What hangs on what: the tree of a cell's frames, as `[frames]` says it or as it follows.

The cell is the root. Bases, fixed cameras, instruments and boards on the floor or on fixtures hang
on it; each flange hangs on its base by the robot; cameras, boards and points may hang on a flange.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.session.document import Declaration, Kind
from visioncal.session.kinds import has_robot_state, is_read, is_seen, name_of
from visioncal.session.table import View
from visioncal.session.tables import RobotTable

CELL = "cell"
_WHERE = "session.toml: frames"
_FRAME: Mapping[str, str] = {"camera": "cam"}
# Names a place on which boards and cameras are fixed; it hangs in the cell unless that is said.
_FIXTURE = "fixture"


def frame_name(kind: str, name: str) -> str:
    """Names the frame of a camera, target, instrument, point, base or flange: `cam_left`.

    Of the only one of its kind, that has no name, it is the kind alone: `cam`.
    """
    frame = _FRAME.get(kind, kind)
    return f"{frame}_{name}" if name else frame


def robots_of(
    declaration: Declaration, views: Sequence[View], *, in_streams: bool = False
) -> dict[str, RobotTable]:
    """The robots by name; one without a name where poses are given and none is declared.

    Args:
        declaration: What the session declares.
        views: Its rows.
        in_streams: Whether a stream has poses or joints.
    """
    found = declaration.named("robot")
    if not found and (in_streams or any(has_robot_state(view) for view in views)):
        return {"": RobotTable()}
    return {name: table for name, table in found.items() if isinstance(table, RobotTable)}


def resolve_frames(
    declaration: Declaration, views: Sequence[View], robots: Iterable[str]
) -> dict[str, str]:
    """Works out what each frame hangs on.

    What hangs on a fixture, or on another thing that does not move before it, is given as hanging
    on the same flange, base or cell.

    Returns:
        The parent of every frame but `cell`, by the frame's name.

    Raises:
        DataError: What is said contradicts itself, or something is neither said nor follows.
    """
    return _DeclaredTree(declaration, tuple(views), tuple(robots)).resolved()


def check_frames(declaration: Declaration, views: Sequence[View]) -> None:
    """Checks what `[frames]` says: names, circles, and `mount`.

    Raises:
        DataError: A frame is unknown, hangs on two others or on itself, or elsewhere than `mount`
            has it.
    """
    if declaration.frames:
        _ = _DeclaredTree(declaration, tuple(views), tuple(robots_of(declaration, views))).said


def frames_of_kind(frames: Iterable[str], kind: str) -> tuple[str, ...]:
    """The frames of a kind among some: `cam` and `cam_left` of cameras."""
    bare = frame_name(kind, "")
    return tuple(frame for frame in frames if frame == bare or frame.startswith(f"{bare}_"))


def thing_name(frame: str, kind: str) -> str:
    """What a frame's thing is called: `left` of `cam_left`; its kind, where it has no name."""
    return frame.partition("_")[2] or kind


def frame_called(frames: Iterable[str], kind: str, name: str) -> str:
    """The frame of what `thing_name` calls so, which need not be among the frames."""
    known = (word for word in frames_of_kind(frames, kind) if thing_name(word, kind) == name)
    return next(known, frame_name(kind, "" if name == kind else name))


def robots_between(frames: Mapping[str, str], first: str, second: str) -> tuple[str, ...]:
    """Names the robots by whose motion two frames move before each other."""
    chains = [set(_upwards(frames, frame)) for frame in (first, second)]
    apart = chains[0] ^ chains[1]
    flanges = sorted(name for name in apart if _is_flange(name))
    return tuple(flange.removeprefix("flange").removeprefix("_") for flange in flanges)


def _upwards(frames: Mapping[str, str], frame: str) -> Iterator[str]:
    while frame != CELL:
        yield frame
        frame = frames[frame]


def _is_flange(frame: str) -> bool:
    return frame == "flange" or frame.startswith("flange_")


@dataclass(frozen=True, eq=False)
class _DeclaredTree:
    """What a session says of its frames, and what follows from it."""

    declaration: Declaration
    views: tuple[View, ...]
    robots: tuple[str, ...]

    @cached_property
    def frames(self) -> dict[str, tuple[str, str]]:
        """All frames but the cell, with their kinds and names."""
        listed = [("base", robot) for robot in self.robots] + [
            ("flange", robot) for robot in self.robots
        ]
        for kind in ("camera", "target", "instrument"):
            listed += [(kind, name) for name in self._names(kind)]
        points = dict.fromkeys(view.point for view in self.views if is_read(view))
        listed += [("point", name) for name in points]
        return {frame_name(kind, name): (kind, name) for kind, name in listed}

    def _names(self, kind: Kind) -> tuple[str, ...]:
        """Names of a kind; one without a name where rows are of it and none is declared."""
        test = is_read if kind == "instrument" else is_seen
        declared = tuple(self.declaration.named(kind))
        return declared or (("",) if any(test(view) for view in self.views) else ())

    @cached_property
    def fixtures(self) -> tuple[str, ...]:
        """Places that `[frames]` names itself."""
        words = [*self.declaration.frames, *map(str, self.declaration.frames.values())]
        return tuple(
            dict.fromkeys(
                word for word in words if word == _FIXTURE or word.startswith(f"{_FIXTURE}_")
            )
        )

    @cached_property
    def said(self) -> dict[str, str]:
        """What `[frames]` says, checked, with what needs no saying: flanges, bases and fixtures."""
        known = [CELL, *self.frames, *self.fixtures]
        said: dict[str, str] = {}
        for child, parent in self.declaration.frames.items():
            if isinstance(parent, list | tuple) and len(parent) > 1:
                on = " and ".join(map(str, parent))
                raise _contradiction(
                    f"{child} hangs on {on}, but a frame hangs on one other", child
                )
            for frame in (child, parent):
                if frame not in known:
                    raise _unknown(frame, child, known)
            said[child] = parent
        for robot in self.robots:
            base, flange = frame_name("base", robot), frame_name("flange", robot)
            if said.setdefault(flange, base) != base:
                words = f"{flange} hangs on {said[flange]}, but it hangs on {base} by its robot"
                raise _contradiction(words, flange)
            said.setdefault(base, CELL)
        for frame in self.fixtures:
            said.setdefault(frame, CELL)
        if CELL in said:
            raise _contradiction(
                f"{CELL} hangs on {said[CELL]}, but all else stands in it: it hangs on nothing",
                CELL,
            )
        _check_circles(said)
        self._check_mount(said)
        return said

    def _check_mount(self, said: Mapping[str, str]) -> None:
        mount = self.declaration.mount
        for child in self.declaration.frames if mount is not None else ():
            on = _carrier(said, child, self)
            if self.frames.get(child, ("", ""))[0] != "camera" or on is None:
                continue
            if _is_flange(on) != (mount == "eye-in-hand"):
                where = "on a flange" if mount == "eye-in-hand" else "beside the robots"
                raise _contradiction(
                    f'{child} hangs on {on}, but mount = "{mount}" has the cameras {where}',
                    child,
                    "Leave mount out where [frames] says what cameras hang on, or correct one of "
                    "the two.",
                )

    def resolved(self) -> dict[str, str]:
        """The parent of each frame; see `resolve_frames`."""
        parents = dict(self.said)
        unsaid = [frame for frame in self.frames if frame not in parents]
        # Where a thing is may follow from where that is which it sees, or is seen by.
        for _ in range(2):
            for frame in [name for name in unsaid if name not in parents]:
                parent = self._follows(frame, parents)
                if parent is not None:
                    parents[frame] = parent
        missing = [name for name in unsaid if name not in parents]
        if missing:
            raise self._unclear(missing)
        return {frame: _carrier(parents, frame, self) or CELL for frame in self.frames}

    def _follows(self, frame: str, parents: Mapping[str, str]) -> str | None:
        """What a frame hangs on though it is not said; None where that is not clear."""
        kind, _ = self.frames[frame]
        if kind == "instrument":
            return CELL
        if kind == "point":
            return self._of_point(frame)
        moves = {"eye-in-hand": "camera", "eye-to-hand": "target"}.get(self.declaration.mount or "")
        if moves is not None:
            return self._flange_of(frame) if kind == moves else CELL
        if len(self.robots) == 1:
            flange, others = frame_name("flange", self.robots[0]), self._across(frame)
            carriers = {_carrier(parents, other, self) for other in others if other in parents}
            # A board on the flange of the camera that looks at it would never move before it.
            return CELL if flange in carriers else None
        return None

    def _of_point(self, frame: str) -> str | None:
        """A point moves with the robot that its rows name; where they have no pose, it is fixed."""
        _, name = self.frames[frame]
        rows = [view for view in self.views if is_read(view) and view.point == name]
        moved = [row for row in rows if has_robot_state(row)]
        if not moved and len(self.robots) < 2:
            return CELL if self.declaration.is_network else self._flange_of(frame)
        if not moved:
            return CELL
        return self._flange_of(frame) if len(moved) == len(rows) else None

    def _flange_of(self, frame: str) -> str | None:
        """The flange of the only robot, or of the only one that rows about a thing name."""
        if len(self.robots) == 1:
            return frame_name("flange", self.robots[0])
        named = {
            name_of(self.declaration, "robot", view)
            for view in self.views
            if has_robot_state(view) and frame in observed(self.declaration, view)
        }
        return frame_name("flange", named.pop()) if len(named) == 1 else None

    def _across(self, frame: str) -> set[str]:
        """What a camera sees, or which cameras see a target."""
        pairs = [
            observed(self.declaration, view)
            for view in self.views
            if is_seen(view) and not view.is_of_lens
        ]
        return {other for pair in pairs if frame in pair for other in pair if other != frame}

    def _unclear(self, missing: Sequence[str]) -> DataError:
        mount = self.declaration.mount
        if mount is not None and not self.robots:
            return DataError(
                f'views.csv: no row says where the robot is, which mount = "{mount}" needs.',
                culprits=["views.csv: x_m", "views.csv: q1_rad"],
                next_step="Give each row the flange's pose, as x_m, y_m, z_m, qx, qy, qz, qw, or "
                "the joints' angles, as q1_rad, q2_rad and so on with [robot] in session.toml; or "
                "its time, as stamp_s, and the poses by their times in streams/robot.csv.",
            )
        places = [*(frame_name("flange", robot) for robot in self.robots), CELL]
        example = "\n".join(f'{name} = "{places[0]}"' for name in missing)
        among = ", ".join(f'"{place}"' for place in places)
        return DataError(
            f"session.toml: it is not said what {some_of(missing)} "
            f"{'hangs' if len(missing) == 1 else 'hang'} on, and it does not follow from the rest.",
            culprits=[f"{_WHERE}.{name}" for name in missing],
            next_step=f"Say it, each by one of {among}:\n[frames]\n{example}",
        )


def observed(declaration: Declaration, view: View) -> tuple[str, str]:
    """The frames of what sees and of what is seen in a row; empty for a row without either."""
    if is_seen(view):
        camera = name_of(declaration, "camera", view)
        return frame_name("camera", camera), frame_name(
            "target", name_of(declaration, "target", view)
        )
    if is_read(view):
        instrument = name_of(declaration, "instrument", view)
        return frame_name("instrument", instrument), frame_name("point", view.point)
    return "", ""


def _carrier(parents: Mapping[str, str], frame: str, tree: _DeclaredTree) -> str | None:
    """The cell, base or flange before which a frame never moves; None where it is not known."""
    on = parents.get(frame)
    while (
        on is not None
        and on != CELL
        and tree.frames.get(on, ("", ""))[0]
        not in (
            "base",
            "flange",
        )
    ):
        on = parents.get(on)
    return on


def _check_circles(parents: Mapping[str, str]) -> None:
    for start in parents:
        chain = [start]
        while (on := parents.get(chain[-1])) is not None:
            if on in chain:
                circle = [*chain[chain.index(on) :], on]
                raise _contradiction(f"it goes round in a circle: {' on '.join(circle)}", on)
            chain.append(on)


def _contradiction(words: str, frame: str, next_step: str = "") -> DataError:
    return DataError(
        f"session.toml, [frames]: {words}.",
        culprits=[f"{_WHERE}.{frame}"],
        next_step=next_step or "Correct [frames].",
    )


def _unknown(frame: object, child: str, known: Sequence[str]) -> DataError:
    what = f"{frame!r}" if frame == child else f"{child} hangs on {frame!r}, which"
    return DataError(
        f"session.toml, [frames]: {what} is no frame of this session; those are "
        f"{', '.join(known)}.",
        culprits=[f"{_WHERE}.{child}"],
        next_step=did_you_mean(str(frame), known)
        or "A fixture is named fixture_NAME; cameras, robots, targets and instruments as their "
        "tables.",
    )
