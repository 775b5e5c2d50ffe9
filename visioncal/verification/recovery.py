"""Recovers a calibration after a knock: what changed is estimated anew, and the rest is kept.

The old calibration predicts where new stops see the board, with a covariance; a change of unknown
size explains the difference, by generalised least squares with that covariance. All else keeps its
estimate and its uncertainty, with which the errors of what is new are then correlated: a consider
covariance (Schmidt 1966). A few stops thus recover what many had determined, but for the change.
"""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import chain
from typing import cast

import numpy as np
from scipy.linalg import block_diag

from visioncal.calibration.run import run
from visioncal.core.errors import DataError
from visioncal.core.limits import CheckLimits, RecoveryLimits
from visioncal.core.number_format import counted, listed, mm_and_deg
from visioncal.core.transforms import adjoint, exp, invert, log, pose_difference
from visioncal.core.types import FloatArray, IntArray
from visioncal.core.verdict import NOTE, Finding, Remedy, Verdict, remarks
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import ROBOT
from visioncal.results import Calibration, Edge, Rms, Validation, ViewResult
from visioncal.results.arm import NOMINAL, ArmLevel, ArmResult
from visioncal.results.sections import FittedArm, FittedStops, NoiseIntervals
from visioncal.results.views import rms_of
from visioncal.robot.arm_model import ArmModel
from visioncal.session import Session
from visioncal.session.frames import edge_names
from visioncal.verification.change_hypotheses import BOARD, BOTH, CAMERA, JOINT, nominal_model
from visioncal.verification.check import Check, PossibleChange, verify
from visioncal.verification.messages import change_words
from visioncal.verification.model_evidence import (
    CalibrationPosterior,
    ChangeHypothesis,
    HypothesisEvidence,
    evidence_of,
)

# Possible causes, as a user says them: the base moved on its foundation, or the flange's mount
# was exchanged, with all that stands on that side of the arm.
BASE, MOUNT = "base", "mount"
_SIDES = {"eye-in-hand": {CAMERA: MOUNT, BOARD: BASE}, "eye-to-hand": {CAMERA: BASE, BOARD: MOUNT}}
_LIMITS = RecoveryLimits()
_RECOVERABLE = (CAMERA, BOARD, JOINT)
_OFFSETS, _CONVERGED, _MOST_STEPS = "offsets", 1e-9, 10


def parted(session: Session) -> tuple[Session, Session]:
    """Stops to find the cause with, and those that are held back for the proof: every third.

    Raises:
        DataError: There are too few.
    """
    stops: dict[int | str, list[int]] = {}
    for view in session.views:
        key = f"view {view.number}" if view.stop is None else view.stop
        stops.setdefault(key, []).append(view.number)
    if len(stops) < _LIMITS.fewest:
        raise DataError(
            f"session {session.name!r} has {counted(len(stops), 'stop')}, and {_LIMITS.fewest} are "
            "needed: a third is held back for the proof, and fewer than the others hardly "
            "distinguish one change from another.",
            culprits=[session.name],
            next_step="Record more of them.",
        )
    each = _LIMITS.held_back_each
    held = {*chain.from_iterable([*stops.values()][each - 1 :: each])}
    views = {view.number for view in session.views}
    return session.only(sorted(views - held)), session.only(sorted(held))


def causes_found(check: Check) -> tuple[str, ...]:
    """The change by the check alone; empty where it is not one that can be recovered."""
    if len(check.named) != 1:
        return ()
    cause = check.named[0].cause
    if cause.kind == BOTH:
        # A check takes large motions of both to first order: the proof says whether they explain.
        return CAMERA, replace(cause, kind=BOARD).name
    return (cause.name,) if check.explained and cause.kind in _RECOVERABLE else ()


