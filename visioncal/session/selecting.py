"""Choice of one camera, robot and target of a whole cell, with the robot between the other two."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, TypeVar, get_args

from visioncal.core.choice import Choice
from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, ranges, some_of
from visioncal.core.types import Mount
from visioncal.session.columns import SELECTORS, is_number
from visioncal.session.content import SessionContent
from visioncal.session.document import KINDS
from visioncal.session.frames import frame_name, frames_of_kind, object_name, robots_between
from visioncal.session.kinds import COLUMN as TARGET
from visioncal.session.kinds import has_robot_state, is_camera_observation, name_of
from visioncal.session.streams import Stream
from visioncal.session.table import View

S = TypeVar("S", bound=SessionContent)
Part: TypeAlias = Literal["camera", "robot", "target"]
PARTS: tuple[Part, ...] = get_args(Part)
# Parts that must be unambiguous for a camera with any target, and without a camera.
EYE: tuple[Part, ...] = ("camera", "robot")
ARM: tuple[Part, ...] = ("robot",)
LENS: tuple[Part, ...] = ("camera",)


# The choice without names.
ANY = Choice()


@dataclass(frozen=True)
class Chosen:
    """One camera, robot and target of a cell."""

    mount: Mount  # Whether this robot carries the camera.
    camera: str  # The camera's frame; empty where none is needed.
    robot: str  # The robot's name in the session.
    target: str  # The target's frame; empty where none is needed.

    @property
    def base(self) -> str:
        """The frame of the robot's base."""
        return frame_name("base", self.robot)

    @property
    def flange(self) -> str:
        """The frame of the robot's flange."""
        return frame_name("flange", self.robot)

    def frame_of(self, part: Part) -> str:
        """Frame that identifies a part: the robot's is its flange."""
        return {"camera": self.camera, "robot": self.flange, "target": self.target}[part]


def choose(
    frames: Mapping[str, str],
    choice: Choice,
    needs: Collection[Part] = PARTS,
    *,
    label: str,
    robot_between: bool = True,
    seen: Collection[tuple[str, str]] = (),
) -> Chosen:
    """Finds the chosen camera, robot and target.

    Args:
        frames: Parent of each frame of the cell.
        choice: The given names.
        needs: Parts that must be unambiguous; for the others, any that fits is taken, or none.
        label: Name of the cell in messages.
        robot_between: Whether the robot must be between camera and target.
        seen: Observed pairs of camera and target frames; where targets are needed, other pairs are
            options only where none of these fits.

    Raises:
        DataError: There is none of that name, the choice is ambiguous, or this robot is not between
            camera and target.
    """
    by_part = {part: frames_of_kind(frames, _KINDS[part]) for part in PARTS}
    named = {}
    for part in PARTS:
        if name := getattr(choice, part):
            names = {object_name(frame, part): frame for frame in by_part[part]}
            named[part] = name if name in by_part[part] else names.get(name, "")
            if not named[part]:
                raise DataError(
                    f"{label} has no {part} {name!r}: its {part}s are "
                    f"{some_of([*names]) or 'none'}.",
                    culprits=[f"--{part}"],
                    next_step=did_you_mean(name, names),
                )
    options = [*_combinations(frames, by_part, parted=robot_between)]
    fitting = [
        option
        for option in options
        if all(map(option.frame_of, needs))
        and all(option.frame_of(part) == frame for part, frame in named.items())
    ]
    if not fitting:
        missing = [part for part in needs if not by_part[part]]
        pairs = [
            f"{object_name(option.camera, 'camera')} and {object_name(option.target, 'target')} "
            f"by robot {object_name(option.flange, 'robot')}"
            for option in _combinations(frames, by_part, parted=True)
            if option.camera and option.target
        ]
        raise DataError(
            f"{label} has no {missing[0]}."
            if missing
            else f"{label}: no one robot parts a camera from a target as they are named.",
            culprits=[f"--{name}" for name in missing or named],
            next_step=f"These go together: {some_of(pairs)}." if pairs and not missing else "",
        )
    if "target" in needs:
        observed = [option for option in fitting if (option.camera, option.target) in seen]
        fitting = observed or fitting
    for part in PARTS:
        remaining = list(dict.fromkeys(chosen.frame_of(part) for chosen in fitting))
        if part in needs and len(remaining) > 1:
            several = [object_name(name, part) for name in remaining]
            raise DataError(
                f"{label} has several {part}s ({some_of(several)}), and none is chosen.",
                culprits=[f"--{part}"],
                next_step=f"Name one: --{part} {several[0]}.",
            )
    return fitting[0]


