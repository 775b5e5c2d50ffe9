"""Programs of robots: literal targets in their text, and the same text with these corrected.

Only numbers of targets are replaced: everything else stays byte for byte.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.results.compensation.correction import CalibratedArm, Corrected, correct
from visioncal.robot import Loads

NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
# Frames by the names of a program, as `tool NAME` or `base NAME`; None where unknown.
Frames: TypeAlias = Callable[[str], FloatArray | None]
# A frame (4, 4) [m], or its name where it is not known.
Frame: TypeAlias = FloatArray | str


@dataclass(frozen=True)
class Literal:
    """Numbers of a target as they stand in a file."""

    file: str
    name: str  # Its name, or the line that it stands in.
    spans: tuple[tuple[int, int], ...]  # Places of the numbers in the text.
    values: tuple[float, ...]  # Position and rotation, or joint angles.
    are_joints: bool = False
    # Signs (-1, 0, 1) or middles of quadrants of the joints that name its posture [rad], NaN for
    # joints of which nothing is stated; empty where it is not stated.
    posture: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Use:
    """A motion to a literal target."""

    literal: Literal
    base: FloatArray  # (4, 4) frame of the target in the robot's base [m].
    tool: FloatArray  # (4, 4) of its tool on the flange [m].

    def is_like(self, others: Sequence["Use"]) -> bool:
        """Whether others have the same frames, or need none."""
        frames = np.concatenate([self.base, self.tool])
        other_frames = (np.concatenate([each.base, each.tool]) for each in others)
        return self.literal.are_joints or all(np.array_equal(frames, each) for each in other_frames)


@dataclass
class Found:
    """Content of a program."""

    uses: list[Use] = field(default_factory=list)
    left: list[str] = field(default_factory=list)  # Lines that stay, and why.
    kept: set[Literal] = field(default_factory=set)  # Targets that an unknown frame keeps as well.

    def add(self, place: str, literal: Literal, base: Frame, tool: Frame) -> None:
        """Adds a motion, or leaves it where a frame (or its name) is not known."""
        unknown = [frame for frame in (tool, base) if isinstance(frame, str)]
        if unknown and not literal.are_joints:
            self.left.append(f"{place}: not known is {' nor '.join(unknown)}")
            self.kept.add(literal)
            return
        frames = [np.eye(4) if isinstance(frame, str) else frame for frame in (base, tool)]
        self.uses.append(Use(literal, *frames))


@dataclass(frozen=True)
class Dialect:
    """A language of programs."""

    name: str
    suffixes: tuple[str, ...]
    companion: str  # Suffix of a second file with the data of the first; empty for none.
    comments: str  # Pattern of what is no code.
    read: Callable[[Mapping[str, str], Frames], Found]  # Reads files without comments.
    reading: Reading  # How poses are written.
    joint_rad: float  # Unit of joint angles [rad].
    decimals: tuple[int, int]  # Least decimals of positions, and of rotations and joints.


def by_file(
    read: Callable[[str, str, Frames, Found], object],
) -> Callable[[Mapping[str, str], Frames], Found]:
    """Reads files one after the other, each by its name and text, into what was found."""

    def read_all(code: Mapping[str, str], frames: Frames) -> Found:
        found = Found()
        for name, text in code.items():
            read(name, text, frames, found)
        return found

    return read_all


def number_spans(text: str, start: int, end: int) -> tuple[tuple[int, int], ...]:
    """Places of the numbers in a part of a text."""
    return tuple(found.span() for found in NUMBER.finditer(text, start, end))


def numbers_at(text: str, spans: Sequence[tuple[int, int]]) -> tuple[float, ...]:
    """The numbers at some places."""
    return tuple(float(text[start:end]) for start, end in spans)


def pose_of(values: Sequence[float], reading: Reading) -> FloatArray:
    """(4, 4) pose of position and rotation as they are written [m]."""
    numbers = np.array(values)[None]
    return np.asarray(PoseNumbers(numbers[:, :3], numbers[:, 3:], reading, ("",)).poses()[0])


def line_of(text: str, at: int) -> int:
    """Number of the line of a place."""
    return text.count("\n", 0, at) + 1


@dataclass(frozen=True, eq=False)
class CorrectedProgram:
    """A corrected program."""

    texts: Mapping[str, str]  # Its files by name.
    changed: tuple[str, ...]  # Names of the targets that were replaced.
    left: tuple[str, ...]  # Lines that stay, and why.
    moved_mm: FloatArray  # (k,) how far each command moves.
    q: FloatArray  # (k, n) joints there [rad or m].


def correct_program(
    dialect: Dialect,
    texts: Mapping[str, str],
    arm: CalibratedArm,
    frames: Frames,
    *,
    loads: tuple[float, tuple[float, ...]] = (0.0, (0.0, 0.0, 0.0)),
    seed: FloatArray | None = None,
) -> CorrectedProgram:
    """Replaces the literal targets of linear and joint motions by corrected ones.

    Args:
        dialect: The program's language.
        texts: Its files by name.
        arm: The calibrated arm.
        frames: Tools and bases by their names in the program.
        loads: Mass of the load [kg], and its centre in the flange's frame [m].
        seed: (n,) joint angles near the first target [rad].
    """
    # Comments and strings are blank, so that every place stays.
    blank = re.compile(dialect.comments)
    code = {
        name: blank.sub(lambda hidden: " " * len(hidden[0]), text) for name, text in texts.items()
    }
    found = dialect.read(code, frames)
    left = found.left
    by_literal: dict[Literal, list[Use]] = {}
    for use in found.uses:
        by_literal.setdefault(use.literal, []).append(use)
    uses = []
    for literal, each in by_literal.items():
        if literal in found.kept or not each[0].is_like(each):
            left.append(f"{literal.name}: it is used with several tools or bases")
        else:
            uses.append(each[0])
    if not uses:
        return CorrectedProgram(
            dict(texts), (), tuple(left), np.zeros(0), np.zeros((0, arm.real.joint_count))
        )
    wanted, seeds = zip(*(_wanted(dialect, use, arm) for use in uses), strict=True)
    starts = np.array(seeds)
    if seed is not None and np.isnan(starts[0]).any():
        starts[0] = seed
    kg, centre = loads
    found_q = correct(
        arm,
        np.array(wanted),
        starts,
        # Postures are stated roughly: of all branches the nearest is taken.
        widest_rad=1e-3,
        loads=Loads.alike(len(uses), kg, centre, (0.0, 0.0, 0.0)),
    )
    edits: dict[str, list[tuple[int, int, str]]] = {}
    changed, moved, at_q = list[str](), list[float](), list[FloatArray]()
    for at, use in enumerate(uses):
        literal = use.literal
        if fault := _fault(literal, found_q, at, arm):
            left.append(f"{literal.name}: {fault}")
            continue
        numbers = _numbers(dialect, use, found_q, at)
        for (start, end), number, place in zip(literal.spans, numbers, range(99), strict=False):
            old = texts[literal.file][start:end]
            kept = len(old.partition(".")[2]) if "e" not in old.lower() else 0
            least = dialect.decimals[literal.are_joints or place >= 3]
            edits.setdefault(literal.file, []).append(
                (start, end, f"{number:.{max(kept, least)}f}")
            )
        changed.append(literal.name)
        moved.append(1e3 * float(found_q.moved_m[at]))
        at_q.append(found_q.q[at])
    new = {name: _edited(text, edits.get(name, [])) for name, text in texts.items()}
    joints = np.array(at_q).reshape(-1, arm.real.joint_count)
    return CorrectedProgram(new, tuple(changed), tuple(left), np.array(moved), joints)


def _edited(text: str, edits: list[tuple[int, int, str]]) -> str:
    for start, end, number in sorted(edits, reverse=True):
        text = text[:start] + number + text[end:]
    return text


def _wanted(dialect: Dialect, use: Use, arm: CalibratedArm) -> tuple[FloatArray, FloatArray]:
    """Flange pose (4, 4) of a motion [m], and where its joints are looked for (n,) [rad]."""
    literal, count = use.literal, arm.real.joint_count
    seed = np.full(count, np.nan)
    if literal.are_joints:
        q = dialect.joint_rad * np.array(literal.values[:count])
        return arm.nominal.base_from_flange(q[None])[0], q
    if literal.posture:
        stated = np.array(literal.posture[:count])
        seed = np.where(np.isnan(stated), 0.0, stated)
    pose = pose_of(literal.values, dialect.reading)
    return use.base @ pose @ invert(use.tool), seed


def _fault(literal: Literal, found: Corrected, at: int, arm: CalibratedArm) -> str:
    """Why a target stays; empty where it is corrected."""
    if not found.reached[at]:
        return "it is out of reach of the calibrated arm"
    stated = np.array(literal.posture[: arm.real.joint_count])
    if literal.posture and (np.abs(found.q[at] - stated)[np.isfinite(stated)] > np.pi / 2).any():
        return "no posture of the model is the stated one (S, T or confdata)"
    return ""


def _numbers(dialect: Dialect, use: Use, found: Corrected, at: int) -> list[float]:
    """The corrected numbers, as near to the old ones as the same pose can be written."""
    old = np.array(use.literal.values)
    if use.literal.are_joints:
        return list(found.q[at] / dialect.joint_rad)
    pose = invert(use.base) @ found.base_from_flange[at] @ use.tool
    sent = PoseNumbers.written(pose[None], dialect.reading, (use.literal.name,))
    place, turn = sent.positions[0], sent.rotations[0]
    if "quaternion" in dialect.reading.rotation and turn @ old[3:] < 0.0:
        turn = -turn
    if "euler" in dialect.reading.rotation:
        turn = turn + 360.0 * np.round((old[3:] - turn) / 360.0)
    length = float(np.linalg.norm(turn))
    if dialect.reading.rotation == "rotation-vector" and length and turn @ old[3:] < 0.0:
        turn = turn * (1.0 - 2.0 * np.pi / length)
    return [*place, *turn]
