"""KRL of KUKA: PTP, LIN, SPTP and SLIN of a .src, with the points of its .dat.

KUKA, "Operating and Programming Instructions for System Integrators" (KSS 8.3): frames are X, Y, Z
[mm], A, B, C [deg]; bit k of T is the sign of axis k + 1. Inline forms name tool and base in FDAT.
"""

import re
from collections.abc import Mapping
from typing import TypeAlias

import numpy as np

from visioncal.core.conventions import Reading
from visioncal.interchange.programs.program import (
    NUMBER,
    Dialect,
    Found,
    Frame,
    Frames,
    Literal,
    pose_of,
)

_POSE, _JOINTS = ("X", "Y", "Z", "A", "B", "C"), ("A1", "A2", "A3", "A4", "A5", "A6")
_READING = Reading("euler-ZYX-deg", "mm")
_NAME = r"\$?[A-Za-z_]\w*(?:\[\d+\])?"
_RECORD = re.compile(rf"(?:^|\s)({_NAME})\s*=\s*(\{{[^}}]*\}})", re.MULTILINE)
_FIELD = re.compile(rf"([A-Za-z_]\w*)\s+('B[01]+'|{NUMBER.pattern})")
_FRAME = re.compile(r"\$(TOOL|BASE)\s*=\s*(.*)|BAS\s*\(\s*#(TOOL|BASE)\s*,\s*(\d+)", re.IGNORECASE)
_MOTION = re.compile(rf"(S?PTP|S?LIN)\s+((\{{|{_NAME}(?=\s*$|\s+\w))?.*)", re.IGNORECASE)
_OTHER = re.compile(r"(S?PTP_REL|S?LIN_REL|S?CIRC(?:_REL)?|SPL(?:_REL)?)\b", re.IGNORECASE)
# Fields of a record by name: the number's text, and its place.
_Fields: TypeAlias = dict[str, tuple[str, tuple[int, int]]]


def _fields(text: str, start: int, end: int) -> _Fields:
    found = _FIELD.finditer(text, start, end)
    return {each[1].upper(): (each[2], each.span(2)) for each in found}


def _literal(file: str, name: str, fields: _Fields) -> Literal | None:
    """A complete pose or all axes; None for a record that names only some."""
    keys = _POSE if all(key in fields for key in _POSE) else _JOINTS
    if not all(key in fields for key in keys):
        return None
    spans = tuple(fields[key][1] for key in keys)
    values = tuple(float(fields[key][0]) for key in keys)
    posture: tuple[float, ...] = ()
    if keys is _POSE and "T" in fields:
        word = fields["T"][0]
        bits = int(word[2:-1], 2) if word.startswith("'") else int(float(word))
        # In the middle of each half turn.
        posture = tuple((-0.5 if bits >> axis & 1 else 0.5) * np.pi for axis in range(6))
    return Literal(file, name, spans, values, keys is _JOINTS, posture)


class _Reader:
    """State of a program, statement by statement."""

    def __init__(self, code: Mapping[str, str], frames: Frames) -> None:
        self.found, self._frames = Found(), frames
        lists = {name: text for name, text in code.items() if name.lower().endswith(".dat")}
        self.records = {
            each[1].upper(): (name, _fields(text, *each.span(2)))
            for name, text in lists.items()
            for each in _RECORD.finditer(text)
        }
        # Assigned values are calculated when a program runs.
        assigning = rf"^[ \t]*({_NAME})(?:\.\w+)?\s*="
        self.assigned = {
            name.upper()
            for label, text in code.items()
            if label not in lists
            for name in re.findall(assigning, text, re.MULTILINE)
        }
        for name, text in code.items():
            if name not in lists:
                self.state: dict[str, Frame] = {
                    kind: f"the {kind} (no ${kind.upper()} is set before)"
                    for kind in ("tool", "base")
                }
                for number, each in enumerate(re.finditer(r"([^\r\n]*)(?:\r\n|\r|\n|$)", text), 1):
                    start = each.start() + len(each[1]) - len(each[1].lstrip())
                    fields = _fields(text, *each.span(1))
                    self._step(name, f"{name}, line {number}", text[start : each.end(1)], fields)

    def _frame(self, kind: str, words: str, fields: _Fields) -> Frame:
        words = re.sub(r"\s", "", words).upper()
        if words == "$NULLFRAME" or words == f"{kind.upper()}_DATA[0]":
            return np.eye(4)
        if words in self.records and words not in self.assigned:
            fields = self.records[words][1]
        literal = _literal("", "", fields)
        if literal is not None and not literal.are_joints:
            return pose_of(literal.values, _READING)
        known = self._frames(f"{kind} {words}")
        return f"{kind} {words}" if known is None else known

    def _step(self, file: str, place: str, words: str, fields: _Fields) -> None:
        if frame := _FRAME.match(words):
            kind = (frame[1] or frame[3]).lower()
            data = frame[2] or f"{kind}_DATA[{frame[4]}]"
            self.state[kind] = self._frame(kind, data, fields)
        elif form := re.match(r"FDAT_ACT\s*=\s*(\w+)", words, re.IGNORECASE):
            numbers = self.records.get(form[1].upper(), ("", {}))[1]
            for kind in self.state:
                number = numbers.get(f"{kind.upper()}_NO", ("?",))[0]
                self.state[kind] = self._frame(kind, f"{kind}_DATA[{number}]", {})
        elif other := _OTHER.match(words):
            why = "relative" if "REL" in other[1].upper() else "neither linear nor of joints"
            self.found.left.append(f"{place}: {other[1]} is {why}")
        elif motion := _MOTION.match(words):
            literal = self._target(file, f"{place} ({motion[1]})", motion[3] or "", fields)
            if literal is None:
                why = "is calculated, relative, or stands in another file"
                self.found.left.append(f"{place}: {motion[2].strip()[:40]} {why}")
            else:
                self.found.add(place, literal, self.state["base"], self.state["tool"])

    def _target(self, file: str, place: str, target: str, fields: _Fields) -> Literal | None:
        if target.startswith("{"):
            return _literal(file, place, fields)
        name = target.upper()
        if name in self.assigned or name not in self.records:
            return None
        return _literal(self.records[name][0], target, self.records[name][1])


KRL = Dialect(
    "KRL",
    (".src",),
    ".dat",
    r";[^\r\n]*|\"[^\"\r\n]*\"",
    lambda code, frames: _Reader(code, frames).found,
    _READING,
    np.pi / 180,
    (3, 4),
)
