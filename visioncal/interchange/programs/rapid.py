"""RAPID of ABB: MoveL, MoveJ, MoveAbsJ and their kin, to declared or inline targets.

ABB, "RAPID Instructions, Functions and Data types": robtarget is [[x, y, z], [q1, q2, q3, q4],
[cf1, cf4, cf6, cfx], [axes]] in mm, cf the quarter turn of an axis; jointtarget in degrees.
"""

import re

import numpy as np

from visioncal.core.conventions import Reading
from visioncal.core.types import FloatArray
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

_READING = Reading("quaternion-wxyz", "mm")
_DECLARED = re.compile(
    r"\b(?:CONST|PERS|VAR)\s+(robtarget|jointtarget|tooldata|wobjdata)\s+(\w+)\s*:=\s*"
    r"(\[[^;]*\])\s*;",
    re.IGNORECASE,
)
_MOTION = re.compile(r"\b((?:Move|Arc|Trigg|Search)[LJC]\w*|MoveAbsJ)\b([^;]*);", re.IGNORECASE)
_LINEAR = re.compile(r"(Move[LJ](DO|AO|GO|Sync)?|MoveAbsJ|ArcL\w*|Trigg[LJ])$", re.IGNORECASE)
_OPTION = re.compile(r"\\\s*\w+(\s*:=\s*[\w.{}]+)?\s*,?")
_RELATIVE = re.compile(r"(Offs|RelTool)\s*\(\s*(\w+)", re.IGNORECASE)


def _literal(file: str, name: str, text: str, start: int, end: int, *, joints: bool) -> Literal:
    spans = number_spans(text, start, end)
    values = numbers_at(text, spans)
    if joints:
        return Literal(file, name, spans[:6], values[:6], are_joints=True)
    posture: tuple[float, ...] = ()
    if len(values) >= 11:
        first, fourth, sixth = (0.5 * np.pi * (quarter + 0.5) for quarter in values[7:10])
        posture = (first, np.nan, np.nan, fourth, np.nan, sixth)
    return Literal(file, name, spans[:7], values[:7], posture=posture)


def _arguments(words: str) -> list[str]:
    """Positional arguments, without options."""
    words, parts, depth = _OPTION.sub(lambda found: "," * found[0].endswith(","), words), [""], 0
    for letter in words:
        depth += {"(": 1, "[": 1, ")": -1, "]": -1}.get(letter, 0)
        parts = [*parts, ""] if letter == "," and not depth else [*parts[:-1], parts[-1] + letter]
    return [part.strip() for part in parts if part.strip()]


class _Reader:
    """Declarations and motions of one module."""

    def __init__(self, name: str, text: str, frames: Frames, found: Found) -> None:
        self._name, self._text, self._frames, self._found = name, text, frames, found
        self.targets, self.known = dict[str, Literal](), dict[str, FloatArray]()
        declared = [each[2].lower() for each in _DECLARED.finditer(text)]
        assigned = re.findall(r"^[ \t]*(\w+)(?:\.[\w.]+)?\s*:=", text, re.MULTILINE)
        changed = {label.lower() for label in assigned}
        changed |= {label for label in declared if declared.count(label) > 1}
        for each in _DECLARED.finditer(text):
            if each[2].lower() not in changed:
                self._declare(each)
        for each in _MOTION.finditer(text):
            self._move(each, f"{name}, line {line_of(text, each.start())}")

    def _declare(self, each: re.Match[str]) -> None:
        kind, label, span = each[1].lower(), each[2].lower(), each.span(3)
        if kind in ("robtarget", "jointtarget"):
            joints = kind == "jointtarget"
            self.targets[label] = _literal(self._name, each[2], self._text, *span, joints=joints)
            return
        values = numbers_at(self._text, number_spans(self._text, *span))
        flags = [flag.upper() for flag in re.findall(r"TRUE|FALSE", each[3], re.IGNORECASE)]
        if kind == "tooldata" and flags == ["TRUE"]:
            self.known[f"tool {label}"] = pose_of(values[:7], _READING)
        elif kind == "wobjdata" and flags == ["FALSE", "TRUE"]:
            frames = (pose_of(values[at : at + 7], _READING) for at in (0, 7))
            self.known[f"base {label}"] = next(frames) @ next(frames)

    def _frame(self, kind: str, label: str) -> Frame:
        if label.lower() in ("tool0", "wobj0"):
            return np.eye(4)
        frame = self.known.get(f"{kind} {label.lower()}")
        frame = self._frames(f"{kind} {label}") if frame is None else frame
        return f"{kind} {label}" if frame is None else frame

    def _move(self, each: re.Match[str], place: str) -> None:
        arguments = _arguments(each[2])
        if not arguments or not _LINEAR.match(each[1]):
            self._found.left.append(f"{place}: {each[1]} is neither linear nor of joints")
            return
        target, literal = arguments[0], self.targets.get(arguments[0].lower())
        if target.startswith("["):
            start = each.start(2) + each[2].index("[")
            named, joints = f"{place} ({each[1]})", each[1].lower() == "moveabsj"
            end = start + len(target)
            literal = _literal(self._name, named, self._text, start, end, joints=joints)
        if literal is None:
            why = f"{target[:40]} is calculated, or declared elsewhere"
            if relative := _RELATIVE.match(target):
                moves = ", and moves along with it" * (relative[2].lower() in self.targets)
                why = f"{relative[1]} is relative to {relative[2]}{moves}"
            self._found.left.append(f"{place}: {why}")
            return
        wobj = re.search(r"\\\s*WObj\s*:=\s*(\w+)", each[2], re.IGNORECASE)
        base = self._frame("base", wobj[1] if wobj else "wobj0")
        self._found.add(place, literal, base, self._frame("tool", arguments[-1]))


RAPID = Dialect(
    "RAPID",
    (".mod", ".modx", ".prg", ".sys"),
    "",
    r"![^\r\n]*|\"[^\"\r\n]*\"",
    by_file(_Reader),
    _READING,
    np.pi / 180,
    (3, 7),
)
