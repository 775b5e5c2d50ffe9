"""The catalogue of kinds of findings: what a verdict makes of a finding, by its kind."""

from collections.abc import Mapping
from dataclasses import dataclass

# Kinds that several modules name.
AGREEMENT, NEED, GOOD_FOR, NOTE = "agreement", "need", "good_for", "note"
# The arm was calibrated: what a result is good for depends on how its targets are sent.
CALIBRATED_ARM = "calibrated_arm"
MISSING = "missing_images"
REPEATED_READINGS = "repeated_readings"
EXCHANGED, ARM_ERRORS, UNEXPLAINED = "exchanged_views", "arm_errors", "unexplained"
LENS_CHANGED, MOVED_FRAME, BOARD_CHANGED = "lens_changed", "moved_at_once", "board_changed"
# Misfits that a cause may explain: views disagree or the flange is off; corners; the intrinsics.
CHAIN, CORNERS, INTRINSICS = "chain", "corners", "intrinsics"
# False-alarm probabilities of remarks, which no test is behind, and of facts.
REMARK, FACT = 0.36787944117144233, 1e-12


@dataclass(frozen=True)
class Kind:
    """A kind of findings."""

    name: str  # A short permanent name.
    # False-alarm probability of its test in a sound session; zero for no cause by itself.
    chance: float = 0.0
    misfit: str = ""  # The misfit that it explains; causes of one misfit compete.
    # Kinds, or misfits, of which findings are mere effects of it, with remedies that do not help.
    hides: tuple[str, ...] = ()
    inflates: tuple[str, ...] = ()  # Sources of errors that it inflates.
    is_doubt: bool = True  # Whether it is a doubt about the result.
    leaves_out: bool = False  # Whether it is of views that were left out.
    is_step: bool = False  # Whether it is a sudden step, which inflates all sigmas.
    is_source: bool = False  # Whether it is a source of errors, whose probability is its share.
    is_sigma: bool = False  # Whether it is a sigma beyond a limit of its own.
    size: int = (
        0  # Rank among findings on the size of errors, the most important first; 0 for none.
    )
    # Rank among causes that are as good as certain: exchanged rows come first, since they mislead
    # all other tests; errors of the arm, which always exist, and unexplained errors come last.
    order: int = 0


_SOURCES = (
    "calibration",
    "unmeasured_board",
    "robot_noise",
    "robot_noise_of_pick",
    "uncorrected_targets",
)
_STEPS = (MOVED_FRAME, "joint_slipped", BOARD_CHANGED)
_BOARD = ("board_size", "board_shape")
# A step makes errors by posture and time correlate before and after it, and is tested beside them.
# Motion along a camera's axis looks like changes of its focus, which are random in the fit; a
# changing focus does not follow time, and looks like motion in one session of ten thousand.
_BY_STEP, _INFLATED = (ARM_ERRORS, "focus"), (ARM_ERRORS, "calibration")
# Findings measured through the robot, which mean nothing where its poses are misread.
_BY_CHAIN = (
    GOOD_FOR,
    *_SOURCES,
    *_BOARD,
    *("lens", "lens_field", "corner_noise", ARM_ERRORS, "prior"),
    *_STEPS,
)

_KINDS = (
    # What was seen and read.
    Kind(MISSING, is_doubt=False),
    Kind(REPEATED_READINGS, is_doubt=False),
    Kind("repeated_views", FACT),
    Kind("corner_numbers", FACT),
    Kind("rig_points", FACT),
    Kind("other_board", FACT, hides=("lost_views",)),
    Kind("other_lens", FACT),
    Kind("lost_views", REMARK),
    *map(Kind, ("left_out", "remark")),
    Kind("unused"),
    Kind("weak_lens", REMARK, INTRINSICS),
    # Conventions, clocks, joints.
    Kind("misread_poses", 1e-3, CHAIN, hides=_BY_CHAIN),
    Kind("misread_joints", 1e-3, hides=(ARM_ERRORS,), inflates=(ARM_ERRORS,)),
    # The frames are by the poses, which a wrong model does not change.
    Kind("other_arm", REMARK, hides=(ARM_ERRORS,), inflates=(ARM_ERRORS,)),
    *map(Kind, ("contradicting_joints", "base_link", "tool_frame")),
    *map(Kind, ("level", "load", "clock")),
    # The remainder of a clock's jump looks like motion.
    Kind("clock_changed", 1e-4, CHAIN, hides=("moved_slowly", *_STEPS, ARM_ERRORS)),
    # Views.
    Kind(EXCHANGED, 1e-6, leaves_out=True, order=-1),
    Kind("wrong_pose", 1e-3, leaves_out=True),
    Kind("something_moved", 1e-4, leaves_out=True),
    Kind("wrong_views", 1e-3),
    Kind("holdout", 1e-3),
    # Frames.
    Kind("moved_frame", 1e-4),
    Kind("moved_slowly", 1e-4, CHAIN, hides=("focus",), inflates=(ARM_ERRORS,)),
    Kind(MOVED_FRAME, 1e-4, CHAIN, hides=_BY_STEP, inflates=_INFLATED, is_step=True),
    Kind("joint_slipped", 1e-4, CHAIN, hides=_BY_STEP, inflates=_INFLATED, is_step=True),
    Kind(
        BOARD_CHANGED,
        1e-4,
        CHAIN,
        hides=(*_BY_STEP, *_BOARD),
        inflates=_INFLATED,
        is_step=True,
    ),
    Kind("prior", 2.7e-3),
    Kind("untied", FACT),
    Kind("unseen_target"),
    # Boards, lenses and arms.
    Kind("board_size", 2.7e-3, CHAIN),
    Kind("board_shape", 1e-4, CHAIN),
    # A held lens that the corners contradict looks like a board of another size or shape, and, by
    # the views' postures, like arm errors; the lens is tested beside all three.
    Kind("lens", 1e-4, CHAIN, hides=(*_BOARD, ARM_ERRORS)),
    Kind("lens_field", 1e-4, CHAIN),
    Kind("focus", 1e-4, CHAIN),
    Kind(LENS_CHANGED, 1e-4, CHAIN, hides=(CHAIN,), inflates=_INFLATED),
    Kind("corner_noise", 1e-4, CORNERS),
    Kind(ARM_ERRORS, 1e-4, CHAIN, order=1),
    Kind(UNEXPLAINED, REMARK, CHAIN, size=3, order=1),
    # The size of errors.
    Kind("too_few_stops", FACT),
    Kind("few_stops"),
    Kind("optimism", size=4),
    Kind("weak_motion", hides=("weak_lens",), size=5, is_sigma=True),
    Kind("place", size=6, is_sigma=True),
    Kind("workspace", size=7, is_sigma=True),
    *(Kind(name, is_source=True) for name in _SOURCES),
    Kind(NEED, is_doubt=False, size=1),
    Kind(GOOD_FOR, is_doubt=False, size=2),
    *(Kind(name, is_doubt=False) for name in (AGREEMENT, NOTE, CALIBRATED_ARM)),
)
KINDS: Mapping[str, Kind] = {kind.name: kind for kind in _KINDS}
