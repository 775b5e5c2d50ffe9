"""Verdicts: findings with their probabilities as causes, their effects, and remedies."""

import re
import shlex
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal, Self, TypeAlias

import numpy as np

from visioncal.core.codec import DROPPED, UNWRITTEN
from visioncal.core.number_format import percent, ranges
from visioncal.core.summaries import html_card
from visioncal.core.types import FloatArray

VerdictStatus: TypeAlias = Literal["good", "check", "bad"]

# Number of findings, and of steps, that are shown first; least probability of causes among them,
# of causes with steps, and of causes that are likely beside the first.
_SHOWN, LEAST_LIKELY, _LIKELY, _EVEN = 3, 0.05, 0.2, 0.5
# From this probability on, causes are ranked by their kinds.
SURE = 0.99
# Smaller than any need [mm]: for findings on what is left out of a result, which do not impair it.
LEAST_NEED_MM = 1e-3
_HEADLINES = {"good": "Good: ready to use", "check": "Check before use", "bad": "Bad: do not use"}
# Kinds of what is no doubt: praise, remarks, and that a bad result's accuracy is unknown.
AGREEMENT, NOTE, NO_ACCURACY = "agreement", "note", "no_accuracy"
# Begins a sentence that names what explains about as much as a finding.
LEFT_OPEN = " Or else, as these views leave it open:"
# Kind of what verify finds where depth is not what it was.
DEPTH_CHANGED = "depth_changed"
# Commands of remedies.
CALIBRATE, ADD_VIEWS = "visioncal calibrate SESSION -o OUT", "visioncal plan SESSION --add"
PLAN = f"{ADD_VIEWS} 5"
GUESS = "visioncal convert SESSION FIXED --guess --yes"
CALIBRATE_FIXED = "visioncal calibrate FIXED -o OUT"
GUESS_AND_CALIBRATE = f"{GUESS} && {CALIBRATE_FIXED}"
REVIEW = "visioncal show OUT --viewer"
CALIBRATE_ANEW = "visioncal calibrate SESSION -o NEW"
_BY_HAND = "Of several robots or cameras, correct the files by hand."
# Placeholder of the typed command line, to which options are added.
AGAIN = "AGAIN"
# After a calibration's output stands the need that was typed. An option's value may have a name.
_PATH = re.compile(r"-o (?:OUT|NEW)\b|(?<![\w/:.,=-])(?:SESSION|FIXED|OUT|NEW|AGAIN)(?![\w:,=-])")


@dataclass(frozen=True)
class Option:
    """An option of a remedy's command."""

    name: str  # Without dashes.
    value: str = ""  # Its value; empty for none.
    views: tuple[int, ...] = ()  # The views that it is for; empty for all.
    tool: FloatArray | None = field(default=None, compare=False)  # (4, 4) taken off, in the flange.

    def __str__(self) -> str:
        words = ":".join(filter(None, [ranges(self.views), self.value]))
        return f"--{self.name} {words}".rstrip()


@dataclass(frozen=True)
class Remedy:
    """Advice on a finding."""

    words: str  # A sentence in the imperative.
    # A command line for it; empty where there is none. `with_paths` fills in the placeholders
    # SESSION, FIXED (a corrected copy of the session), OUT, NEW (beside OUT) and AGAIN (the typed
    # command).
    command: Annotated[str, DROPPED] = ""
    # The option of the command that is for some rows; without a name for none.
    option: Annotated[Option, UNWRITTEN] = field(default=Option(""), compare=False)
    # Its words without the command, where these are others.
    plain: Annotated[str, UNWRITTEN] = field(default="", compare=False)
    # Its words for stops that are verified, and make no calibration, where these are others.
    of_check: Annotated[str, UNWRITTEN] = field(default="", compare=False)

    def __str__(self) -> str:
        is_shown = self.command and AGAIN not in self.command
        return f"{self.words} Run: {self.command}" if is_shown else self.words

    def of_cell(self, robots: int, cameras: int) -> "Remedy":
        """The remedy for some robots and cameras: by hand where its command is for all of many."""
        if self.option.name == "intrinsics" and cameras > 1:
            by_hand = 'Of several cameras, write intrinsics = "refine" in the table of this one.'
            return Remedy(f"{self.words} {by_hand}")
        is_of_all = self.option.name == "by-joints" and robots > 1
        return Remedy(f"{self.words} {_BY_HAND}") if is_of_all else self

    def by(self, option: Option) -> "Remedy":
        """The same words with the command that calibrates a copy by an option of `convert`."""
        command = f"visioncal convert SESSION FIXED {option} && {CALIBRATE_FIXED}"
        return replace(self, command=command, option=option)


