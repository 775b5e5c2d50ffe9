"""Recognises fields of poses by the words in their names."""

import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.conventions import POSE_FORMS
from visioncal.core.types import FloatArray
from visioncal.interchange.formats.fields import (
    Fields,
    appearance,
    is_headerless,
    split_matrices,
    without_unit,
)
from visioncal.interchange.formats.joints import joint_names
from visioncal.interchange.formats.pose_forms import ROTATION_NAME, split_pose
from visioncal.interchange.formats.pose_words import (
    BOTH_SIDES,
    CHILD_FIRST,
    FRAMES,
    PLACE,
    POSE_WORDS,
    POSITION_WORDS,
    ROTATION_WORDS,
    TRACKERS,
    PoseFields,
    words_of,
)

# Numbers of poses' sizes that are none, and poses that were not reached but asked for.
# How many numbers a pose has, or its position or its rotation.
_OF_POSES = (16, 12, 9, 7, 6, 4, 3)
_NO_POSE = re.compile(
    r"joint|关节|關節|axis|axes|angles|wrench|speed|force|torque|twist|vel|accel|effort|corner|intrins"
    r"|(?:^|[._])q$"
)
_ASKED_FOR = {"d", "des", "desired", "cmd", "commanded", "goal", "initial", "init", "ref", "guess"}
_AXIS_FIRST = re.compile(r"(?<![^ .])([wxyz]|[prt][xyz]|q[wxyz])_([a-z]+)$", re.IGNORECASE)
# Columns among which poses are looked for by their numbers alone.
_MOST_COLUMNS = 40
# Columns that count or time rows.
_COUNTED = {"view", "index", "id", "nr", "no", "t", "time", "timestamp", "stamp", "stamp_s"}
# Names of the numbers of a position and of a rotation, the least ambiguous rotations first.
_POSITION_NAMES = tuple(tuple(names.split()) for names in ("x y z", "tx ty tz", "px py pz"))
_ROTATION_NAMES: tuple[tuple[str, ...], ...] = (
    ("qx", "qy", "qz", "qw"),
    ("q0", "q1", "q2", "q3"),
    ("qx", "qy", "qz", "w"),
    ("qx", "qy", "qz"),
    *dict.fromkeys(tuple(form.names.split()) for form in POSE_FORMS.values()),
    ("ax", "ay", "az"),
)
# Axis times angle, which accelerations are called, too; and its largest length [rad].
_AXIS_NAMES, _LONGEST_AXIS = _ROTATION_NAMES[-1], 1.01 * np.pi
# A column of a pose's number, of which the first letters are those of its side: `mqx`.
_JOINED_NAME = re.compile(r"([a-z]{1,9}?)(q?[xyz]|qw)")


def possible_poses(
    fields: Fields, taken: Collection[str] = (), *, by_shape: bool = True
) -> list[PoseFields]:
    """All fields that may hold poses, by their names and by the properties of their numbers.

    Those named as poses come first; `by_shape` is whether others are taken at all.
    """
    found: list[PoseFields] = []
    places: list[_Piece] = []
    turns: list[_Piece] = []
    for piece in (*_arrays(fields, taken), *_numbers(fields, taken)):
        words, name = {*piece.words}, piece.names[0].lower()
        is_turn = piece.size == 3 and bool(ROTATION_WORDS & words) and words.isdisjoint(PLACE)
        named = POSE_WORDS | CHILD_FIRST | FRAMES["robot"][1]
        is_named = bool(words & named) and not _NO_POSE.search(name)
        if is_turn or piece.appearance in ("rotation", "quaternion"):
            turns.append(piece)
        elif piece.appearance == "pose" or (piece.size in (6, 7, 12, 16) and is_named):
            found.append(PoseFields(piece.names, piece.words))
        elif piece.size == 6 and not _NO_POSE.search(name):
            found.append(PoseFields(piece.names, piece.words, is_named=False))
        elif piece.size == 3 and not _NO_POSE.search(name):
            places.append(piece)
    # A position and a rotation share all other words; of several rotations the least ambiguous is
    # taken: a matrix, then a quaternion. Of other names they share what they stand in.
    rests = {place.rest for place in places if POSITION_WORDS & {*place.words}}
    for place in places:
        is_named = bool(POSITION_WORDS & {*place.words})
        alike = [turn for turn in turns if is_named and turn.rest == place.rest]
        # Of another file, rows without one have none of the other.
        alike = [turn for turn in alike if turn.parent == place.parent] or [
            turn for turn in alike if _are_of_same_rows(fields, place.names[0], turn.names[0])
        ]
        rest = (turn for turn in turns if turn.parent == place.parent and turn.rest not in rests)
        alike = alike or [*rest]
        if alike:
            turn = _clearest(fields, alike)
            others = place.rest if is_named else (*place.words, *turn.words)
            found.append(PoseFields((*place.names, *turn.names), others, is_named))
    known = {name for item in found if item.is_named for name in item.names}
    found += _without_names(fields, {*taken, *known}, places)
    complete = dict[tuple[str, ...], PoseFields]()
    for item in found:
        if item.is_named or by_shape:
            complete.setdefault(item.names, item)
    items = sorted(complete.values(), key=lambda item: not item.is_named)
    return _called(_of_trackers(items, taken), is_single=not taken)


