"""Verdict on identified dynamics, with its reasons."""

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np

from visioncal.core.limits import DynamicsLimits
from visioncal.core.number_format import figure, some_of
from visioncal.core.types import Mask
from visioncal.core.verdict import NOTE, Finding, Remedy, Verdict, VerdictStatus
from visioncal.dynamics.base import random_motion
from visioncal.dynamics.identified import UNKNOWN, Identified, TorqueValidation
from visioncal.robot.files import robot_names

_LIMITS = DynamicsLimits()
_Judged: TypeAlias = tuple[VerdictStatus, Finding]
_MOTION = "Record, and fit with this one, a motion"


def _check(kind: str, words: str, do: Remedy | None = None) -> _Judged:
    return "check", Finding(kind, words, do)


def _plan(identified: Identified, words: str) -> Remedy:
    """Advice to record a planned motion, with the command for a robot that visioncal knows."""
    name = identified.robot.name
    command = f"visioncal dynamics plan {name} -o motions" if name in robot_names() else ""
    return Remedy(f"{words}; visioncal dynamics plan writes some.", command)


def judge(identified: Identified) -> Verdict:
    """Judges identified dynamics by their predictions, and by what the motion determined."""
    judged = [
        *_of_lag(identified),
        *_of_prediction(identified),
        *_of_range(identified),
        *_of_parameters(identified),
    ]
    statuses = {status for status, _ in judged}
    worst: VerdictStatus = (
        "bad" if "bad" in statuses else "check" if "check" in statuses else "good"
    )
    return Verdict(worst, tuple(finding for _, finding in judged))


def _of_lag(identified: Identified) -> Iterator[_Judged]:
    lag = identified.lag
    if lag is None:
        return
    share = figure(100.0 * lag.share)
    words = f"{lag.words} As they stood, that was up to {share} % of a joint's range."
    if lag.share < _LIMITS.lag_share:
        yield "good", Finding(NOTE, words)
        return
    step = Remedy(
        "Record angles and torques by one clock, and filter neither of them, or both alike: a lag "
        "that changes is undone in the mean alone."
    )
    yield _check("lag", words, step)


def _of_prediction(identified: Identified) -> Iterator[_Judged]:
    validation = identified.validation
    if validation is None:
        yield _check(
            "unchecked",
            "Nothing was left to predict: the torques that were fitted are no proof.",
            _plan(identified, "Record a second motion, and name it with --validate-on"),
        )
        return
    shares = validation.shares
    worst = int(np.argmax(shares))
    percents = ", ".join(figure(100.0 * float(share)) for share in shares)
    status: VerdictStatus = "good"
    if shares[worst] > _LIMITS.range_share[0]:
        status = "bad" if shares.min() > _LIMITS.range_share[1] else "check"
    yield (
        status,
        Finding(
            "prediction",
            f"The torques of {validation.label} are predicted to {percents} % of their "
            f"range (joints 1 to {len(shares)}).",
        ),
    )
    fitted = identified.fitted_rms_nm
    worse = validation.rms_nm > _LIMITS.worse * np.maximum(fitted, validation.noise_nm)
    worse &= shares > _LIMITS.slight_share
    if worse.any():
        yield _check(
            "optimism",
            f"{_joints(worse)}: torques are predicted "
            f"{figure(float((validation.rms_nm / fitted)[worse].max()))} times worse than "
            "they were fitted: the motion says too little, or something changed.",
            _plan(identified, _MOTION),
        )
    yield from _of_known(identified, validation)


def _of_known(identified: Identified, validation: TorqueValidation) -> Iterator[_Judged]:
    known, bodies = validation.known_rms_nm, validation.consistent_rms_nm
    if known is not None:
        less_accurate = validation.rms_nm > known
        if less_accurate.any():
            yield _check(
                "worse_than_known",
                f"{_joints(less_accurate)}: the inertias that {identified.robot.name} comes with "
                "predict torques better than the identified ones.",
                _plan(identified, _MOTION),
            )
        else:
            times = float(np.median(known / np.maximum(validation.rms_nm, 1e-12)))
            yield (
                "good",
                Finding(
                    NOTE,
                    f"That is {figure(times)} times nearer than by the inertias that "
                    f"{identified.robot.name} comes with, in the median of the joints.",
                ),
            )
        unexplained = known > _LIMITS.known_share * validation.torque_nm
        if unexplained.any():
            yield _check(
                "other_robot",
                f"{_joints(unexplained)}: by the inertias that {identified.robot.name} comes with, "
                f"{figure(100.0 * float((known / validation.torque_nm).max()))} % of the "
                "torques' range stays unexplained.",
                Remedy(
                    "Check whether it is the robot that was recorded, whether it stands "
                    "upright ([robot] gravity_m_s2), and what is on its flange."
                ),
            )
    if bodies is not None:
        worse = bodies > _LIMITS.bodies_worse * validation.rms_nm
        if worse.any():
            yield _check(
                "bodies",
                f"{_joints(worse)}: no bodies near the known ones explain the torques as "
                "well; friction may be of another kind, or a load is on the flange.",
            )


def _of_range(identified: Identified) -> Iterator[_Judged]:
    """Checks the predicted uncertainty of the torques of fast motions of all joints."""
    base = identified.base
    motion = random_motion(base.model, np.random.default_rng(0))
    x = base.regressor(motion)
    covariance = identified.covariance[: base.rank, : base.rank]
    sigma = np.sqrt(np.mean(np.einsum("mnp,pq,mnq->mn", x, covariance, x, optimize=True), axis=0))
    share = sigma / np.sqrt(np.mean((x @ identified.values) ** 2, axis=0))
    if share.max() > _LIMITS.range_share[0]:
        yield _check(
            "weak_motion",
            f"{_joints(share > _LIMITS.range_share[0])}: what fast motions take (up to "
            f"{np.abs(motion.dq).max():.0f} rad/s and {np.abs(motion.ddq).max():.0f} rad/s^2) "
            f"is known to {figure(100.0 * float(share.max()))} % only: this motion was too "
            "slow, too small or too short.",
            _plan(identified, _MOTION),
        )


def _of_parameters(identified: Identified) -> Iterator[_Judged]:
    unknown = np.array([name == UNKNOWN for name in identified.determined])
    if unknown.mean() > _LIMITS.undetermined_share:
        names = [
            name
            for name, is_unknown in zip(identified.base.names, unknown, strict=True)
            if is_unknown
        ]
        yield _check(
            "undetermined",
            f"{unknown.sum()} of {len(unknown)} base parameters are not determined by this motion, "
            f"among them {some_of(names, 3)}.",
            _plan(identified, _MOTION),
        )


def _joints(which: Mask) -> str:
    places = [str(index + 1) for index in np.flatnonzero(which)]
    return f"Joint{'s' if len(places) > 1 else ''} {', '.join(places)}"