def look_at(view: int) -> str:
    """The command that shows a view."""
    return f"{REVIEW} --view {view}"


def calibrating(first: str, then: str = "again.", command: str = CALIBRATE) -> Remedy:
    """Advice that ends in a calibration, or in a verification where stops are verified."""
    words, of_check = (f"{first} {do} {then}" for do in ("calibrate", "verify"))
    return Remedy(words, command, of_check=of_check)


def mending(words: str, option: Option, write: str = "Write", end: str = ".") -> Remedy:
    """Advice to write a copy of the session with an option of `convert`, and to calibrate it."""
    first = f"{write} a copy of the session in which {words}, and"
    return calibrating(first, f"it{end}").by(option)


def again(words: str, option: Option) -> Remedy:
    """Advice to repeat the typed command with an option."""
    return Remedy(words, f"{AGAIN} {option}", option)


def or_alone(words: str, views: Sequence[int]) -> Remedy:
    """Advice with the command to calibrate some views alone, if they are enough."""
    option = Option("views", views=tuple(views))
    return Remedy(words, f"{CALIBRATE_ANEW} {option}", option) if len(views) >= 6 else Remedy(words)


def without(views: Sequence[int], residuals: str) -> str:
    """How well the other views predict each other, beside some that were left out."""
    left_out = f"view {views[0]}" if len(views) == 1 else "these views"
    return f"Without {left_out}, the others predict each other to {residuals}."


BY_HAND = Remedy(f"Write a copy of the session that is read so, and calibrate it. {_BY_HAND}")
READ_AGAIN = calibrating(
    "Write a copy of the session that is read so, and", "it.", GUESS_AND_CALIBRATE
)


@dataclass(frozen=True)
class Finding:
    """A finding on a result."""

    kind: str  # Its kind, as a short permanent name.
    words: str  # Its text, with figures.
    do: Remedy | None = None  # Advice; None for none.
    views: tuple[int, ...] = ()  # The views concerned.
    # Probability that it is the cause of what is wrong; 0 for no cause.
    probability: Annotated[float, DROPPED] = 0.0
    # Whether this probability ranks its cause alone and is not stated: it follows from the limit of
    # a comparison, the same in all sessions, or no cure was applied that proves it.
    by_limit: Annotated[bool, DROPPED] = False
    # Whether its probability is its share of the errors of picks, or that of a remark on the number
    # of views: no mistake.
    is_share: Annotated[bool, DROPPED] = False
    without_it: Annotated[str, DROPPED] = ""  # The result without it, as a sentence.
    # Whether it alone makes a result bad.
    is_fatal: Annotated[bool, UNWRITTEN] = field(default=False, compare=False)
    # The need of a task from which on it is no doubt [mm]: zero for findings on the size of errors,
    # which a need judges better than a limit; infinite where errors are unexplained.
    until_mm: Annotated[float, UNWRITTEN] = field(default=np.inf, compare=False)
    # Squared test statistic, as of a standard normal variable; zero where the limit of its test
    # decides.
    mahalanobis_sq: Annotated[float, UNWRITTEN] = field(default=0.0, compare=False)
    # Whether its cure, applied and refitted, leaves mere noise, as no other cause does.
    is_proven: Annotated[bool, UNWRITTEN] = field(default=False, compare=False)
    # Share of the misfit, as a variance, that its cure removes: all of it where none was applied.
    explains: Annotated[float, UNWRITTEN] = field(default=1.0, compare=False)
    # Whether its cure is in the fit, and clearly lowers the misfit: it is no rival of what remains.
    is_apart: Annotated[bool, UNWRITTEN] = field(default=False, compare=False)
    # Greatest error of a pick that it causes [mm]; infinite where unknown.
    up_to_mm: Annotated[float, UNWRITTEN] = field(default=np.inf, compare=False)
    # Parts of its text that follow its words, until `in_words`: what the result makes of it, as a
    # sentence; and what explains about as much, as clauses.
    consequence: Annotated[str, UNWRITTEN] = field(default="", compare=False)
    rivals: Annotated[tuple[str, ...], UNWRITTEN] = field(default=(), compare=False)

    def of(self, name: str) -> Self:
        """The same finding prefixed by the name of its camera or robot, if not empty."""
        if not name:
            return self
        first, rest = self.words[0], self.words[1:]
        # A word with other capitals or digits is a name, as J2.
        is_plain = rest.startswith(" ") or rest.partition(" ")[0].islower()
        return replace(self, words=f"{name}: {first.lower() if is_plain else first}{rest}")

    def with_do(self, changed: Callable[[Remedy], Remedy]) -> Self:
        """The same finding with its advice changed, if it has one."""
        return self if self.do is None else replace(self, do=changed(self.do))

    def in_words(self) -> Self:
        """The same finding with all parts of its text in its words."""
        words = " ".join(filter(None, [self.words, self.consequence]))
        words += f"{LEFT_OPEN} {' or '.join(self.rivals)}." if self.rivals else ""
        return replace(self, words=words, consequence="", rivals=())

    @property
    def reason(self) -> str:
        """The finding's text and advice."""
        return self.words if self.do is None else f"{self.words} {self.do}"


