"""Follows what messages advise to its end, as a user would who does as is printed, word for word.

A command is run, what it prints is done (commands, edits of session.toml, of a board's `.toml` and
of views.csv, options to add), and it is run again, until nothing is left that can be done without
a person who looks, measures or records.
"""

import math
import re
import shlex
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import tomli_w
from support.commands import Done, every_command, visioncal
from support.edited import edit_rows

from visioncal.present import viewer
from visioncal.results import Calibration

Run = Callable[..., Done]

# What a message has where a user's own word belongs.
_PLACEHOLDER = re.compile(r"(?<![\w/-])(SESSION|FIXED|OUT|NEW|AGAIN|NAME|FILE|FOLDER)(?![\w-])")
# A command within a sentence ends it, or a part of it.
_WITHIN = re.compile(r": (visioncal [a-z].*?)(?:; |\.?$)")
_VALUE = r'"[^"]*"|\[[^]=]*\]|[-+]?\d+(?:\.\d+)?(?:e-?\d+)?|true|false'
# An entry of a file, and where it is: there, or where the sentence begins.
_PLACE = r"(?: in ((?:the \w+'s )?[\w./-]*\.toml|that file))?"
_PAIR = rf"[a-z]\w*(?:\.\w+)* = (?:{_VALUE}){_PLACE.replace('((', '(?:(')}"
_WRITE = re.compile(rf"(?:[Ww]rite|[Aa]dd|[Ss]tate|[Gg]ive|[Pp]ut) ((?:{_PAIR}(?:,? and |, )?)+)")
_ONE = re.compile(rf"([a-z]\w*(?:\.\w+)*) = ({_VALUE}){_PLACE}")
_FIELD = r"(?:matrix|distortion|resolution|\[[\w.]+\])"
_DELETE = re.compile(rf"delete ({_FIELD}(?:(?:, | and ){_FIELD})*)")
_INSTEAD = re.compile(r"[Ii]n views\.csv, write (\S+) for (\S+), and the others alike")
_ROWS = re.compile(r"delete the rows? of views? (\d+(?:(?:, | and )\d+)*)")
_LINE = re.compile(r"delete ([\w./-]+), line (\d+)")
_COLUMNS = r"(\w+_\w+(?:(?: to |, | and )\w+_\w+)*)"
_SCALE = re.compile(rf"([Mm]ultiply|[Dd]ivide) {_COLUMNS} by (pi / 180|180 / pi|\d+(?:\.\d+)?)")
_NEGATE = re.compile(rf"[Nn]egate {_COLUMNS}")
# Options that are to be added, or replace those that were typed.
_OPTION = re.compile(r"(--[a-z][a-z-]+)((?: [a-z\d][\w.+-]*(?:,[\w.+-]+)*)?)")
_SAY = re.compile(rf"(?:[Ss]ay|[Gg]ive|[Ww]ith|[Aa]dd) ((?:{_OPTION.pattern} ?)+)")
_MEANT = re.compile(r"'([^']+)'.*Did you mean ([\w./-]+)")
_FOLDER = re.compile(r"Name the session's folder: (\S+)$", re.MULTILINE)
_FOR = re.compile(r"Write (\w+) for (\w+)\.")
# Keys of session.toml that stand in a table of their own where none of the name is there.
_TABLES = {"resolution": "camera", "matrix": "camera", "distortion": "camera", "model": "robot"}
# Commands that show or propose something, and leave the input as it is: a person goes on.
_LOOKS = ("show", "plan", "export", "locate", "diff", "history", "correct", "dynamics")
# Commands that judge: after one of these, its advice is the next.
_JUDGES = ("calibrate", "verify", "doctor")
# What a message that is repeated may number otherwise.
_NUMBERED = re.compile(r"(-fixed|-new|\bout)(-?\d+)?\b")