def _are_of_same_rows(fields: Fields, one: str, other: str) -> bool:
    """Whether two fields have numbers in the same rows."""
    first, second = (np.isfinite(fields.column(name)).all(axis=1) for name in (one, other))
    return bool(np.array_equal(first, second))


def _of_trackers(items: list[PoseFields], taken: Collection[str]) -> list[PoseFields]:
    """Poses without the names of trackers, where these do not say that they are the camera's."""
    others = [PoseFields((name,), tuple(words_of(name))) for name in taken]
    if any(item.sides[:1] == ["robot"] for item in others) or any(
        item.sides == ["robot"] for item in items
    ):
        return items
    plain = [
        replace(item, words=tuple(word for word in item.words if word not in TRACKERS))
        for item in items
    ]
    pairs = zip(items, plain, strict=True)
    return [item if each.sides == ["camera"] else each for item, each in pairs]


def _called(items: list[PoseFields], *, is_single: bool) -> list[PoseFields]:
    """The only two poses, or one beside the other, with the sides that their names say."""
    called = {"".join(item.words): item for item in items}
    for side_words in BOTH_SIDES if len(items) == 1 + is_single else ():
        if called.keys() <= {*side_words}:
            sides = dict(zip(side_words, FRAMES, strict=True))
            return [replace(item, words=(sides[name],)) for name, item in called.items()]
    return items


def _clearest(fields: Fields, turns: Sequence["_Piece"]) -> "_Piece":
    """The least ambiguous of one rotation's forms.

    Angles [deg] beside a quaternion of three or four decimals have more digits; they are taken
    where both agree.
    """
    best = max(turns, key=lambda turn: turn.size)
    if best.appearance != "quaternion" or len(best.names) > 1:
        return best
    numbers = fields.column(best.names[0])
    is_coarse = (np.abs(np.linalg.norm(numbers, axis=1) - 1.0) < 0.01).all() and (
        numbers == numbers.round(4)
    ).all()
    for turn in turns if is_coarse else ():
        angles = fields.column(turn.names[0])
        if turn.size == 3 and re.search("(rpy|euler).*deg", turn.names[0].lower()):
            turned = Rotation.from_euler("xyz", angles, degrees=True)
            away = (turned.inv() * Rotation.from_quat(numbers)).magnitude()
            # Half a unit of the third decimal in four numbers turns by up to 2 mrad.
            if np.isfinite(angles).all() and away.max() <= 2e-3:
                return turn
    return best


def _without_names(
    fields: Fields, taken: Collection[str], places: Sequence["_Piece"]
) -> Iterator[PoseFields]:
    """Poses by their numbers alone: two times three in one mapping, or adjoining columns."""
    for first, second in combinations(places, 2):
        if first.parent == second.parent and len(first.names) == 1 == len(second.names):
            # The position comes first, unless the names say otherwise.
            names = sorted(
                (*first.names, *second.names), key=lambda name: bool(ROTATION_NAME.search(name))
            )
            yield PoseFields((*names,), (*first.words, *second.words), is_named=False)
    if is_headerless(fields):
        found = _in_sequence(next(iter(column_groups(fields).values()), ()), fields)
        yield from (item for item in found if not {*item.names} & {*taken})
        return
    joints = {*joint_names(fields, ())}
    for parent, columns in column_groups(fields, taken).items():
        is_other = bool(joints & {*columns} or _NO_POSE.search(parent.lower()))
        if is_other or len(columns) > _MOST_COLUMNS:
            continue
        flat = np.stack([fields.numbers[name] for name in columns], axis=1)
        for size, at in product((16, 12, 7, 6), range(len(columns) - 5)):
            is_pose = appearance(flat[:, at : at + size]) if size > 6 else len(columns) < 9
            if is_pose and at + size <= len(columns):
                window = columns[at : at + size]
                yield PoseFields(window, tuple(words_of(parent)), is_named=False)