def of_cell(findings: Iterable[Finding], robots: int, cameras: int) -> tuple[Finding, ...]:
    """Findings with remedies for a session of some robots and cameras."""
    return tuple(found.with_do(lambda do: do.of_cell(robots, cameras)) for found in findings)


def remarks(sentences: Iterable[str], kind: str = "remark") -> tuple[Finding, ...]:
    """Findings without tests."""
    return tuple(Finding(kind, sentence) for sentence in sentences)


@dataclass(frozen=True)
class Verdict:
    """Whether a result can be trusted."""

    status: VerdictStatus  # The judgement.
    # The reasons in reading order: the likeliest cause, its effect, then the rest.
    findings: tuple[Finding, ...] = ()
    # The least need for which it is good [mm]; None where errors are unexplained.
    good_for_mm: float | None = None
    # The same by the controller's own poses, where the arm was calibrated; `good_for_mm` then is
    # for corrected targets.
    good_for_mm_uncorrected: float | None = None

    @classmethod
    def of(cls, status: VerdictStatus, *sentences: str) -> Self:
        """A verdict with sentences without tests."""
        return cls(status, remarks(sentences))

    @classmethod
    def by(cls, doubts: Sequence[Finding], praise: Finding) -> Self:
        """`bad` with a fatal doubt, `check` with other doubts, else `good` with the praise."""
        if not doubts:
            return cls("good", (praise,))
        status: VerdictStatus = "bad" if any(doubt.is_fatal for doubt in doubts) else "check"
        return cls(status, tuple(sorted(doubts, key=lambda doubt: not doubt.is_fatal)))

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
    def has_accuracy(self) -> bool:
        """Whether sigmas say how accurate it is: not where no fit explains the views."""
        return all(finding.kind != NO_ACCURACY for finding in self.findings)

    def accuracy(self, words: str) -> str:
        """Words on the accuracy, or that it is unknown."""
        return words if self.has_accuracy else "its accuracy is unknown"

    @property
    def reasons(self) -> tuple[str, ...]:
        """All findings with advice."""
        return tuple(finding.reason for finding in self.findings)

    @property
    def first_reason(self) -> str:
        """The first finding with its advice; the headline without findings."""
        return next(iter(self.reasons), self.headline)

    @property
    def causes(self) -> tuple[Finding, ...]:
        """Possible causes of doubts, likeliest first; those that are as good as certain as read."""
        possible = (finding for finding in self.findings if finding.probability)
        return tuple(sorted(possible, key=lambda finding: -min(finding.probability, SURE)))

    @property
    def top(self) -> tuple[str, ...]:
        """The first findings as sentences."""
        return tuple(map(self._line, self.findings[:_SHOWN]))

    @property
    def rest(self) -> tuple[str, ...]:
        """The remaining findings as sentences."""
        return tuple(map(self._line, self.findings[_SHOWN:]))

    def _line(self, finding: Finding) -> str:
        likely = "" if finding.by_limit else f" ({percent(finding.probability)})"
        how = "Also likely" if finding.probability >= _EVEN else "Possibly"
        if finding in self.causes[:1]:
            others = [cause for cause in self.causes[1:] if cause.probability >= LEAST_LIKELY]
            # A stored verdict has its rivals in its words alone.
            is_open = bool(others or finding.rivals) or LEFT_OPEN in finding.words
            is_even = finding.probability > 0.9 * _EVEN
            how = "Most likely" if is_even or not finding.by_limit else how
            how = "Likeliest of these" if finding.by_limit and is_open else how
        is_likely = finding.probability >= LEAST_LIKELY and not finding.is_share
        begin = f"{how}{likely}: " if is_likely else ""
        return f"{begin}{finding.words} {finding.without_it}".strip()

    @property
    def next_steps(self) -> tuple[Remedy, ...]:
        """Advice on the findings, in their order, without repetitions."""
        unlikely = [cause for cause in self.causes[1:] if cause.probability < _LIKELY]
        steps: dict[str, Remedy] = {}
        for finding in self.findings:
            if finding.do is not None and finding not in unlikely:
                steps.setdefault(finding.do.command or finding.do.words, finding.do)
        return tuple(steps.values())[:_SHOWN]

    def with_paths(
        self,
        session: Path | str,
        out: Path | str = "",
        again: Sequence[str] = (),
        need: Sequence[str] = (),
    ) -> Self:
        """Fills session, output, command line and need, as typed, into the remedies' commands.

        Each command that writes a corrected copy of the session has a folder of its own.
        """
        every = [finding.do.command for finding in self.findings if finding.do is not None]
        copies = [*dict.fromkeys(command for command in every if "FIXED" in command)]

        def filled(do: Remedy) -> Remedy:
            copy = copies.index(do.command) if do.command in copies else 0
            return replace(do, command=with_paths(do.command, session, out, again, need, copy=copy))

        return replace(self, findings=tuple(found.with_do(filled) for found in self.findings))


