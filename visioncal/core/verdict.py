"""Verdicts: what was found, how likely it is the cause, what it costs, and what to do about it."""

import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal, Self, TypeAlias

import numpy as np

from visioncal.core.codec import DROPPED, UNWRITTEN
from visioncal.core.number_format import percent, ranges
from visioncal.core.shown import html_card

VerdictStatus: TypeAlias = Literal["good", "check", "bad"]

# So many findings are shown first, and so many steps; causes as likely as this are among them, and
# steps against causes as likely as the other.
_SHOWN, _LEAST_LIKELY, _LIKELY = 3, 0.05, 0.2
# Kinds of findings that are no doubts.
AGREEMENT, NEED, GOOD_FOR, NOTE = "agreement", "need", "good_for", "note"
# Images that are not there, or of another size than the camera's, and a few rows without either: no
# doubt about the rest, and said first.
MISSING, EMPTY_ROWS, OTHER_SIZE = "missing_images", "empty_rows", "image_size"
NOT_USABLE = (MISSING, EMPTY_ROWS, OTHER_SIZE)
# A part of the image in which no corner was seen: a hint where the task says what it needs.
EMPTY_IMAGE = "empty_image"
# Rows of poses that are exchanged come first among causes that are as good as certain.
EXCHANGED, ARM_ERRORS, UNEXPLAINED, _SURE = "exchanged_views", "arm_errors", "unexplained", 0.99
# What says how large errors are, the most important first.
_SIZES = (NEED, GOOD_FOR, UNEXPLAINED, "optimism", "weak_motion", "place", "workspace")


# No need is as small [mm]: what is left out of a result takes nothing from it.
LEAST_NEED_MM = 1e-3
_HEADLINES = {
    "good": "Good: ready to use",
    "check": "Check before use",
    "bad": "Bad: do not use",
}
# Kinds of findings about the sources of errors: how likely they are is their share, in their words.
SOURCES = ("calibration", "unmeasured_board", "robot_noise", "robot_noise_of_pick")
# Commands of steps.
CALIBRATE, PLAN = "visioncal calibrate SESSION -o OUT", "visioncal plan SESSION --add 5"
GUESS = "visioncal convert SESSION FIXED --guess --yes"
GUESS_AND_CALIBRATE = f"{GUESS} && {CALIBRATE.replace('SESSION', 'FIXED')}"
REVIEW = "visioncal review OUT"
CALIBRATE_ANEW = "visioncal calibrate SESSION -o NEW"
# Fewer views are too few for a calibration of their own.
_FEWEST_ALONE = 6
# The command line as it was typed, to which options are added.
AGAIN = "AGAIN"
_PATH = re.compile(r"\b(SESSION|FIXED|OUT|NEW|AGAIN)\b")


@dataclass(frozen=True)
class Remedy:
    """What to do about a finding.

    Attributes:
        words: A sentence in the imperative.
        command: A command line that does it or leads on; empty where there is none. SESSION, FIXED
            (a corrected copy of the session), OUT, NEW (beside OUT) and AGAIN (the command as it
            was typed) stand for what `with_paths` fills in.
    """

    words: str
    command: Annotated[str, DROPPED] = ""

    def __str__(self) -> str:
        is_shown = self.command and AGAIN not in self.command
        return f"{self.words} Run: {self.command}" if is_shown else self.words


def look_at(view: int) -> str:
    """The command that shows a view."""
    return f"{REVIEW} --view {view}"


def exchanging(first: int, second: int) -> str:
    """The command that calibrates with the images of two views exchanged."""
    fixed = CALIBRATE.replace("SESSION", "FIXED")
    return f"visioncal convert SESSION FIXED --exchange {first},{second} && {fixed}"


def or_alone(words: str, views: Sequence[int]) -> Remedy:
    """What to do, with the command that calibrates some views alone where they are enough."""
    are_enough = len(views) >= _FEWEST_ALONE
    return Remedy(words, f"{CALIBRATE_ANEW} --views {ranges(views)}" if are_enough else "")


READ_AGAIN = Remedy(
    "Write a copy of the session that is read so, and calibrate it.", GUESS_AND_CALIBRATE
)


