"""Stops whose poses or joint angles are misread: no change of a cell explains these."""

import re
from collections.abc import Iterable
from dataclasses import replace
from itertools import chain

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.run import misread_poses
from visioncal.core.verdict import Finding, Remedy

_CALIBRATING = re.compile(r"visioncal calibrate (\w+) -o OUT")


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
    if found is None or found.do is None:
        return found
    command = _CALIBRATING.sub(r"visioncal verify \1 --against OUT", found.do.command)
    words = found.do.words.replace("calibrate", "verify")
    return replace(found, do=Remedy(words, command))