@dataclass(frozen=True)
class Advice:
    """One piece of advice: what is to be edited, and the command to type after that."""

    words: str
    command: str = ""

    @property
    def key(self) -> str:
        """The same for the same advice, whatever its figures, and copies and outputs are called."""
        text = _NUMBERED.sub(r"\1", f"{self.words} {self.command}").replace("-fixed", "")
        return re.sub(r"\d+\.\d+", "#", text)

    @property
    def calls(self) -> list[list[str]]:
        """The words of its commands."""
        return [shlex.split(part)[1:] for part in self.command.split(" && ")] * bool(self.command)

    @property
    def changes(self) -> bool:
        """Whether what is judged afterwards is another input, or judged otherwise."""
        return self.is_edit or any(call[0] not in _LOOKS for call in self.calls)

    @property
    def is_edit(self) -> bool:
        """Whether something is to be edited by hand."""
        found = (_WRITE, _DELETE, _ROWS, _INSTEAD, _LINE, _SCALE, _NEGATE)
        return any(pattern.search(self.words) for pattern in found)


@dataclass(frozen=True)
class Followed:
    """What was run and said, and what was done about it."""

    runs: tuple[Done, ...]
    done: tuple[str, ...]
    words: tuple[str, ...]  # Of the command that was run last.

    @property
    def last(self) -> Done:
        """How it ended."""
        return self.runs[-1]


def printed_advice(said: str) -> Iterator[Advice]:
    """The advice of a message, in its order: commands stand under their sentence, or end it."""
    lines = [re.sub(r"^(\d+\.|-)\s+", "", line.strip()) for line in said.splitlines()]
    for line, below in zip(lines, [*lines[1:], ""], strict=True):
        if line.startswith("visioncal "):
            continue
        within = _WITHIN.search(line)
        command = below if below.startswith("visioncal ") else within[1] if within else ""
        if within and _PLACEHOLDER.search(command):
            command = ""
        advice = Advice(line, command)
        if advice.command or advice.is_edit:
            yield advice


def printed_commands(said: str) -> tuple[str, ...]:
    """The commands of a message, each once."""
    return tuple(dict.fromkeys(item.command for item in printed_advice(said) if item.command))


def follow(*words: object, steps: int = 6, run: Run = visioncal) -> Followed:
    """Runs a command and does what it advises, again and again.

    Args:
        *words: The command, without `visioncal`.
        steps: The most times that it is to be run again.
        run: Runs a command.

    Raises:
        AssertionError: Advice comes again after it was followed, or cannot be followed: its command
            does not run, what it edits is not there or is so already; or it does not end.
    """
    current = tuple(map(str, words))
    runs, done, looked = [_called(run, current)], list[str](), set[str]()
    while True:
        trail = _Trail(current, runs, done)
        assert runs[-1].status in (0, 2, 3), trail.story("it ends otherwise")
        found = next(_next(runs[-1], current, looked, run, trail), None)
        if found is None:
            return Followed(tuple(runs), tuple(done), current)
        assert found.key not in {item.partition("\n")[0] for item in done}, trail.story(
            f"advice comes again: {found.words} {found.command}"
        )
        assert len(done) < steps, trail.story(f"it does not end in {steps} steps")
        done.append(f"{found.key}\n{found.words}")
        current, ended = _do(found, current, run, trail)
        runs.append(ended or _called(run, current))


def judged(folder: str) -> tuple[Followed, list[Calibration]]:
    """Calibrates a session as `follow` does: what was done, and each result on the way.

    A calibration that is refused has none.
    """
    found = list[Calibration]()

    def run(*words: object) -> Done:
        done = visioncal(*words)
        if words[0] == "calibrate" and done.status != 2:
            found.append(Calibration.load(str(words[words.index("-o") + 1])))
        return done

    return follow("calibrate", folder, "-o", "out", run=run), found


@dataclass(frozen=True)
class _Trail:
    current: tuple[str, ...]
    runs: list[Done]
    done: list[str]

    def story(self, why: str) -> str:
        """What happened, for a failed test."""
        steps = [f"-> {item}" for item in self.done]
        steps += [""] * (len(self.runs) - len(steps))
        lines = [
            line for run, step in zip(self.runs, steps, strict=False) for line in (run.said, step)
        ]
        return "\n".join([f"{shlex.join(self.current)}: {why}", *lines])


def _called(run: Run, words: Sequence[str]) -> Done:
    # A window would stay until somebody closes it.
    with patch.object(viewer, "review_native"):
        return run(*words)


