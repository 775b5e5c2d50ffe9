"""URScript: movej, movel and movep to poses, joint positions, and what PolyScope writes of them.

Universal Robots, "The URScript Programming Language": p[x, y, z, rx, ry, rz] in m and rad, in the
base, of the tool that set_tcp states.
"""

import re
from dataclasses import replace

import numpy as np

from visioncal.core.conventions import Reading
from visioncal.interchange.programs.program import (
    Dialect,
    Found,
    Frame,
    Frames,
    Literal,
    by_file,
    line_of,
    number_spans,
    numbers_at,
    pose_of,
)

_READING = Reading("rotation-vector", "m")
_LIST = r"p?\[[^\]\[]*\]"
_STEP = re.compile(
    rf"\b(set_tcp|move[jlpc])\s*\(|(?:^|[;:]|\bglobal|\blocal)[ \t]*(\w+)[ \t]*=[ \t]*({_LIST})?",
    re.MULTILINE,
)
_INVERSE = re.compile(r"get_inverse_kin\(\s*(\w+)\s*,\s*(?:qnear\s*=\s*)?(\w+)\s*\)$")


def _argument(text: str, start: int) -> str:
    """The first argument from a place on."""
    depth = 0
    for end in range(start, len(text)):
        depth += {"(": 1, "[": 1, ")": -1, "]": -1}.get(text[end], 0)
        if depth < 0 or (text[end] == "," and not depth):
            return text[start:end]
    return text[start:]


def _literal(file: str, name: str, text: str, start: int, end: int) -> Literal | None:
    spans = number_spans(text, start, end)
    if len(spans) != 6:
        return None
    return Literal(file, name, spans, numbers_at(text, spans), are_joints=text[start] != "p")


class _Reader:
    """Steps of one script."""

    def __init__(self, name: str, text: str, frames: Frames, found: Found) -> None:
        self._name, self._text, self._found = name, text, found
        stated: dict[str, list[Literal | None]] = {}
        steps = [*_STEP.finditer(text)]
        for each in steps:
            if each[2]:
                literal = _literal(name, each[2], text, *each.span(3)) if each[3] else None
                stated.setdefault(each[2], []).append(literal)
        self._known = {label: every[0] for label, every in stated.items() if len(every) == 1}
        given = frames("tool")
        unsaid = "the tool (set_tcp is not in the program; --tool says it)"
        self._tool: Frame = unsaid if given is None else given
        for each in steps:
            if each[1]:
                self._step(each, f"{name}, line {line_of(text, each.start())}")

    def _target(self, words: str, start: int, place: str) -> Literal | None:
        inverse = _INVERSE.match(words)
        if re.fullmatch(_LIST, words):
            return _literal(self._name, place, self._text, start, start + len(words))
        if inverse is None:
            return self._known.get(words)
        pose, near = self._known.get(inverse[1]), self._known.get(inverse[2])
        if pose is None or near is None or not near.are_joints:
            return None
        return replace(pose, posture=near.values)

    def _step(self, each: re.Match[str], place: str) -> None:
        words = _argument(self._text, each.end())
        start = each.end() + len(words) - len(words.lstrip())
        words = words.strip()
        literal = self._target(words, start, f"{place} ({each[1]})")
        if each[1] == "set_tcp":
            self._tool = "the tool (of a calculated set_tcp)"
            if literal is not None and not literal.are_joints:
                self._tool = pose_of(literal.values, _READING)
        elif each[1] == "movec":
            self._found.left.append(f"{place}: movec is neither linear nor of joints")
        elif literal is None:
            relative = "relative" if re.match(r"pose_(add|trans)", words) else "calculated"
            self._found.left.append(f"{place}: {words[:40]} is {relative}")
        else:
            self._found.add(place, literal, np.eye(4), self._tool)


URSCRIPT = Dialect(
    "URScript",
    (".script", ".urscript"),
    "",
    r"#[^\r\n]*|\"[^\"\r\n]*\"",
    by_file(_Reader),
    _READING,
    1.0,
    (6, 6),
)
