"""Parsing of a pose in one line, as robot pendants show it and robot programs contain it.

Recognised are URScript's `p[..]`, Doosan's `posx(..)`, RAPID's `[[..],[..]]` and robtargets, and
named values: X, Y, Z and A, B, C (KUKA), W, P, R (FANUC), q1 to q4 (ABB), Rx, Ry, Rz (several
manufacturers), qx to qw. Bare numbers are classified by their count alone.

Digits may be those of any script, and named or bare numbers may have decimal commas; where a comma
may as well separate numbers or thousands, the line is refused.
"""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from visioncal.core.choices import UNITS_M
from visioncal.core.conventions import POSE_FORMS, PoseForm, PoseNumbers, Reading, write_pose
from visioncal.core.documents.values import DECIMAL, DECIMAL_COMMA
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray

_UNIT = r"(?:mm|m|deg|rad)"
_NAMED = re.compile(
    rf"(?<![\w.])([Qq][1-4]|[A-Za-z]+)(?:_m)?\s*[:=]?\s*\"?({DECIMAL_COMMA}|{DECIMAL})\s*({_UNIT})?"
    r"(?![\w.]|,[0-9])"
)
_BETWEEN = re.compile(r"[\s\[\]{}(),;]+")
# The same, but for commas within a number; and a comma that may be in one.
_BETWEEN_COMMAS = re.compile(r"(?:[\s\[\]{}();]|,(?![0-9])|(?<![0-9]),)+")
_INNER_COMMA = re.compile(r"[0-9],[0-9]")
# A number that groups its thousands, by commas or by points.
_THOUSANDS = re.compile(r"[+-]?[1-9][0-9]{0,2}(?:,[0-9]{3})+|[+-]?[0-9]{1,3}(?:\.[0-9]{3})+,[0-9]+")
# Typographic signs; soft hyphens are not among them, because they may be minus or nothing.
_SIGNS = str.maketrans(
    dict.fromkeys("\N{DEGREE SIGN}\N{MASCULINE ORDINAL INDICATOR}\N{RING ABOVE}", " deg")
    | {"\N{GREEK SMALL LETTER ALPHA}": " alpha ", "\N{GREEK SMALL LETTER BETA}": " beta "}
    | {"\N{GREEK SMALL LETTER GAMMA}": " gamma "}
    | dict.fromkeys("\N{MINUS SIGN}\N{EN DASH}\N{HYPHEN}\N{NON-BREAKING HYPHEN}", "-")
    | {
        "\N{ARABIC DECIMAL SEPARATOR}": ".",
        "\N{IDEOGRAPHIC COMMA}": " ; ",
        "\N{ARABIC COMMA}": " ; ",
    }
    # Marks of the direction of writing.
    | dict.fromkeys("\N{LEFT-TO-RIGHT MARK}\N{RIGHT-TO-LEFT MARK}\N{ARABIC LETTER MARK}")
)
# Notations around the numbers of a pose, with their forms.
_MARKED = (
    ("ur", re.compile(r"(?<!\w)p\s*(?:\[(?=[^\[\]]*\])|\((?=[^()]*\)))([^\[\]()]*)[\])]")),
    ("doosan", re.compile(r"(?<!\w)posx\s*\(([^()]*)\)")),
    ("abb", re.compile(r"\[\s*\[([^\[\]]*\]\s*,\s*\[[^\[\]]*)\]")),
)
_NAMED_ROTATIONS = dict.fromkeys(
    tuple(names.split())
    for form in POSE_FORMS.values()
    for names in filter(None, (form.names, form.also))
)
# Forms by the count of bare numbers; seven are the columns of views.csv.
_BARE_FORMS: Mapping[int, tuple[str, ...]] = {
    6: tuple(
        form.name for form in POSE_FORMS.values() if form.models and len(form.names.split()) == 3
    ),
    7: ("ros",),
    16: ("franka",),
}
# Greatest position of an arm [m], and greatest angle in radians.
_FAR_M, _TURNED_RAD = 10.0, 2.0 * np.pi + 0.01


@dataclass(frozen=True, eq=False)
class PendantPose:
    """A pose that was read."""

    pose: FloatArray  # (4, 4) [m].
    form: PoseForm  # The assumed form.
    reading: Reading  # The assumed units and rotation.

    @property
    def words(self) -> str:
        """Description of the interpretation."""
        return f"{self.form.words} ({self.reading.words})"


@dataclass(frozen=True)
class _PendantNumbers:
    """The numbers of a line, their possible forms, and units stated in the line."""

    numbers: tuple[float, ...]
    forms: tuple[str, ...]  # Those that are meant unless another is stated.
    length: str = ""
    angle: str = ""
    doubt: str = ""  # Why its commas may mean several things; empty where they do not.
    names: tuple[str, ...] = ()  # Those of the rotation's numbers, in lower case.


def is_marked_pose(line: str) -> bool:
    """Whether a line has the notation or the names of a pose, and not only numbers."""
    plain = _plain(line)
    return _marked(plain) is not None or _named(plain) is not None


