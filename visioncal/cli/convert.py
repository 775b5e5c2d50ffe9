"""`visioncal convert`."""

import sys
from dataclasses import replace
from functools import partial

from visioncal.calibration.guess import POSE_OPTIONS, Candidate
from visioncal.cli.console import print_table, say
from visioncal.cli.progress import shown_progress
from visioncal.cli.session_options import ConvertOptions, RobotPoseOptions
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted, robot_words
from visioncal.interchange.formats import (
    DoubtfulRobot,
    DoubtfulSession,
    ImportOptions,
    PoseImportOptions,
    convert,
)
from visioncal.results import Calibration

# Readings that a table shows, at most.
_SHOWN = 12
# Options that are named as the import's.
_AS_TYPED = (
    *("camera_file", "mount", "target", "intrinsics"),
    *("images", "resolution", "tip", "instrument"),
)


def convert_command(options: ConvertOptions) -> None:
    """Runs `visioncal convert`."""
    requested = replace(
        import_options(options),
        camera=PoseImportOptions(
            options.camera_columns or (),
            options.camera_form,
            options.camera_unit,
            options.camera_inverse,
        ),
        image=options.image_column,
        **{name: getattr(options, name) for name in _AS_TYPED},
    )
    choose = partial(_chosen, yes=options.yes) if options.guess else None
    # A choice shows its own progress.
    with shown_progress(quiet=options.guess) as progress:
        session = convert(
            options.source,
            options.dest,
            requested=replace(requested, progress=progress, command=("visioncal", *sys.argv[1:])),
            form=options.form,
            force=options.force,
            choose=choose,
            mends=options,
        )
    for warning in session.warnings:
        say(f"note: {warning}")
    say(f"wrote {options.dest}\nsha256 {session.digest()}")


def import_options(
    poses: RobotPoseOptions, calibration: Calibration | None = None
) -> ImportOptions:
    """The import options of a robot's poses, which are usually in the form of its calibration."""
    usual = None if calibration is None else calibration.controller()
    return ImportOptions(
        robot=PoseImportOptions(
            *(poses.robot_columns or (), poses.robot_form, poses.robot_unit, poses.robot_inverse),
            None if usual is None else usual.name,
        ),
        joints=poses.joint_columns or (),
        joints_deg=poses.joint_unit == "deg",
        robot_model=poses.robot_model,
    )


def _chosen(recorded: DoubtfulSession | DoubtfulRobot, *, yes: bool) -> Candidate:
    """Tries other readings, prints them, and returns the clearly best one with --yes."""
    with shown_progress(quiet=False) as progress:
        guess = recorded.guess(progress)
    if isinstance(recorded, DoubtfulRobot):
        words = robot_words(recorded.robot)
        say(f"{words[0].upper()}{words[1:]}:")
    at = guess.candidates.index(guess.best)
    shown = guess.candidates[: max(_SHOWN, at + 1)]
    left = len(guess.candidates) - len(shown)
    print_table(
        ("reading", "robot and camera agree to", "views that agree"),
        [
            (
                candidate.words,
                candidate.fit.figures,
                f"{candidate.fit.agreeing} of {len(candidate.of_rows)}",
            )
            for candidate in shown
        ],
        caption=f"and {counted(left, 'reading')} that fit worse" if left else "",
        bold=at,
        is_message=True,
    )
    say("\n".join([guess.sentence, *(f"note: {note}" for note in guess.notes)]))
    if not guess.stands_out:
        if guess.declared.fit.closes:
            return guess.declared
        raise DataError(
            "Nothing was written: the chain does not close as first read, and no other reading "
            "stands out.",
            next_step="Look how the program wrote the poses, and where the camera is, and state "
            f"that: {POSE_OPTIONS}{', or --positions' if guess.positions else ''}."
            if guess.is_open
            else "Check that the poses and what the camera saw are of the same views and the "
            "same robot, and that positions stand before rotations (where not, name the columns in "
            "that order: --robot-columns 4,5,6,1,2,3). Without --guess it is written as it is; "
            "visioncal doctor then looks for what happened midway.",
        )
    if not yes:
        raise DataError(
            "Nothing was written: another reading closes the chain better than what is stated.",
            culprits=[guess.best.words],
            next_step="Take it with --yes.",
        )
    return guess.best
