"""Choice of one camera, robot and target of a whole cell, with the robot between the other two."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from visioncal.core.errors import DataError
from visioncal.core.number_format import did_you_mean, some_of
from visioncal.core.types import Mount
from visioncal.session.frames import frame_name, frames_of_kind, object_name, robots_between

Part: TypeAlias = Literal["camera", "robot", "target"]
PARTS: tuple[Part, ...] = get_args(Part)
# Parts that must be unambiguous for a camera with any target, and without a camera.
EYE: tuple[Part, ...] = ("camera", "robot")
ARM: tuple[Part, ...] = ("robot",)
LENS: tuple[Part, ...] = ("camera",)


@dataclass(frozen=True)
class Choice:
    """Names of a camera, a robot and a target; None for any.

    A name is that of the session's table, as `left`, or of the frame, as `cam_left`.
    """

    camera: str | None = None
    robot: str | None = None
    target: str | None = None

    def __bool__(self) -> bool:
        return any(name is not None for name in (self.camera, self.robot, self.target))

    def of(self, part: Part) -> str | None:
        """The given name of a part."""
        return {"camera": self.camera, "robot": self.robot, "target": self.target}[part]


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
    named = {
        part: _frame(by_part[part], part, name, label)
        for part in PARTS
        if (name := choice.of(part))
    }
    options = [
        option
        for option in _combinations(frames, by_part, parted=robot_between)
        if all(map(option.frame_of, needs))
    ]
    fitting = [
        option for option in options if all(option.frame_of(p) == at for p, at in named.items())
    ]
    if not fitting:
        raise _none_fits(frames, by_part, named, needs, label)
    if "target" in needs:
        observed = [option for option in fitting if (option.camera, option.target) in seen]
        fitting = observed or fitting
    for part in PARTS:
        remaining = list(dict.fromkeys(chosen.frame_of(part) for chosen in fitting))
        if part in needs and len(remaining) > 1:
            names = [object_name(name, part) for name in remaining]
            raise DataError(
                f"{label} has several {part}s ({some_of(names)}), and which is meant is not said.",
                culprits=[f"--{part}"],
                next_step=f"Name one: --{part} {names[0]}.",
            )
    return fitting[0]


# Kind of a part's frame: a robot is identified by its flange.
_KINDS: Mapping[Part, str] = {"camera": "camera", "robot": "flange", "target": "target"}


def _frame(frames: Collection[str], part: Part, name: str, label: str) -> str:
    """Frame of a named part."""
    for frame in frames:
        if name in (frame, object_name(frame, part)):
            return frame
    names = [object_name(word, part) for word in frames]
    raise DataError(
        f"{label} has no {part} {name!r}: its {part}s are {some_of(names) or 'none'}.",
        culprits=[f"--{part}"],
        next_step=did_you_mean(name, names),
    )


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
                both = camera and target and parted
                if not both or robots_between(frames, camera, target) == (robot,):
                    yield Chosen(mount if camera else "instrument", camera, robot, target)


def _none_fits(
    frames: Mapping[str, str],
    by_part: Mapping[Part, Collection[str]],
    named: Mapping[Part, str],
    needs: Collection[Part],
    label: str,
) -> DataError:
    """Error that no combination fits the names."""
    culprits = [f"--{name}" for name in named]
    for part in needs:
        if not by_part[part]:
            return DataError(f"{label} has no {part}.", culprits=[f"--{part}"])
    only = {
        part: next(iter(collection)) for part, collection in by_part.items() if len(collection) == 1
    } | dict(named)
    camera, target, flange = (only.get(name) for name in ("camera", "target", "robot"))
    robot = None if flange is None else object_name(flange, "robot")
    if camera and target and "target" in needs:
        robots = robots_between(frames, camera, target)
        names = " and ".join(robot or "robot" for robot in robots)
        on = f"{camera} is on {frames[camera]} and {target} on {frames[target]}"
        if not robots:
            words = f"{on}, and no robot moves them before each other"
            step = "Name a camera or a target that a robot carries."
        elif len(robots) > 1:
            words = f"{on}: robots {names} part them, and one is needed"
            step = "Name a camera and a target of which one robot carries one."
        else:
            words = f"{on}: robot {names} parts them, and robot {robot} does not"
            step = f"Name that robot: --robot {names}."
        return DataError(f"{label}: {words}.", culprits=culprits, next_step=step)
    if camera:
        carrier = f"{camera} is on {frames[camera]}"
        which = f"robot {robot} has no part in what it sees" if robot else "no robot parts it"
        return DataError(
            f"{label}: {carrier}, and {which}.",
            culprits=culprits,
            next_step="Name another robot, or another camera.",
        )
    pairs = [
        f"{object_name(option.camera, 'camera')} and {object_name(option.target, 'target')} "
        f"by robot {object_name(option.flange, 'robot')}"
        for option in _combinations(frames, by_part, parted=True)
        if option.camera and option.target
    ]
    return DataError(
        f"{label}: no robot parts a camera from a target as they are named.",
        culprits=culprits,
        next_step=f"These go together: {some_of(pairs)}." if pairs else "",
    )