def possible_forms(line: str) -> tuple[str, ...]:
    """Possible forms of a line, as names of `POSE_FORMS`; none for no pose."""
    written = _written(line)
    return () if written is None or written.doubt else written.forms


def line_numbers(line: str) -> tuple[float, ...]:
    """Numbers between blanks or semicolons, with either decimal sign; none if it has more."""
    words = [word for word in _BETWEEN_COMMAS.split(_plain(line)) if word]
    return _values(words) or ()


def read_pose(line: str, where: str, form: str | None = None, *, angle: str = "") -> PendantPose:
    """Reads a pose from a line.

    Args:
        line: The line.
        where: Its origin, for messages.
        form: A name among `POSE_FORMS` if the user states it; the line must agree.
        angle: The unit of angles where the line states none, `rad` or `deg`; else that of the form.

    Raises:
        DataError: It is no pose, may be in several forms, or has implausible values.
    """
    written = _written(line)
    if written is None:
        raise DataError(
            f"{where}: {line.strip()[:80]!r} must be a pose in a known form.",
            culprits=[where],
            next_step="Write a line such as p[x, y, z, rx, ry, rz], {X .., Y .., Z .., A .., B .., "
            "C ..}, [[x, y, z], [q1, q2, q3, q4]], X .. Y .. Z .. W .. P .. R .., or x_m y_m z_m "
            "qx qy qz qw.",
        )
    if written.doubt:
        raise DataError(
            f"{where}: {written.doubt}.",
            culprits=[where],
            next_step="Write decimal points, or name the numbers, as X 512,34 Y -12,5 Z 800,0 "
            "A 10,1 B 0,5 C 180,0; thousands are not grouped.",
        )
    chosen = POSE_FORMS[_form(written, form, where)]
    rotation = chosen.rotation
    angle = written.angle or angle
    if angle == "deg" and rotation == "rotation-vector":
        rotation = "rotation-vector-deg"
    if angle and rotation.startswith("euler"):
        rotation = rotation[:-3] + angle
    reading = Reading(rotation, written.length or chosen.unit)
    numbers = np.array(written.numbers)
    poses = PoseNumbers(numbers[None, :3], numbers[None, 3:], reading, (where,)).poses()
    distance_m, most = UNITS_M[reading.unit] * np.abs(numbers[:3]).max(), np.abs(numbers[3:]).max()
    is_radian = rotation == "rotation-vector" or rotation.endswith("-rad")
    if distance_m > _FAR_M or (is_radian and most > _TURNED_RAD):
        what = f"it is {distance_m:.4g} m from the base"
        what = what if distance_m > _FAR_M else f"an angle of {most:.4g} is too large for radians"
        raise DataError(
            f"{where}: read in {reading.words}, {what}.",
            culprits=[where],
            next_step="Write the units behind the numbers, as X 400 mm or RX 12.5 deg, or name "
            "another form.",
        )
    return PendantPose(poses[0], chosen, reading)


def rotation_names(form: PoseForm) -> tuple[str, ...]:
    """Names of a form's rotation numbers, in lower case."""
    return tuple(form.names.split())


def forms_named(names: Sequence[str]) -> list[str]:
    """Forms whose rotation numbers have these names, in lower case."""
    joined = " ".join(names)
    forms = POSE_FORMS.values() if joined else ()
    return [form.name for form in forms if joined in (form.names, form.also)]


def pendant_words(pose: FloatArray, form: PoseForm) -> str:
    """Writes a (4, 4) pose [m] as a pendant shows it: `X 512.300 mm, ... A 10.1200 deg, ...`."""
    if form.rotation.startswith("matrix"):
        return ", ".join(f"{value:.6f}" for value in pose.T.ravel())
    digits, unit = (4, "deg") if form.rotation.endswith("-deg") else (6, "rad")
    # The length unit that pendants show, whatever a program's poses have.
    words = [f"{name} {1e3 * value:.3f} mm" for name, value in zip("XYZ", pose[:3, 3], strict=True)]
    for name, value in zip(rotation_names(form), write_pose(pose, form)[3:], strict=True):
        angle = f"{name.upper()} {value:.{digits}f} {unit}"
        words.append(f"{name} {value:.6f}" if name.startswith("q") else angle)
    return ", ".join(words)


def _plain(line: str) -> str:
    """A line with ASCII digits, signs and blanks."""

    def plain(letter: str) -> str:
        if letter.isascii():
            return letter
        if "\N{FULLWIDTH EXCLAMATION MARK}" <= letter <= "\N{FULLWIDTH TILDE}":
            return chr(ord(letter) - 0xFEE0)
        if letter.isspace():
            return " "
        digit = unicodedata.decimal(letter, None)
        return letter if digit is None else str(digit)

    return "".join(map(plain, line.translate(_SIGNS)))


def _written(line: str) -> _PendantNumbers | None:
    plain = _plain(line)
    return _marked(plain) or _named(plain) or _bare(plain)