# Kind of a part's frame: a robot is identified by its flange.
_KINDS: Mapping[Part, str] = {"camera": "camera", "robot": "flange", "target": "target"}


def _combinations(
    frames: Mapping[str, str], by_part: Mapping[Part, Collection[str]], *, parted: bool
) -> Iterator[Chosen]:
    """All valid combinations, those with target and camera first."""
    for flange in by_part["robot"]:
        robot = flange.partition("_")[2]
        for camera in (*by_part["camera"], ""):
            between = robots_between(frames, camera, frames[flange]) if camera else ()
            if between not in ((), (robot,)):
                continue
            mount: Mount = "eye-in-hand" if between else "eye-to-hand"
            for target in (*by_part["target"], ""):
                is_pair = camera and target and parted
                if not is_pair or robots_between(frames, camera, target) == (robot,):
                    yield Chosen(mount if camera else "instrument", camera, robot, target)


# Beginnings of number columns that are not the robot's.
_NOT_OF_ROBOTS = ("stamp_s", "ambient_c", "cft_", "meas_")


def has_several(session: SessionContent) -> bool:
    """Whether it has several cameras, robots, targets or instruments."""
    return any(len(session.declaration.named(kind)) > 1 for kind in KINDS)


def chosen_of(
    session: SessionContent,
    choice: Choice,
    needs: Collection[Part] = PARTS,
    *,
    robot_between: bool = True,
) -> Chosen:
    """Finds the camera, robot and target chosen by names and by a session's rows; see `choose`."""
    seen = {(observation.seer, observation.seen) for observation in session.observations}
    label = f"session {session.name!r}"
    return choose(
        session.frames, choice, needs, label=label, robot_between=robot_between, seen=seen
    )


def select(
    session: S, choice: Choice, needs: Collection[Part] = PARTS, *, robot_between: bool = True
) -> S:
    """Selects one camera, robot and target from a session; see `Session.of` and `choose`.

    Where no camera is needed, the rows are those without images with the robot's pose.
    """
    if choice.is_any and not has_several(session):
        return session
    chosen = chosen_of(session, choice, needs, robot_between=robot_between)
    if not has_several(session):
        return session
    if "camera" not in needs:
        chosen = replace(chosen, camera="", target="")
    seen = {one.view.number: (one.seer, one.seen) for one in session.observations}
    # The selected rows, each with the robot's numbers at its stop.
    rows: dict[int, View] = {}
    for view in session.views:
        sees = is_camera_observation(view)
        if chosen.camera:
            is_selected = sees and seen.get(view.number) == (chosen.camera, chosen.target)
        else:
            robot = name_of(session.declaration, "robot", view)
            is_selected = has_robot_state(view) and not sees and robot == chosen.robot
        if is_selected:
            robot_row = session.robot_rows[view.number].get(chosen.robot, View(0))
            numbers = {k: v for k, v in view.numbers.items() if not _is_of_robots(k)}
            numbers |= {k: v for k, v in robot_row.numbers.items() if _is_of_robots(k)}
            rows[view.number] = replace(view, numbers=numbers)
    # Columns that only other robots fill, as joints of one with more axes, are dropped.
    filled = {name for view in rows.values() for name in view.numbers}
    columns = tuple(
        column
        for column in session.columns
        if column not in (*SELECTORS, TARGET) and (column in filled or not _is_of_robots(column))
    )
    cells = [[view.cell(column) for column in columns] for view in rows.values()]
    table, target = session.corner_table, chosen.target.partition("_")[2]
    models, boards = session.robot_documents, session.target_document
    selected = session.assemble(
        _document(session, chosen),
        columns,
        cells,
        session.images,
        target_document=boards if boards is None or not session.targets else boards.get(target),
        robot_document=models.get(chosen.robot),
        corners=None if table is None else table.of_views(tuple(rows)).without_targets(),
    )
    return selected.with_streams(streams_of(session, chosen.robot))


def keep_views(session: S, numbers: Collection[int]) -> S:
    """Selects views of a session, with the robots' rows at their stops; see `Session.only`.

    Raises:
        DataError: The session has no such view, or none is given.
    """
    known = [view.number for view in session.views]
    unknown = sorted(set(numbers) - set(known))
    if unknown or not numbers:
        missing = f"views {ranges(unknown)}" if unknown else "no view"
        raise DataError(
            f"{missing} of session {session.name!r} are asked for; it has {ranges(known)}.",
            culprits=[ranges(unknown)] if unknown else [],
            next_step="Name views of views.csv, as 1-12,14.",
        )
    stops = {view.stop for view in session.views if view.number in numbers} - {None}
    kept = [
        view
        for view in session.views
        if view.number in numbers
        or (view.stop in stops and has_robot_state(view) and not is_camera_observation(view))
    ]
    table = session.corner_table
    return session.with_content(
        cells=[[view.cell(column) for column in session.columns] for view in kept],
        corners=None if table is None else table.of_views([view.number for view in kept]),
    )