def _in_sequence(columns: tuple[str, ...], fields: Fields) -> Iterator[PoseFields]:
    """Poses of the robot and then of the target among the columns of a table without a header."""
    flat = np.array([fields.numbers[name] for name in columns]).T
    at, sides = 0, iter(("robot", "target"))
    while at + 6 < len(columns):
        size = next((s for s in (16, 12, 7) if appearance(flat[:, at : at + s])), 0)
        if size and (side := next(sides, "")):
            yield PoseFields(columns[at : at + size], (side,))
        at += size or 1
    if next(sides, "") == "robot" and len(columns) in (6, 7):
        # A number or a time may stand before a position with three angles.
        yield PoseFields(columns[-6:], ("robot",))


def column_groups(fields: Fields, taken: Collection[str] = ()) -> dict[str, tuple[str, ...]]:
    """Columns of a number each that may be measured, in their order, by what they stand in."""
    groups: dict[str, tuple[str, ...]] = defaultdict(tuple)
    for name, numbers in fields.numbers.items():
        parent, _, last = name.rpartition(".")
        if numbers.ndim != 1 or name in taken:
            continue
        steps = np.diff(numbers[np.isfinite(numbers)])
        is_count = not (numbers[np.isfinite(numbers)] % 1).any() or bool((steps > 0).all())
        if not (is_count and last.lower() in _COUNTED):
            groups[parent] += (name,)
    return groups


@dataclass(frozen=True)
class _Piece:
    """Fields that may be a pose or a part of one."""

    names: tuple[str, ...]
    words: tuple[str, ...]
    size: int  # Number of values.
    appearance: str  # Their kind, as far as they show it.

    @property
    def rest(self) -> tuple[str, ...]:
        """The words beside those of positions and rotations."""
        return tuple(word for word in self.words if word not in POSITION_WORDS | ROTATION_WORDS)

    @property
    def parent(self) -> str:
        """The table of the fields."""
        return self.names[0].rpartition(".")[0]


def points_in(fields: Fields) -> list[PoseFields]:
    """Fields of three numbers a row, or four of which the last is 1, that are no rotation."""
    pieces = (*_arrays(fields, ()), *_numbers(fields, ()))
    return [
        PoseFields(piece.names, piece.words)
        for piece in pieces
        if piece.size in (3, 4) and not ROTATION_WORDS & {*piece.words}
        if not _NO_POSE.search(piece.names[0].lower())
        if piece.size == 3 or (fields.column(piece.names[-1])[:, -1] == 1.0).all()
    ]


def _arrays(fields: Fields, taken: Collection[str]) -> Iterator[_Piece]:
    for name, numbers in fields.numbers.items():
        if numbers.ndim > 1 and name not in taken and len(numbers):
            yield _Piece((name,), tuple(words_of(name)), numbers[0].size, appearance(numbers))


def _numbers(fields: Fields, taken: Collection[str]) -> Iterator[_Piece]:
    """Positions and rotations of a column a number."""
    for prefix, named in _by_prefix(fields, taken).items():
        words = words_of(prefix)
        position, rotation = (
            next((part for part in known if {*part} <= named.keys()), ())
            for known in (_POSITION_NAMES, _ROTATION_NAMES)
        )
        if POSE_WORDS & {*words} and (columns := _counted(named)):
            flat = np.stack([fields.numbers[name] for name in columns], axis=1)
            yield _Piece(columns, tuple(words), len(columns), appearance(flat))
        if {*named} == {*"xyzw"}:
            position, rotation = (), tuple("xyzw")
        elif position and not rotation and ROTATION_WORDS & {*words} and words[0] not in PLACE:
            position, rotation = (), position
        if rotation == _AXIS_NAMES:
            vectors = np.stack([fields.numbers[named[each]] for each in rotation], axis=1)
            is_turn = np.nanmax(np.linalg.norm(vectors, axis=1), initial=0.0) < _LONGEST_AXIS
            rotation = rotation if is_turn else ()
        # Five and more of these are joints.
        if rotation and "q5" not in named:
            names = tuple(named[each] for each in rotation)
            if rotation == ("qx", "qy", "qz"):
                others = {*taken, *names, *(named[each] for each in position)}
                names += _real_part(fields, names, words, others)
            yield _Piece(names, (*words, "rotation"), len(names), "rotation")
        if position:
            names = tuple(named[each] for each in position)
            yield _Piece(names, (*words, "position"), 3, "")