def recover(
    session: Session, old: Calibration, causes: Sequence[str], check: Check | None = None
) -> Calibration:
    """Recovers a calibration by new stops, with a proof by those that are held back.

    The result itself is then estimated from all stops.

    Args:
        session: The stops.
        old: The calibration before the change.
        causes: Parts that changed: see `changed`; empty for a calibration by the new stops alone.
        check: The check of the first part of `parted`, where `causes` are given.

    Returns:
        The calibration; its verdict has the change and the proof, and is bad where that fails.

    Raises:
        DataError: A cause is not possible here, or the stops give no calibration.
    """
    before, without, digest = old.validation.held_out, "", session.digest()
    warnings: tuple[str, ...] = ()
    if check is not None and old.robot is not None and session.robot_document is not None:
        # The checked session may name the arm as it was: a recording by a plan of that does.
        session = replace(session, robot_document=old.robot.document)
    fit, held = parted(session)
    if causes and check is not None:
        proof, whole = verify(held, changed(check, causes, before)[0]), verify(session, old)
        off, back = rms_of(_seen(proof, proof.residuals)), proof.predicted.views
        new, words = changed(whole, causes, off)
        unrecovered = rms_of(at for at in _seen(whole, whole.residuals) if at.view in back)
        without, warnings = f" {unrecovered.words} without recovering;", whole.predicted.warnings
    else:
        proof, new = verify(held, run(fit).calibration), run(session).calibration
        off = rms_of(_seen(proof, proof.residuals))
        words = f"all of it, by {counted(len(session.views), 'view')} alone"
    passed = proof.passed and proof.p_value >= CheckLimits.unexplained
    step = "Use it in place of the old one: the next visioncal verify compares with it."
    found = Finding(
        "recovered",
        f"Recovered from {old.session_name}: {words}. "
        f"{counted(len(proof.predicted.views), 'stop')} held back from a first estimate "
        f"{'agree' if passed else 'disagree'} with its sigmas (p = {proof.p_value:.2g}): off by "
        f"{off.words} (rms);{without} before the change left-out stops were off by {before.words}.",
        Remedy(step if passed else "Look for what else changed, and calibrate again."),
    )
    # Praise and advice were of the old stops; doubts remain.
    doubts = () if new.verdict.status == "good" else new.verdict.findings
    doubts = tuple(replace(doubt, do=None) for doubt in doubts)
    rivals = [
        f"Stops cannot show whether the {side} moved instead, which targets, tools and fixtures of "
        f"that side have to follow: if it did, say --cause {side}."
        for side in sorted({*along(old, causes)} - {*causes})
    ]
    findings = (found, *remarks(rivals, NOTE), *doubts, *remarks(warnings, NOTE))
    verdict = Verdict(new.verdict.status if passed else "bad", findings)
    return replace(new, session_sha256=digest, verdict=verdict)


def changed(check: Check, causes: Sequence[str], off: Rms) -> tuple[Calibration, str]:
    """Estimates what changed from the stops of a check; the old calibration keeps the rest.

    Args:
        check: The check of the stops.
        causes: Parts that changed: `camera`, `board` (with its name, of several), `joint 3`; `base`
            or `mount` where the fixed board or camera, or what the flange carries, moved with
            everything on its side of the arm.
        off: Residuals of stops that are held back.

    Returns:
        The calibration, with the old one's verdict; and the changes in words.

    Raises:
        DataError: One of them is not possible here.
    """
    old, prior, fit = check.calibration, check.prior, check.prior.fit
    possible = {at.name: at.cause for at in check.compared if at.cause.kind in _RECOVERABLE}
    names = parts_changed(old, causes, possible)
    joints = [name for name in names if possible[name].kind == JOINT]
    # Causes of edges come first.
    chosen = sorted((possible[name] for name in names), key=lambda cause: cause.kind == JOINT)
    moved = [0 if at.kind == CAMERA else 1 + at.at for at in chosen if at.kind != JOINT]
    problem, belief, found, offset = _estimated(check, chosen, moved)
    covariance, edges, fitted, arm = belief.covariance, belief.state.edges, fit.arm, old.arm
    observed, residuals = check.predicted.observed, problem.linear(belief.state).residuals
    numbers, seen = [at.number for at in observed.session.views], _seen(check, residuals)
    views = {at: ViewResult(at, used=False, reason=observed.reasons.get(at, "")) for at in numbers}
    views |= {view.view: view for view in seen}
    rms, size = rms_of(seen), 6 * len(edges)
    columns, units = _columns(moved), np.ones(len(found.values))
    if joints:
        gain = check.unchanged.deviance - found.deviance
        fitted, arm, column, units[-1] = _slipped(check, chosen[-1].at, offset, (rms, off), gain)
        columns = np.append(columns, column)
        # An arm without offsets gets them all, without uncertainty but for that of this joint.
        added = len(fitted.values) - (0 if fit.arm is None else len(fit.arm.values))
        covariance = np.pad(covariance, (0, added))
    # The errors of what changed are those of the old estimate, and of the change.
    by_change, mixed = np.zeros((len(covariance), len(units))), np.zeros_like(covariance)
    by_change[columns, np.arange(len(units))] = 1.0 / units
    mixed[:, : found.with_unknowns.shape[1]] = by_change @ found.with_unknowns
    covariance = covariance + mixed + mixed.T + by_change @ found.covariance @ by_change.T
    # The errors of what is new are taken as independent of the lens's errors beyond its model.
    kept = np.diag(np.where(by_change[:size].any(axis=1), 0.0, 1.0))
    lens = old.camera and old.camera.carried(kept)
    if lens is not None and lens.edge_covariance is not None:
        rows = [at for at in fit.looks if at < len(lens.edge_covariance)]
        lens.edge_covariance[rows] = covariance[size : size + len(rows), :size]
    stops = FittedStops(
        views=check.predicted.views,
        boards=tuple(check.predicted.boards.tolist()),
        poses=log(problem.poses[ROBOT][problem.observations.stops]),
        residuals=np.round(residuals, 9),
        # All of the covariance counts as noise: the safe assumption is that none repeats itself.
        by_noise=covariance,
    )
    new = replace(
        old,
        session_name=observed.session.name,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        edges={
            name: Edge(edge, covariance[6 * at : 6 * at + 6, 6 * at : 6 * at + 6])
            for at, (name, edge) in enumerate(zip(old.edges, edges, strict=True))
        },
        joint_covariance=covariance[:size, :size],
        camera=lens,
        joint_fit=replace(fit, arm=fitted, covariance=covariance, stops=stops),
        arm=arm,
        views=tuple(views.values()),
        rms=rms,
        validation=Validation("stops that were held back", off),
        # The solvers' results are of the old stops.
        solvers={},
        need=None,
        touch_test=None,
        uncertainty=old.uncertainty and NoiseIntervals(noise_95=old.uncertainty.noise_95),
    )
    base_moved, flange_moved = moved_along(old, new, causes)
    frames = {
        name: replace(frame, edge=Edge(moved @ frame.edge.matrix, frame.edge.covariance))
        for name, frame in old.frames.items()
        for moved in [invert(flange_moved) if name.startswith("flange") else base_moved]
    }
    values, words = np.append(log(invert(prior.state.edges) @ edges)[moved], offset), []
    for at, cause in enumerate(chosen):
        part = slice(6 * at, 6 * at + len(cause.units))
        single_change = replace(found, values=values[part], covariance=found.covariance[part, part])
        (side,) = along(old, [cause.name])
        by = pose_difference(np.eye(4), flange_moved if side == MOUNT else base_moved)
        cause_words = change_words(check, PossibleChange(cause, 1.0, single_change))
        words.append(
            cause_words if cause.name in causes else f"the {side} moved by {mm_and_deg(*by)}"
        )
    return replace(new, frames=frames), "; ".join(words)