def _next(
    said: Done, current: tuple[str, ...], looked: set[str], run: Run, trail: _Trail
) -> Iterator[Advice]:
    """The advice that changes something; the commands that show something must run."""
    for item in printed_advice(said.said):
        assert not _PLACEHOLDER.search(item.command), trail.story(f"a placeholder: {item.command}")
        # What was typed before is to be typed again after a person's work.
        is_again = not item.is_edit and all(_bare(call) == _bare(current) for call in item.calls)
        if item.changes and not is_again:
            yield item
        elif item.key not in looked:
            looked.add(item.key)
            for call in item.calls:
                ended = _called(run, call)
                assert ended.status == 0, trail.story(f"{item.command}: {ended.said}")
    if said.status == 2:
        last = said.err.strip().splitlines()[-1]
        if _FOLDER.search(last) or _FOR.search(last):
            yield Advice(last)
        if (option := _options(last, current)) or _MEANT.search(said.err.replace("\n", " ")):
            yield Advice(last if option else said.err.replace("\n", " "))


def _bare(words: Sequence[str]) -> list[str]:
    return [word for word in words if word != "--force"]


def _do(
    advice: Advice, current: tuple[str, ...], run: Run, trail: _Trail
) -> tuple[tuple[str, ...], Done | None]:
    """Does what is advised: the command that is judged next, and how it ended where it was run."""
    ended = None
    for call in advice.calls:
        last = call
        ended = _called(run, call)
        allowed = (0, 2, 3) if call[0] in (*_JUDGES, current[0]) else (0,)
        if call[0] == "convert" and ended.status == 2:
            # It asks for what no file states; the rest of the line would not be run.
            return tuple(call), ended
        assert ended.status in allowed, trail.story(
            f"{advice.command}: {ended.status} {ended.said}"
        )
    is_judged = ended is not None and last[0] in (*_JUDGES, current[0])
    edited = advice.is_edit and _edit(advice.words, _folder(current), trail)
    if edited or not is_judged:
        if not (advice.calls or edited) or "which this makes" in advice.words:
            current = _typed(advice.words, current, trail)
        return current, None
    return tuple(last), ended


def _folder(words: Sequence[str]) -> Path:
    return next((Path(word) for word in words if Path(word, "session.toml").is_file()), Path())


def _edit(said: str, folder: Path, trail: _Trail) -> bool:
    """Edits the files as a sentence says; the first of two that it names as alternatives."""
    said = said.split(" Or: ")[0]
    for match in _WRITE.finditer(said):
        place = "".join(
            re.findall(r"[Ii]n ((?:the \w+'s )?[\w./-]*\.toml),", said[: match.start()])[-1:]
        )
        entries = _ONE.findall(match[1])
        # A place stands behind the last of its entries.
        for at, (key, value, _) in enumerate(entries):
            place = next((entry_place for _, _, entry_place in entries[at:] if entry_place), place)
            _write(place, key, tomllib.loads(f"v = {value}")["v"], folder, trail)
    for match in _DELETE.finditer(said):
        for name in re.split(r", | and ", match[1]):
            _change(folder / "session.toml", lambda it, name=name: _without(it, name), trail)
    if rows := _ROWS.search(said):
        gone = set(re.findall(r"\d+", rows[1]))
        _change_rows(folder, lambda all_: [row for row in all_ if row["view"] not in gone], trail)
    if instead := _INSTEAD.search(said):
        new, old = map(Path, instead.groups())
        _change_rows(folder, lambda all_: [_renamed(row, old, new) for row in all_], trail)
    if line := _LINE.search(said):
        text = (folder / line[1]).read_text("utf-8").splitlines(keepends=True)
        del text[int(line[2]) - 1]
        (folder / line[1]).write_text("".join(text), "utf-8")
    if scale := _SCALE.search(said):
        factor = {"pi / 180": math.pi / 180, "180 / pi": 180 / math.pi}.get(scale[3])
        factor = float(scale[3]) if factor is None else factor
        _scale(folder, scale[2], 1 / factor if scale[1].lower() == "divide" else factor, trail)
    if negated := _NEGATE.search(said):
        _scale(folder, negated[1], -1.0, trail)
    return True