def _real_part(
    fields: Fields, names: tuple[str, ...], words: Sequence[str], taken: Collection[str]
) -> tuple[str, ...]:
    """The column of any name beside x, y, z of quaternions that makes them unit ones, or none."""
    parent = names[0].rpartition(".")[0]
    vectors = [fields.numbers[name] for name in names]
    for name, numbers in fields.numbers.items():
        is_component = name.rpartition(".")[0] == parent and {*words} <= {*words_of(name)}
        if name in taken or numbers.ndim > 1 or not is_component:
            continue
        if appearance(np.stack([*vectors, numbers], axis=1)) == "quaternion":
            return (name,)
    return ()


def _counted(named: Mapping[str, str]) -> tuple[str, ...]:
    """Columns whose last words are numbers from zero or one, as many as a pose has; else empty."""
    numbers = sorted(int(word) for word in named if word.isdecimal())
    first = numbers[0] if numbers else 2
    is_whole = numbers == [*range(first, first + len(numbers))] and len(numbers) == len(named)
    fits = is_whole and first < 2 and len(numbers) in _OF_POSES and len(numbers) > 5
    return tuple(named[str(number)] for number in numbers) if fits else ()


def _by_prefix(fields: Fields, taken: Collection[str]) -> dict[str, dict[str, str]]:
    """Columns by what their names begin with, and by their last words: `tcp_`, `rx`."""
    groups: dict[str, dict[str, str]] = defaultdict(dict)
    columns = {name: None for name, numbers in fields.numbers.items() if numbers.ndim == 1}
    texts = {name: None for name, cells in fields.texts.items() if any(cells)}
    # An exact name goes before one in another case or with a unit.
    for name in sorted({**columns, **texts}, key=lambda name: without_unit(name)[0] != name):
        # `x_pos` is `pos_x`, and `px_r` is `r_px`.
        plain = _AXIS_FIRST.sub(r"\2_\1", without_unit(name)[0])
        last = re.split("[ _.]", plain)[-1]
        prefix = plain.removesuffix(last)
        # The same numbers as an array.
        if name not in taken and prefix.rstrip(".") not in fields.numbers:
            groups[prefix].setdefault(last.lower(), name)
    return _apart(groups)


def _apart(groups: Mapping[str, dict[str, str]]) -> dict[str, dict[str, str]]:
    """The groups, and of their own poses whose names are joined to a side's: `mx .. mqw`."""
    found: dict[str, dict[str, str]] = {}
    for prefix, named in groups.items():
        joined: dict[str, dict[str, str]] = defaultdict(dict)
        for last, name in named.items():
            if match := _JOINED_NAME.fullmatch(last):
                joined[match[1]][match[2]] = name
        whole = {letters: each for letters, each in joined.items() if len(each) == 7}
        names = {name for each in whole.values() for name in each.values()}
        found[prefix] = {last: name for last, name in named.items() if name not in names}
        # A t alone stands for a translation, whose rotation is another group's.
        found |= {f"{prefix}{'tt' if of == 't' else of}_": each for of, each in whole.items()}
    return found