def along(old: Calibration, causes: Iterable[str]) -> tuple[str, ...]:
    """The causes if not a camera or board alone moved, but the base or mount with all on it."""
    return tuple(_SIDES[old.mount].get(at.partition(" ")[0], at) for at in causes)


def parts_changed(old: Calibration, causes: Sequence[str], shown: Iterable[str] = ()) -> set[str]:
    """The changes of `causes`, among those that stops show, or else all that a calibration has.

    Raises:
        DataError: One of them is not possible here.
    """
    fit, robot = old.joint_fit, old.calibrated_robot
    boards = [f"{BOARD} {name}".strip() for name in (fit and fit.boards) or ("",)]
    joints = [f"{JOINT} {at + 1}" for at in range(robot.joint_count if robot else 0)]
    possible = [*shown] or [CAMERA, *boards, *joints]
    parts = {side: part for part, side in _SIDES[old.mount].items()}
    names = {parts.get(name, name) for name in causes}
    if len(names) < len(causes) or not names <= {*possible} or len(names & {*joints}) > 1:
        raise DataError(
            f"--cause {listed(causes)}: what can be recovered here is "
            f"{listed([*possible, BASE, MOUNT])}, each motion once and one joint.",
            culprits=["--cause"],
            next_step="A joint needs joint angles and the robot's model; of several boards each "
            "has its own name.",
        )
    return names


def _columns(edges: Sequence[int]) -> IntArray:
    """Columns of edges among the unknowns."""
    return (6 * np.array(edges, dtype=int)[:, None] + np.arange(6)).ravel()


def _seen(check: Check, residuals: FloatArray) -> list[ViewResult]:
    """Results of the views of a check, with (m, 6) residuals [rad, m]."""
    deg, mm = (np.linalg.norm(residuals.reshape(-1, 2, 3), axis=2) * (180 / np.pi, 1e3)).T.tolist()
    figures = zip(check.predicted.views, mm, deg, strict=True)
    return [ViewResult(at, used=True, residual_mm=mm, residual_deg=deg) for at, mm, deg in figures]


