"""Runs the programs that are written for a UR's controller, as far as they move joints.

URScript is so near to Python that its lines need little: `end` closes what indentation closes here.
A list is copied where it is assigned.
"""

import math
import re

import numpy as np

STEP_S = 0.002


def driven(text: str, step_s: float = STEP_S) -> tuple[np.ndarray, np.ndarray]:
    """Runs a program: (6,) where it begins, and (m, 6) where it sends the joints, step by step."""
    started: list[list[float]] = []
    sent: list[list[float]] = []

    def movej(q, **_):
        started.append(list(q))

    def servoj(q, a, v, t, lookahead, gain):
        # The arguments that a controller takes (URScript manual, servoj).
        assert (a, v) == (0, 0)
        assert t == step_s
        assert 0.03 <= lookahead <= 0.2
        assert 100 <= gain <= 2000
        sent.append(list(q))

    scope = {
        "sin": math.sin,
        "cos": math.cos,
        "get_steptime": lambda: step_s,
        "movej": movej,
        "servoj": servoj,
        "sleep": lambda _: None,
        "stopj": lambda _: None,
    }
    exec(as_python(text), scope)
    assert len(started) == 1
    return np.array(started[0]), np.array(sent)


def as_python(text: str) -> str:
    """The same program in Python."""
    text.encode("ascii")
    lines, opened = [], 0
    for line in text.splitlines():
        word = line.strip()
        if word == "end":
            opened -= 1
            continue
        if not word.startswith("#") and word.endswith(":"):
            opened += 1
        lines.append(re.sub(r"= start$", "= list(start)", line))
    assert opened == 0
    return "\n".join(lines)