@dataclass(frozen=True)
class Finding:
    """One thing that was found, worded once.

    Attributes:
        kind: What it is, as a short name that stays.
        words: The same in sentences, with its figures.
        do: What to do about it; None where that is nothing.
        views: The views that it is about.
        probability: How likely it is the cause of what is wrong; 0 for what is no cause.
        without_it: What the result would be without it, in a sentence.
        is_fatal: Whether it alone makes a result bad.
        until_mm: The need of a task from which on it is no doubt [mm]: zero where it says how large
            errors are, which any need says better than a limit; infinite where something is
            unexplained.
        mahalanobis_sq: The evidence for it, as the square of a standard normal variable; zero where
            the limit of the test that found it has to do.
        up_to_mm: A pick errs by no more because of it [mm]; infinite where that is not known.
    """

    kind: str
    words: str
    do: Remedy | None = None
    views: tuple[int, ...] = ()
    probability: Annotated[float, DROPPED] = 0.0
    without_it: Annotated[str, DROPPED] = ""
    is_fatal: Annotated[bool, UNWRITTEN] = field(default=False, compare=False)
    until_mm: Annotated[float, UNWRITTEN] = field(default=np.inf, compare=False)
    mahalanobis_sq: Annotated[float, UNWRITTEN] = field(default=0.0, compare=False)
    up_to_mm: Annotated[float, UNWRITTEN] = field(default=np.inf, compare=False)

    def of(self, name: str) -> Self:
        """The same finding with whom it is of, where there are several; empty names nobody."""
        if not name:
            return self
        return replace(self, words=f"{name}: {self.words[0].lower()}{self.words[1:]}")

    @property
    def reason(self) -> str:
        """What it is, and what to do about it."""
        return self.words if self.do is None else f"{self.words} {self.do}"