def _write(place: str, key: str, value: object, folder: Path, trail: _Trail) -> None:
    session = folder / "session.toml"
    if place in ("", "session.toml"):
        _change(session, lambda it: _with(it, key, value), trail)
        return
    board = str(tomllib.loads(session.read_text("utf-8"))["target"])
    named = place if place.endswith(".toml") and "'" not in place else board
    assert named.endswith(".toml"), trail.story(f"{named} is no file of the user's")
    _change(folder / named, lambda it: _with(it, key, value), trail)


def _change(path: Path, change: Callable[[dict[str, Any]], object], trail: _Trail) -> None:
    document = tomllib.loads(path.read_text("utf-8"))
    before = tomli_w.dumps(document)
    change(document)
    after = tomli_w.dumps(document)
    assert after != before, trail.story(f"{path} is so already")
    path.write_text(after, "utf-8")


def _with(document: dict[str, Any], key: str, value: object) -> None:
    holders = [document, *(part for part in document.values() if isinstance(part, dict))]
    holder = next((part for part in holders if key in part), None)
    if holder is None:
        holder = document.setdefault(_TABLES[key], {}) if key in _TABLES else document
    holder[key] = value


def _without(document: dict[str, Any], name: str) -> None:
    for part in [document, *(part for part in document.values() if isinstance(part, dict))]:
        if part.pop(name.strip("[]"), None) is not None:
            return


def _renamed(row: dict[str, str], old: Path, new: Path) -> dict[str, str]:
    """A row whose image has another folder and ending, as that of an example."""
    image = Path(row["image"])
    assert (image.parent, image.suffix) == (old.parent, old.suffix)
    return row | {"image": (new.parent / image.name).with_suffix(new.suffix).as_posix()}


def _change_rows(folder: Path, change: Callable[..., Any], trail: _Trail) -> None:
    before = (folder / "views.csv").read_bytes()

    def changed(rows: list[dict[str, str]]) -> list[dict[str, str]]:
        rows = change(rows)
        assert rows, trail.story("it deletes all rows")
        return rows

    edit_rows(folder, changed)
    assert (folder / "views.csv").read_bytes() != before, trail.story("no such rows or columns")


def _scale(folder: Path, columns: str, factor: float, trail: _Trail) -> None:
    def changed(rows: list[dict[str, str]]) -> list[dict[str, str]]:
        names = [*rows[0]]
        ends = [part.split(" to ") for part in re.split(r", | and ", columns)]
        picked = [
            name
            for first, *last in ends
            for name in names[names.index(first) : names.index((last or [first])[0]) + 1]
        ]
        return [
            row | {name: repr(factor * float(row[name])) for name in picked if row[name]}
            for row in rows
        ]

    _change_rows(folder, changed, trail)


def _options(said: str, current: Sequence[str]) -> dict[str, str]:
    """Options that are to be given, with their values; none that takes what is refused."""
    known = {
        name: param
        for words, command in every_command()
        if list(current[: len(words.split())]) == words.split()
        for param in command.params
        for name in param.opts
    }
    for phrase in _SAY.finditer(said):
        given = _OPTION.findall(phrase[1])
        if all(name in known and bool(value) != known[name].is_flag for name, value in given):
            return {name: value.strip() for name, value in given if name != "--force"}
    return {}


def _typed(said: str, current: tuple[str, ...], trail: _Trail) -> tuple[str, ...]:
    """The command with options added or changed, or a word corrected; there or in session.toml."""
    if options := _options(said, current):
        typed = list(current)
        for name, value in options.items():
            if name in typed:
                typed[typed.index(name) + 1] = value
            else:
                typed += [name, value] if value else [name]
        assert tuple(typed) != current, trail.story(f"{options} was given already")
        return tuple(typed)
    if folder := _FOLDER.search(said):
        first = next(at for at, word in enumerate(current[1:], 1) if not word.startswith("-"))
        return (*current[:first], folder[1], *current[first + 1 :])
    meant, other = _MEANT.search(said), _FOR.search(said)
    assert meant or other, trail.story("nothing is to be done")
    wrong, right = (meant[1], meant[2].rstrip("?.,")) if meant else (other[2], other[1])
    if wrong in current:
        return tuple(right if word == wrong else word for word in current)
    path = _folder(current) / "session.toml"
    text = path.read_text("utf-8")
    assert wrong in text, trail.story(f"{wrong} is nowhere")
    path.write_text(text.replace(wrong, right), "utf-8")
    return current