def _marked(line: str) -> _PendantNumbers | None:
    for form, pattern in _MARKED:
        matches = pattern.findall(line)
        # Two poses in a line are ambiguous.
        if len(matches) == 1:
            found = _numbers(matches[0].strip(), (form,))
            # A position and a quaternion are seven.
            if found is not None and len(found.numbers) > 7 and "." not in matches[0]:
                doubt = "its decimals are behind commas, which separate the numbers, too"
                return replace(found, doubt=doubt)
            return found
    return None


def _numbers(text: str, forms: tuple[str, ...]) -> _PendantNumbers | None:
    words = [part for part in _BETWEEN.split(text) if part]
    if not all(re.fullmatch(DECIMAL, word) for word in words):
        return None
    return _PendantNumbers(tuple(map(float, words)), forms)


def _named(line: str) -> _PendantNumbers | None:
    entries = [(match[1].lower(), match[2], match[3]) for match in _NAMED.finditer(line)]
    entry_names = [name for name, _, _ in entries]
    for names in _NAMED_ROTATIONS:
        needed = ("x", "y", "z", *names)
        # Two poses in a line are ambiguous.
        if any(entry_names.count(name) != 1 for name in needed):
            continue
        cells = {name: (number, unit) for name, number, unit in entries}
        lengths = {cells[name][1] for name in "xyz"} - {None}
        angles = {cells[name][1] for name in names} - {None}
        # One unit for each, and of the right kind.
        if len(lengths) > 1 or len(angles) > 1 or lengths - {"m", "mm"} or angles & {"m", "mm"}:
            return None
        forms = [POSE_FORMS[name] for name in forms_named(names)]
        meant = [form for form in forms if form.likely or tuple(form.also.split()) == names]
        # Of the manufacturers with Rx, Ry, Rz Universal Robots uses radians.
        radians = [form for form in meant if angles == {"rad"} and form.rotation[-4:] != "-deg"]
        likely = tuple(form.name for form in radians or meant)
        length, angle = (next(iter(found), "") for found in (lengths, angles))
        words = [cells[name][0] for name in needed]
        values = _values(words)
        found = _PendantNumbers(values or (), likely, length, angle, names=names)
        if values is None:
            return replace(found, doubt="it has decimal commas and decimal points")
        with_commas = [word for word in words if "," in word]
        # No angle has thousands.
        grouped = [word for word in words[:3] if _THOUSANDS.fullmatch(word)]
        if with_commas and with_commas == grouped:
            doubt = f"the comma of {with_commas[0]} may be decimal, or group thousands"
            return replace(found, doubt=doubt)
        return found
    return None


def _values(words: list[str]) -> tuple[float, ...] | None:
    """Numbers with one kind of decimal sign; None where they are none, or have both."""
    with_commas = [word for word in words if re.fullmatch(DECIMAL_COMMA, word)]
    others = [word for word in words if word not in with_commas]
    if not all(re.fullmatch(DECIMAL, word) for word in others):
        return None
    if with_commas and any("." in word for word in others):
        return None
    return tuple(float(word.replace(",", ".")) for word in words)


def _bare(line: str) -> _PendantNumbers | None:
    words = [word for word in _BETWEEN_COMMAS.split(line) if word]
    found, values = _numbers(line, ()), _values(words)
    count = 0 if found is None else len(found.numbers)
    if _INNER_COMMA.search(line):
        # Lists without blanks have points, unless all is whole.
        is_list = values is None and "." in line and not any(map(_THOUSANDS.fullmatch, words))
        if count in _BARE_FORMS and not is_list:
            doubt = f"the commas of {line.strip()[:40]!r} may be decimal, or separate numbers"
            return _PendantNumbers((), _BARE_FORMS[count], doubt=doubt)
        if values is not None:
            found, count = _PendantNumbers(values, ()), len(values)
    if found is None or count not in _BARE_FORMS:
        return None
    if count == 16:
        columns = np.reshape(found.numbers, (4, 4))
        if (columns[:, 3] != (0.0, 0.0, 0.0, 1.0)).any():
            return None
        pose = (*columns[3, :3].tolist(), *columns[:3, :3].ravel().tolist())
        found = _PendantNumbers(pose, ())
    return replace(found, forms=_BARE_FORMS[count])


def _form(written: _PendantNumbers, stated: str | None, where: str) -> str:
    if stated is None and len(written.forms) == 1:
        return written.forms[0]
    # Bare numbers may be of any form that the user states and that has as many.
    is_bare = written.forms in _BARE_FORMS.values()
    count = len(written.numbers) - 3
    is_bare &= stated in POSE_FORMS and len(POSE_FORMS[stated or ""].names.split()) == count
    fits = is_bare or stated in (*written.forms, *forms_named(written.names))
    if stated is not None and stated in POSE_FORMS and fits:
        return stated
    makers = ", ".join(written.forms)
    said = "" if stated is None else f", not of {stated!r}"
    raise DataError(
        f"{where}: it is written as a pose of {makers}{said}, but must have one form.",
        culprits=[where],
        next_step=f"Say which of them it is; the forms are {', '.join(POSE_FORMS)}.",
    )