def streams_of(session: SessionContent, robot: str) -> dict[str, Stream]:
    """The streams of one robot, and those of no robot, by name.

    A stream has the name of its robot, or begins with it, as `a` and `a_excite`.
    """
    names = [name or "robot" for name in session.robots]
    streams = {}
    for stream, series in session.streams.items():
        fitting = [name for name in names if stream == name or stream.startswith(f"{name}_")]
        if max(fitting, key=len, default=None) in (None, robot or "robot"):
            streams[stream] = series
    return streams


def _is_of_robots(column: str) -> bool:
    return is_number(column) and not column.startswith(_NOT_OF_ROBOTS)


def _document(session: SessionContent, chosen: Chosen) -> dict[str, Any]:
    """Content of session.toml for the chosen parts."""
    document = dict(session.document)
    for name in ("frames", "clocks", "prior", "mount", *KINDS, *(f"{kind}s" for kind in KINDS)):
        document.pop(name, None)
    document["mount"] = "eye-in-hand" if chosen.mount == "instrument" else chosen.mount
    for kind, name in (
        ("camera", chosen.camera.partition("_")[2]),
        ("robot", chosen.robot),
        ("target", chosen.target.partition("_")[2]),
    ):
        several = session.document.get(f"{kind}s", {})
        table = several.get(name, session.document.get(kind))
        # Short forms are expanded.
        if name in several and kind == "target" and not isinstance(table, str):
            table = table["target"]
        elif name in several and kind != "target" and isinstance(table, str):
            table = {"model": table}
        if table is not None:
            document[kind] = table
    clocks, camera = session.document.get("clocks", {}), chosen.camera.partition("_")[2]
    if camera in clocks:
        document["clock"] = clocks[camera]
    frames = (chosen.base, chosen.flange, chosen.camera, chosen.target)
    short = dict(zip(frames, ("base", "flange", "cam", "target"), strict=True))
    priors = {}
    for edge, prior in session.document.get("prior", {}).items():
        ends = [short.get(part) for part in edge.split("_from_")]
        if len(ends) == 2 and all(ends):
            priors[f"{ends[0]}_from_{ends[1]}"] = prior
    return document | ({"prior": priors} if priors else {})


def is_whole_cell(session: SessionContent) -> bool:
    """Whether a session can only be calibrated as a whole cell.

    A camera with an instrument is one, where the session has `[frames]`.
    """
    has_both_kinds = bool(session.cameras and session.instruments)
    return bool(_whole_cell_words(session)) or (has_both_kinds and bool(session.declaration.frames))


def must_select_one(session: SessionContent, choice: Choice) -> bool:
    """Whether one of each must be selected; several boards of one camera and robot need not be."""
    return is_whole_cell(session) or (not choice.is_any and has_several(session))


def check_one_of_each(session: SessionContent) -> None:
    """Checks that a session has one camera, robot and instrument, and boards on one side.

    Raises:
        DataError: It is of a whole cell.
    """
    if words := _whole_cell_words(session):
        raise DataError(
            f"session {session.name!r} {words}.",
            culprits=["session.toml"],
            next_step="Name one of each with --camera, --robot and --target, where the command has "
            "them (in Python: Session.of); or adjust all of it together: visioncal calibrate "
            "SESSION -o OUT.",
        )


def _whole_cell_words(session: SessionContent) -> str:
    """Why a session is of a whole cell, in words; empty where it is not."""
    several = {kind: list(session.declaration.named(kind)) for kind in KINDS if kind != "target"}
    words = [f"{kind}s ({some_of(names)})" for kind, names in several.items() if len(names) > 1]
    if words:
        return f"has several {' and several '.join(words)}; this takes one"
    if not session.declaration.frames or session.mount == "instrument":
        return ""
    boards = [frame_name("target", name) for name in session.declaration.named("target")]
    on_flange = {
        board: session.frames[board].startswith("flange")
        for board in boards
        if board in session.frames
    }
    misplaced = [
        name for name, is_moved in on_flange.items() if is_moved == (session.mount == "eye-in-hand")
    ]
    if not misplaced:
        return ""
    first = misplaced[0]
    return (
        f"has its camera {session.mount} and {some_of(misplaced)} on {session.frames[first]}; "
        f"this takes boards {'in the cell' if on_flange[first] else 'on the flange'} alone"
    )