def remarks(sentences: Iterable[str], kind: str = "remark") -> tuple[Finding, ...]:
    """Findings that no test is behind."""
    return tuple(Finding(kind, sentence) for sentence in sentences)


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be trusted.

    Attributes:
        status: In one word.
        findings: Why: doubts, those that settle it first, what is needed and met, then notes.
        good_for_mm: The least need that it would be good for [mm]; None where something is
            unexplained, and it is good for none.
    """

    status: VerdictStatus
    findings: tuple[Finding, ...] = ()
    good_for_mm: float | None = None

    @classmethod
    def of(cls, status: VerdictStatus, *sentences: str) -> Self:
        """A verdict with sentences that no test is behind."""
        return cls(status, remarks(sentences))

    @classmethod
    def by(cls, doubts: Sequence[Finding], praise: Finding) -> Self:
        """`bad` with a doubt that settles it, `check` with others, else `good` with its praise."""
        if not doubts:
            return cls("good", (praise,))
        status: VerdictStatus = "bad" if any(doubt.is_fatal for doubt in doubts) else "check"
        return cls(status, tuple(sorted(doubts, key=lambda doubt: not doubt.is_fatal)))

    def noting(self, sentences: Iterable[str]) -> Self:
        """The same verdict with notes."""
        return replace(self, findings=(*self.findings, *remarks(sentences, NOTE)))

    def __repr__(self) -> str:
        return "\n  ".join([f"Verdict: {self.status}", *self.top])

    def _repr_html_(self) -> str:
        steps = (f"Next: {step}" for step in self.next_steps)
        return html_card(self.headline, {}, self.status, (*self.top, *steps))

    @property
    def headline(self) -> str:
        """The verdict in a few words."""
        return _HEADLINES[self.status]

    @property
    def reasons(self) -> tuple[str, ...]:
        """All findings in sentences, with what to do; what is most likely wrong stands first."""
        wrong = (cause for cause in self.causes[:1] if cause.kind not in SOURCES)
        distinct = {id(finding): finding for finding in (*wrong, *self.findings)}
        return tuple(finding.reason for finding in distinct.values())

    @property
    def causes(self) -> tuple[Finding, ...]:
        """What may be why it is not good, likeliest first."""
        found = (finding for finding in self.findings if finding.probability)

        def order(finding: Finding) -> tuple[float, int, float]:
            # Among what is as good as certain, rows that are exchanged mislead all the rest, and
            # errors of an arm, which are always there, come after what happened; so does what no
            # cause is known of.
            place = {EXCHANGED: -1, ARM_ERRORS: 1, UNEXPLAINED: 1}.get(finding.kind, 0)
            return -min(finding.probability, _SURE), place, -finding.probability

        return tuple(sorted(found, key=order))

    @property
    def ranked(self) -> tuple[Finding, ...]:
        """All findings as people read them: the likeliest cause, what it costs, then the rest."""
        causes = [cause for cause in self.causes if cause.probability >= _LEAST_LIKELY]
        costs = [finding for kind in _SIZES for finding in self.findings if finding.kind == kind]
        missing = [finding for finding in self.findings if finding.kind in NOT_USABLE]
        ordered = [*missing, *causes[:1], *costs[:1], *causes[1:], *self.findings]
        return tuple({id(finding): finding for finding in ordered}.values())

    @property
    def top(self) -> tuple[str, ...]:
        """What is read first, in sentences."""
        return tuple(map(self._line, self.ranked[:_SHOWN]))

    @property
    def rest(self) -> tuple[str, ...]:
        """All else, in sentences."""
        return tuple(map(self._line, self.ranked[_SHOWN:]))

    def _line(self, finding: Finding) -> str:
        likely = f"({percent(finding.probability)})"
        how = "Most likely" if finding in self.causes[:1] else "Possibly"
        is_likely = finding.probability >= _LEAST_LIKELY and finding.kind not in SOURCES
        begin = f"{how} {likely}: " if is_likely else ""
        return f"{begin}{finding.words} {finding.without_it}".strip()

    @property
    def next_steps(self) -> tuple[Remedy, ...]:
        """What to do about the findings, in their order; each once."""
        unlikely = [cause for cause in self.causes[1:] if cause.probability < _LIKELY]
        steps: dict[str, Remedy] = {}
        for finding in self.ranked:
            if finding.do is not None and finding not in unlikely:
                steps.setdefault(finding.do.command or finding.do.words, finding.do)
        return tuple(steps.values())[:_SHOWN]

    def with_paths(
        self, session: Path | str, out: Path | str = "", again: Sequence[str] = ()
    ) -> Self:
        """Fills the paths of a run into the commands of its steps.

        Args:
            session: The session's folder or recording.
            out: The folder of its result; empty leaves it open.
            again: The command line as it was typed, in words.
        """

        def filled(finding: Finding) -> Finding:
            if finding.do is None:
                return finding
            command = with_paths(finding.do.command, session, out, again)
            return replace(finding, do=replace(finding.do, command=command))

        return replace(self, findings=tuple(map(filled, self.findings)))


def with_paths(
    command: str, session: Path | str, out: Path | str = "", again: Sequence[str] = ()
) -> str:
    """Fills the paths of a run into a command; see `Verdict.with_paths`."""
    folder, result = Path(session), Path(out or "out")
    fixed = _free(f"{folder.with_suffix('') if folder.is_file() else folder}-fixed")
    is_file = result.suffix in (".json", ".rrd")
    new = f"{result.parent if is_file else result}-new"
    paths = {"SESSION": str(session), "FIXED": fixed, "OUT": str(out) or "out", "NEW": new}
    words = {name: shlex.quote(path) for name, path in paths.items()}
    # Of a sentence, an apostrophe is no quotation.
    if AGAIN in command:
        words[AGAIN] = shlex.join([*_without(again, shlex.split(command))])
    return _PATH.sub(lambda found: words[found[0]], command)


def _without(typed: Sequence[str], added: Sequence[str]) -> Iterator[str]:
    """A command line's words without the options, and their values, that are to be added to it."""
    has_value = {
        name: not value.startswith("--")
        for name, value in zip(added, [*added, "--"][1:], strict=True)
        if name.startswith("--")
    }
    words = iter(typed)
    for word in words:
        name, _, value = word.partition("=")
        if name not in has_value:
            yield word
        elif has_value[name] and not value:
            next(words, None)


def _free(name: str) -> str:
    """A name that no folder has yet: nothing is written over."""
    names = (name, *(f"{name}-{index}" for index in range(2, 100)))
    return next((word for word in names if not Path(word).exists()), name)
