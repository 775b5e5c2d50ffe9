"""Where advice to add views is given: which command proposes them."""

import re
from collections.abc import Sequence

# Advice to add stops or views of any kind; of the first, those that are about the arm.
_ADD = re.compile(r"\bAdd (?:stops|views|\d+ or more)\b")
_OR_MEASURED = re.compile(r".*Where the arm cannot tilt, (measure that offset for \S+)\..*")
_ARM = re.compile(r"\bAdd (?:stops|views in which the arm)\b")


def with_proposal(sentences: Sequence[str], *, modelled: bool) -> tuple[str, ...]:
    """Points to `visioncal plan` behind the first advice to add views; once is enough.

    Args:
        sentences: Advice, reasons of a verdict; changed is the first that asks for views.
        modelled: Whether the robot's model is known, without which no stop can be proposed.
    """
    for at, sentence in enumerate(sentences):
        if _ADD.search(sentence):
            pointed = f"{sentence} {_proposal(' '.join(sentences), modelled)}"
            return (*sentences[:at], pointed, *sentences[at + 1 :])
    return tuple(sentences)


def of_arm_that_cannot_tilt(advice: str) -> str:
    """The same advice without views that no such arm can reach, where a measured offset helps."""
    words = r"This arm cannot tilt: \1, as z_m and sigma_m in session.toml."
    return _OR_MEASURED.sub(words, advice)


def _proposal(words: str, modelled: bool) -> str:
    if not modelled:
        return (
            "Once [robot] model in session.toml names the arm, visioncal plan SESSION --add 5 "
            "proposes them."
        )
    purpose = " --for kinematics" if _ARM.search(words) else ""
    return f"Let visioncal plan SESSION --add 5{purpose} propose them."
