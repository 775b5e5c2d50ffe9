"""Stops whose poses or joint angles are misread: no change of a cell explains these."""

from collections.abc import Iterable
from itertools import chain

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import misread_poses
from visioncal.core.verdict import CALIBRATE, CALIBRATE_FIXED, Finding, Remedy

_VERIFY, _VERIFY_FIXED = (f"visioncal verify {at} --against OUT" for at in ("SESSION", "FIXED"))


def misreading(run: RunState) -> Finding | None:
    """The likeliest misreading of the poses of stops that were observed; None for none."""
    return _of_check(misread_poses(run))


def misread_joints(run: RunState) -> Finding | None:
    """Why joint angles of observed stops cannot be used; None where that is not known.

    Angles that contradict misread poses are sound.
    """
    kinds = ("misread_joints", "other_arm")
    misread, others = ([at for at in run.warnings if at.kind == kind] for kind in kinds)
    return _of_check(chain(misread, misread_poses(run), others))


def _of_check(findings: Iterable[Finding]) -> Finding | None:
    """The first finding, its step for stops that are verified: these make no calibration."""
    found = next(iter(findings), None)
    return found and found.with_do(_verifying)


def _verifying(do: Remedy) -> Remedy:
    command = do.command.replace(CALIBRATE, _VERIFY).replace(CALIBRATE_FIXED, _VERIFY_FIXED)
    return Remedy(do.of_check or do.words, command)
