"""All suspects. To add one: a file with its `Suspect` in this folder, and an entry here."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

from visioncal.calibration.pipeline.connectivity import connection_advice
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.image_checks import unseen_cause
from visioncal.calibration.stages.priors import components
from visioncal.calibration.suspects import (
    arm,
    board,
    growing,
    late_poses,
    lens,
    mirrored_cell,
    misread_poses,
    mounting,
    pairs_alone,
    rounded_poses,
    steps,
    turned_views,
)
from visioncal.calibration.suspects.moved_frames import crept_findings, moved_findings
from visioncal.calibration.suspects.outliers import EXCHANGED, MISNAMED
from visioncal.calibration.suspects.suspect import (
    ARM_ERRORS,
    FACT,
    REMARK,
    SOURCES,
    STEPS,
    UNDONE,
    UNEXPLAINED,
    Suspect,
)
from visioncal.core.verdict import AGREEMENT, NO_ACCURACY, NOTE, Finding, Remedy, without
from visioncal.results.views import left_out_rms


def _outliers(run: RunState) -> Iterator[Finding]:
    """Wrong poses and images that explain outliers, and frames of a cell that moved."""
    held_out = left_out_rms(run.assessment.views)
    for fault in run.assessment.faults:
        yield replace(fault.found, without_it=without(fault.found.views, held_out.words))
    if not run.session.has_one_pair:
        yield from moved_findings(run.assessment.moved, run.assessment.edges, run.cell_fit)
        yield from crept_findings(run.cell_fit)


def _contradicted(run: RunState) -> Iterator[Finding]:
    for component in components(run.assessment.fit, run.cell_fit.cell.priors):
        yield component.finding


def _unconnected(run: RunState) -> Iterator[Finding]:
    for frame in run.cell_fit.unconnected:
        if run.session.has_one_pair and frame.startswith("target"):
            words = f"No usable view shows {frame.replace('_', ' ', 1)}: it has no place."
            step = Remedy("Add views that show it, or delete it from session.toml.")
            yield Finding("unseen_target", words, step)
        else:
            step = Remedy(connection_advice(frame))
            yield Finding("untied", f"{frame} is tied to nothing.", step)


def _unseen(run: RunState) -> Iterator[Finding]:
    cause = unseen_cause(run) if run.reasons else None
    if cause is not None and cause.kind in ("other_board", "mirrored_images", "negative_images"):
        yield cause


_ENTRIES: tuple[Suspect, ...] = (
    # Views.
    Suspect(EXCHANGED, _outliers, 1e-6, order=-1),
    *(Suspect(kind, None, 1e-6, order=-1) for kind in (MISNAMED, *UNDONE)),
    Suspect("something_moved", chance=1e-4),
    Suspect("moved_frame", chance=1e-4),
    Suspect("frame_creeps", chance=1e-4),
    pairs_alone.PAIRS_APART,
    Suspect("wrong_views", chance=1e-3),
    Suspect("holdout", chance=1e-3),
    # Arms, steps, lenses and boards.
    arm.ERRORS,
    arm.HEAT,
    mounting.MOUNTING,
    steps.MOVED_AT_ONCE,
    steps.JOINT_SLIPPED,
    steps.BOARD_CHANGED,
    steps.MOVED_SLOWLY,
    lens.FIELD,
    lens.FOCUS,
    lens.SHIFTED,
    lens.MOTION,
    lens.WINDOW,
    lens.SWELLS,
    lens.SAGS,
    lens.MODEL,
    Suspect("prior", _contradicted, 2.7e-3),
    lens.LENS,
    Suspect("given_lens", is_doubt=False, of_result=True),
    board.SIZE,
    board.SHAPE,
    board.PRINT,
    *growing.GROWING,
    mirrored_cell.MIRRORED_CELL,
    mirrored_cell.CAMERA_POSES,
    rounded_poses.ROUNDED_POSES,
    turned_views.TURNED_VIEWS,
    late_poses.LATE_POSES,
    mirrored_cell.TOOL_ACTIVE,
    Suspect("carried_away", is_doubt=False, of_result=True),
    Suspect("untied", _unconnected, FACT),
    Suspect("unseen_target"),
    # Images and readings.
    Suspect("missing_images", is_doubt=False),
    Suspect("unsteady_corners", is_doubt=False),
    Suspect("repeated_readings", is_doubt=False),
    Suspect("repeated_views", chance=FACT),
    Suspect("corner_numbers", chance=FACT),
    Suspect("other_board", _unseen, FACT, hides=("lost_views",)),
    Suspect("mirrored_images", chance=FACT, hides=("lost_views",)),
    Suspect("negative_images", chance=FACT, hides=("lost_views",)),
    Suspect("unshown_rows", chance=FACT),
    Suspect("image_sizes", chance=FACT, hides=("lost_views",)),
    Suspect("other_lens", chance=FACT),
    Suspect("lost_views", chance=REMARK),
    *map(Suspect, ("remark", "unused")),
    Suspect("corner_noise", chance=1e-4),
    # Conventions, clocks, joints.
    misread_poses.MISREAD_POSES,
    misread_poses.MISREAD_READINGS,
    Suspect("misread_joints", None, 1e-3, hides=(ARM_ERRORS,), inflates=(ARM_ERRORS,)),
    Suspect("joint_play", None, 1e-6, hides=("wrong_views",)),
    # The frames are by the poses, which a wrong model does not change.
    Suspect("other_arm", None, REMARK, hides=(ARM_ERRORS,), inflates=(ARM_ERRORS,)),
    # Links that share the size of one that is far off are scaled along, and so is the board.
    Suspect(
        "arm_parameter",
        chance=1e-4,
        hides=(ARM_ERRORS, "board_size", "workspace"),
        inflates=(ARM_ERRORS, "unmeasured_board", "calibration"),
    ),
    # It precedes sigmas beyond their limits, which have less to say where the frame is another.
    Suspect("tool_frame", chance=REMARK),
    *map(Suspect, ("contradicting_joints", "base_link", "level", "load", "clock")),
    # The remainder of a clock's jump looks like motion.
    Suspect("clock_changed", None, 1e-4, True, ("moved_slowly", *STEPS, ARM_ERRORS)),
    # The size of errors.
    # It stands for noise that no such robot has.
    Suspect(UNEXPLAINED, None, REMARK, True, inflates=SOURCES[2:4], size=3, order=1),
    Suspect("too_few_stops", chance=FACT),
    Suspect("few_stops"),
    Suspect("weak_motion", size=5, is_sigma=True),
    Suspect("place", size=6, is_sigma=True),
    Suspect("workspace", size=7, is_sigma=True),
    *map(Suspect, SOURCES),
    Suspect("need", is_doubt=False, size=1),
    Suspect("good_for", is_doubt=False, size=2),
    Suspect(NO_ACCURACY, is_doubt=False, size=4),
    *(Suspect(kind, is_doubt=False) for kind in (AGREEMENT, NOTE, "calibrated_arm")),
)
SUSPECTS: Mapping[str, Suspect] = {suspect.kind: suspect for suspect in _ENTRIES}


def found_in(run: RunState) -> Iterator[Finding]:
    """Findings of all suspects in a finished run."""
    for suspect in _ENTRIES:
        if suspect.finds is not None:
            yield from suspect.finds(run)
