"""Possible faults of a session, a cell or a result; see `registry`."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from visioncal.core.verdict import Finding

if TYPE_CHECKING:
    from visioncal.calibration.pipeline.run_state import RunState

# Kinds that several modules name.
ARM_ERRORS, UNEXPLAINED = "arm_errors", "unexplained"
UNDONE = (
    *("shifted_rows", "turned_board", "flipped_poses", "copied_poses", "lost_sign"),
    *("mixed_units", "turned_pictures"),
)
# All that explains that views disagree, or that the flange is off.
CHAIN = "chain"
# Changes of a lens, which look like a camera that was knocked.
LIKE_KNOCKS = ("focus", "image_shifted")
STEPS = ("moved_at_once", "joint_slipped", "board_changed")
# Sources of the errors of picks, whose probability is their share.
SOURCES = (
    "calibration",
    "unmeasured_board",
    "robot_noise",
    "robot_noise_of_pick",
    "uncorrected_targets",
)
# False-alarm probabilities of remarks, which no test is behind (1 / e: even odds), and of facts.
REMARK, FACT = math.exp(-1.0), 1e-12
# Sources that a change inflates, which the fit has as noise and in boards: errors by posture and
# time correlate before and after it, and are tested beside it.
INFLATED = (ARM_ERRORS, *SOURCES[:4])


@dataclass(frozen=True)
class Suspect:
    """A kind of findings: what finds it, and what a verdict makes of it."""

    kind: str  # A short permanent name.
    # Finds it in a finished run; None where a stage or a limit does.
    finds: "Callable[[RunState], Iterable[Finding]] | None" = None
    # False-alarm probability of its test in a sound session; zero for no cause by itself.
    chance: float = 0.0
    of_chain: bool = False  # Whether it explains that views disagree: such causes compete.
    # Kinds of findings, or `CHAIN`, that are mere effects of it, with remedies that do not help.
    hides: tuple[str, ...] = ()
    inflates: tuple[str, ...] = ()  # Sources of errors that it inflates.
    is_doubt: bool = True  # Whether it is a doubt about the result.
    # Whether it judges the frames of the result, which say nothing where no fit explains the views.
    of_result: bool = False
    is_sigma: bool = False  # Whether it is a sigma beyond a limit of its own.
    # Rank among findings on the size of errors, the most important first; 0 for none.
    size: int = 0
    # Rank among causes that are as good as certain: exchanged rows come first, since they mislead
    # all other tests; errors of the arm, which always exist, and unexplained errors come last.
    order: int = 0