def _estimated(
    check: Check, chosen: Sequence[ChangeHypothesis], moved: Sequence[int]
) -> tuple[Problem, CalibrationPosterior, HypothesisEvidence, float]:
    """Estimates simultaneous changes: of these edges, then of at most one joint.

    Returns:
        The stops and the old calibration after the change; its evidence, with the remaining values
        of about zero; and the joint's offset [rad].
    """
    prior, problem, offset = check.prior, check.predicted.problem, 0.0
    size, columns = 6 * len(prior.state.edges), _columns(moved)

    def side(parts: Iterable[FloatArray | None], count: int) -> FloatArray:
        none = [np.zeros((count, 6, len(cause.units))) for cause in chosen]
        found = [zero if part is None else part for part, zero in zip(parts, none, strict=True)]
        return np.concatenate(found, axis=2)

    by_flange = side((cause.flange_jacobian for cause in chosen), len(problem.poses[ROBOT]))
    by_sensor = side((cause.by_sensor for cause in chosen), len(problem))
    units = np.concatenate([cause.units for cause in chosen])
    together = ChangeHypothesis("all", units, by_sensor, by_flange)
    belief = prior.belief(problem, check.predicted.boards)
    # Changed frames are moved step by step until the last step is zero, which takes simultaneous
    # motions exactly.
    for _ in range(_MOST_STEPS):
        found = evidence_of(problem, belief, together)
        twists, carried = np.zeros(size), np.eye(len(belief.covariance))
        twists[columns] = found.values[: len(columns)]
        offset += float(found.values[len(columns) :].sum())
        steps = exp(twists.reshape(-1, 6))
        carried[:size, :size] = block_diag(*adjoint(invert(steps)))
        poses = problem.poses[ROBOT] @ exp(by_flange @ found.values)
        problem, again = replace(problem, poses={ROBOT: poses}), belief.repeated
        belief = replace(
            belief,
            state=replace(belief.state, edges=belief.state.edges @ steps),
            covariance=carried @ belief.covariance @ carried.T,
            repeated=again and replace(again, by_noise=carried @ again.by_noise @ carried.T),
        )
        if np.abs(found.values).max() < _CONVERGED:
            break
    return problem, belief, found, offset


def _slipped(
    check: Check, joint: int, offset: float, residuals: tuple[Rms, Rms], gain: float
) -> tuple[FittedArm, ArmResult, int, float]:
    """The arm with a joint's offset [rad], in its own parameters.

    Args:
        check: The check of the stops.
        joint: Index of the joint.
        offset: Its offset [rad].
        residuals: Those of the stops, and of stops that are held back.
        gain: Twice the gain in log-likelihood.

    Returns:
        The errors of its fit, and its section; the column of the joint's offset in the covariance,
        and its unit [rad].
    """
    old, model = check.calibration, check.prior.model
    fitted = check.prior.fit.arm or FittedArm(of="model", values=np.zeros(0))
    if model is None:
        # Errors of the nominal arm's links, where it has any, are no part of it.
        links = {"links": 1.0} if len(fitted.values) else {}
        nominal = cast("ArmModel", nominal_model(check.predicted, check.prior))
        model = replace(nominal, weights=links, values=np.zeros(len(fitted.values)))
    functions = np.zeros((model.nominal.joint_count, 4))
    functions[joint, 0] = offset
    robot = model.robot.corrected(functions=functions)
    more = np.zeros(0 if _OFFSETS in model.weights else len(functions))
    weights = {**model.weights, _OFFSETS: model.weights.get(_OFFSETS, 1.0)}
    first = len(check.prior.covariance) - len(fitted.values)
    first += replace(model, weights=weights).columns_of(_OFFSETS).start
    fitted = replace(
        fitted,
        of="model",
        values=np.append(fitted.values, more),
        weights=weights,
        flange_from_reported=model.flange_from_reported,
        by_stop=None if fitted.by_stop is None else np.append(fitted.by_stop, more),
    )
    if old.arm is not None and old.arm.is_calibrated:
        # Its table of parameters is that of before.
        arm = replace(old.arm, robot=robot, parameters=())
        return fitted, arm, first + joint, weights[_OFFSETS]
    (rms, off), mm = residuals, old.rms.mm
    before = ArmLevel(level=NOMINAL, unknowns=0, rms_mm=mm, held_out_mm=mm, likelihood_ratio=0.0)
    slipped = ArmLevel(
        level=_OFFSETS, unknowns=1, rms_mm=rms.mm, held_out_mm=off.mm, likelihood_ratio=gain
    )
    levels = (old.arm.nominal if old.arm else before, slipped)
    return fitted, ArmResult(level=_OFFSETS, levels=levels, robot=robot), first + joint, 1.0


def moved_along(
    old: Calibration, new: Calibration, causes: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Motions (4, 4) by which targets follow a base or mount that moved with all on its side.

    Returns:
        That of poses in the base, on the left; and that of poses of the flange, on the right.
    """
    moved = {BASE: np.eye(4), MOUNT: np.eye(4)}
    for side, name in zip(_SIDES[old.mount].values(), edge_names(old.mount), strict=True):
        if side in causes:
            before, after = old.edges[name].matrix, new.edges[name].matrix
            # The flange goes where its tool is where it was.
            moved[side] = after @ invert(before) if side == BASE else before @ invert(after)
    return moved[BASE], moved[MOUNT]