def pose_names(
    fields: Fields,
    given: Sequence[str],
    side: str,
    taken: Collection[str],
    *,
    by_shape: bool = True,
) -> tuple[str, ...]:
    """Full names of the fields with the poses of the `robot` or `camera`; empty where none fit.

    They are those that the user gives, else the only fields that may hold poses and whose words say
    so: by the frames of that side, first in the right order, and for the robot without any words.
    Raises DataError.
    """
    if given:
        if len(given) == 1 and given[0] not in {*fields.numbers, *fields.texts}:
            # A key that holds a position and a rotation.
            for item in possible_poses(fields):
                if f".{given[0]}." in f".{item.names[0]}.":
                    return item.names
        return tuple(_of_side(fields, name, side) for name in given)
    first = next(iter(ranked_poses(fields, side, taken, by_shape=by_shape)), [])
    if first:
        return first[0].names if len(first) == 1 or _are_one(fields, first) else ()
    # A field whose rows are irregular is refused by its row.
    ragged = (
        PoseFields((name,), tuple(words_of(name)))
        for name, fault in fields.shape_errors.items()
        if fault.count in _OF_POSES
    )
    return next(
        (
            item.names
            for item in ragged
            if item.sides == [side] and not _NO_POSE.search(item.names[0].lower())
        ),
        (),
    )


def _of_side(fields: Fields, name: str, side: str) -> str:
    """The full name of a field; of equal ones in several files, that in the side's own."""
    known = dict.fromkeys([*fields.numbers, *fields.texts])
    candidates = [word for word in known if word.endswith(f".{name}") and name not in known]
    candidates = [
        word for word in candidates if PoseFields((word,), tuple(words_of(word))).sides == [side]
    ]
    return candidates[0] if len(candidates) == 1 else fields.find(name)


def _are_one(fields: Fields, items: Sequence[PoseFields]) -> bool:
    """Whether several fields are the same poses, as a matrix beside its position and rotation."""
    places = list[FloatArray]()
    for item in items:
        blocks = [fields.column(name) for name in item.names]
        sizes = [block.shape[1] for block in blocks]
        if sum(sizes) in (12, 16) and 9 not in sizes:
            places.append(split_matrices(np.hstack(blocks))[0])
        else:
            places.append(split_pose(fields, item.names, blocks, "robot")[0])
    # Read before and after a picture, they differ by less than arms repeat: 0.1 mm at 1 m.
    away = [np.linalg.norm(places[0] - other, axis=1) for other in places]
    sizes = 1e-9 + 1e-4 * np.linalg.norm(places[0], axis=1)
    return all((~(each > sizes)).all() for each in away)


def without_copies(fields: Fields, items: Sequence[PoseFields]) -> Sequence[PoseFields]:
    """Fields but for copies of the target's poses under a name of no side, where others remain."""
    seen = [item for item in items if item.is_of_target]
    plain = [item for item in items if not item.sides and not item.is_seen]
    copies = [one for one in plain if any(_are_one(fields, (one, other)) for other in seen)]
    return items if len(copies) == len(plain) else [item for item in items if item not in copies]


def ranked_poses(
    fields: Fields, side: str, taken: Collection[str] = (), *, by_shape: bool = True
) -> list[list[PoseFields]]:
    """Fields that may hold the poses of the `robot` or `camera`, in groups, the likeliest first."""
    groups: dict[tuple[int, bool], list[PoseFields]] = defaultdict(list)
    # Those of frames of that side come first.
    possible = without_copies(fields, possible_poses(fields, taken, by_shape=by_shape))
    for item in sorted(possible, key=lambda item: item.sides != [side]):
        is_of_side, is_plain = item.sides == [side], not item.sides
        fits = (
            is_of_side and item.is_named and not item.is_reversed(side),
            is_of_side and item.is_named,
            is_plain and item.is_named and not item.is_seen and side == "robot",
            item.is_seen and item.is_named and side == "camera",
            (is_of_side or (is_plain and not item.is_seen)) and side == "robot",
            len(item.sides) > 1 and side == "robot",
            item.is_seen and side == "robot",
        )
        if any(fits):
            groups[fits.index(True), bool({*item.words} & _ASKED_FOR)].append(item)
    return [groups[rank] for rank in sorted(groups)]


def columns_named(fields: Fields, wanted: Sequence[str]) -> tuple[str, ...]:
    """The columns of these names, in any case, with a unit or words before; empty without."""
    groups = {k: group for k, group in _by_prefix(fields, ()).items() if {*wanted} <= group.keys()}
    group = groups.get("") or (next(iter(groups.values())) if len(groups) == 1 else None)
    return tuple(group[name] for name in wanted) if group else ()