def need_options(
    mm: float | None, deg: float | None, *, corrected: bool = False
) -> tuple[str, ...]:
    """The options that state a need, for `with_paths`: a repeated calibration has to meet it."""
    limits = (("--need-mm", mm), ("--need-deg", deg))
    typed = [word for name, at in limits if at is not None for word in (name, f"{at:g}")]
    return (*typed, *["--corrected"] * corrected)


def with_paths(
    command: str,
    session: Path | str,
    out: Path | str = "",
    again: Sequence[str] = (),
    need: Sequence[str] = (),
    *,
    copy: int = 0,
) -> str:
    """Fills the paths of a run into a command; see `Verdict.with_paths`.

    A corrected copy of the session has the first free name after so many as `copy`.
    """
    folder, result = Path(session), Path(out or "out")
    if folder.name in ("", ".."):
        # A copy of the current folder stands beside it, not within.
        folder = folder / ".." / folder.resolve().name
    name = f"{folder.with_suffix('') if folder.is_file() else folder}-fixed"
    names = (name, *(f"{name}-{index}" for index in range(2, 100)))
    free = [word for word in names if not Path(word).exists()]
    fixed = free[copy] if copy < len(free) else name
    is_file = result.suffix in (".json", ".rrd")
    new = f"{result.parent if is_file else result}-new"
    paths = {"SESSION": str(session), "FIXED": fixed, "OUT": str(out) or "out", "NEW": new}
    words = {name: shlex.quote(path) for name, path in paths.items()}
    if "--views" in need and " --views " in command:
        # A step's own views are among the typed ones.
        need = need[: [*need].index("--views")]
    # Of an option that is typed twice, the last one counts.
    words[AGAIN] = shlex.join(again)
    words |= {f"-o {name}": " ".join(["-o", words[name], *need]) for name in ("OUT", "NEW")}
    return _PATH.sub(lambda found: words[found[0]], command)
