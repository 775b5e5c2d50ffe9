"""Verifies a calibration with a few new stops, and ranks what may have changed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import fdtrc

from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.limits import CheckLimits
from visioncal.core.number_format import figure, listed
from visioncal.core.quantiles import f_limit
from visioncal.core.summaries import text_card
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import log, mean_transform
from visioncal.core.types import FloatArray, Progress
from visioncal.core.verdict import DEPTH_CHANGED, Finding
from visioncal.results import Calibration, select_matching
from visioncal.results.evidence import ViewEvidence
from visioncal.session import Session
from visioncal.session.selecting import Choice
from visioncal.verification.calibration_prior import CalibrationPrior
from visioncal.verification.change_hypotheses import (
    CAMERA,
    LENGTH,
    NOISE,
    PAIRS,
    causes_of,
    prior_chances,
)
from visioncal.verification.misreading import misreading
from visioncal.verification.model_evidence import (
    ChangeHypothesis,
    HypothesisEvidence,
    evidence_of,
    undone,
    with_change,
)
from visioncal.verification.prediction import PredictedStops, board_changes, predict_stops

_LIMITS = CheckLimits()


@dataclass(frozen=True, eq=False)
class PossibleChange:
    """A change that may have happened."""

    cause: ChangeHypothesis
    probability: float  # Posterior probability among all changes.
    explained: HypothesisEvidence  # Fit and evidence of the change.

    @property
    def name(self) -> str:
        """Kind of the change and its part: `camera`, `board NAME`, `joint 3`, `view 7` ..."""
        return self.cause.name

    @property
    def is_possible(self) -> bool:
        """Whether an arm can have grown by so much, where that is the change."""
        # Greatest share by which an arm grows, four times as by 100 K of aluminium.
        return self.cause.kind != LENGTH or abs(self.explained.values[0]) < 0.01


@dataclass(frozen=True, eq=False)
class Check:
    """Result of verifying a calibration with a few new stops."""

    predicted: PredictedStops  # The stops.
    prior: CalibrationPrior  # The calibration as a prior.
    # (m, 6) displacement of each board from its calibrated pose, by each observation (rotation
    # [rad], translation [m]), in the board's frame.
    residuals: FloatArray
    remaining: FloatArray  # (m, 6) the same with the likeliest change undone, where one was found.
    repeated: int  # Number of the calibration's stops that are repeated.
    unchanged: HypothesisEvidence  # Fit and evidence without a change.
    p_value: float  # Probability of a misfit at least as large if nothing has changed.
    compared: tuple[PossibleChange, ...]  # All changes that were compared, the likeliest first.
    # Changes that cannot be distinguished from the likeliest, which is the first; empty where
    # nothing has changed.
    named: tuple[PossibleChange, ...]
    explained: bool  # Whether the likeliest change leaves no more residuals than noise.
    misread: Finding | None = None  # Misreading of the poses that explains what no change does.
    depth: tuple[Finding, ...] = ()  # Whether depth still is what it was, where there is some.

    def __repr__(self) -> str:
        names = [change.name for change in self.named]
        names += ["the reading of poses"] * (self.misread is not None)
        names += ["depth"] * any(found.kind == DEPTH_CHANGED for found in self.depth)
        changed = listed(names or ["nothing" if self.passed else "unknown"], "or")
        facts = {"stops": f"{self.predicted.stops}", "may have changed": changed}
        facts["as large a misfit by chance"] = figure(self.p_value)
        holds = "holds" if self.passed else "does not hold"
        return text_card(f"Check of {self.calibration.session_name!r}: {holds}", facts)

    @property
    def calibration(self) -> Calibration:
        """The calibration."""
        return self.prior.calibration

    @property
    def agrees(self) -> bool:
        """Whether the stops agree with the calibration."""
        return not self.named and self.misread is None and self.p_value >= _LIMITS.unexplained

    @property
    def passed(self) -> bool:
        """Whether the stops agree with the calibration, and their depth."""
        return self.agrees and all(found.kind != DEPTH_CHANGED for found in self.depth)

    @property
    def camera_sigma(self) -> FloatArray:
        """(6,) standard deviations of an estimated motion of the camera [rad, m]."""
        camera = next(change for change in self.compared if change.name == CAMERA)
        return np.sqrt(np.diag(camera.explained.covariance))


@typed
def verify(
    session: Session | Path | str,
    calibration: Calibration | Path | str,
    *,
    camera: str | None = None,
    robot: str | None = None,
    target: str | None = None,
    board_placed_anew: bool = False,
    progress: Progress | None = None,
) -> Check:
    """Verifies a calibration with a few new stops of its cell; nothing is refitted.

    Several threads may verify at once, as with `calibrate`.

    Args:
        session: Five stops or more with the same board at the same place; a session, or the path
            of its folder or recording.
        calibration: The calibration, or the path of its folder or calibration.json.
        camera: The camera's name, where session or calibration is of a whole cell.
        robot: The robot's name, likewise.
        target: The target's name, likewise.
        board_placed_anew: Whether the board was moved on purpose, so that its pose is not checked.
        progress: Called with the progress of long work.

    Raises:
        DataError: The session is of another cell, or the calibration does not contain its fit.
    """
    session = session if isinstance(session, Session) else Session.load(session)
    if not isinstance(calibration, Calibration):
        calibration = Calibration.load(calibration)
    is_calibrated = session.digest() == calibration.session_sha256
    session, calibration = select_matching(session, calibration, Choice(camera, robot, target))
    # Views of its own session that the calibration rejected are rejected here, too.
    without = {
        view.view: view.reason for view in calibration.views if is_calibrated and not view.used
    }
    prior = CalibrationPrior.of(calibration)
    predicted = predict_stops(session, prior, progress, without)
    found = check(
        predicted, prior, board_placed_anew=board_placed_anew, with_repeats=not is_calibrated
    )
    if not any(view.depth for view in session.views):
        return found
    # Few sessions have depth.
    from visioncal.calibration.stages.depth import depth_now

    seen = {
        view: ViewEvidence(view, pose.corners, cam_from_target=pose.cam_from_target[0])
        for view, pose in predicted.observed.poses.items()
    }
    return replace(found, depth=depth_now(calibration, session, seen))


def check(
    predicted: PredictedStops,
    prior: CalibrationPrior,
    *,
    board_placed_anew: bool = False,
    with_repeats: bool = True,
) -> Check:
    """Compares possible changes by the evidence of predicted stops; see `verify`.

    Args:
        predicted: The stops.
        prior: The calibration as a prior.
        board_placed_anew: Whether the board was moved on purpose.
        with_repeats: Whether stops near calibrated ones are compared with these: they are others.
    """
    problem, boards = predicted.problem, predicted.boards if with_repeats else None
    if board_placed_anew:
        if len(prior.boards) > 1:
            raise DataError(
                "verify: the calibration has several boards; where one was placed anew it is not "
                "known which of them still stand where they were.",
                next_step="Leave --board-moved out: each board is compared by itself, and the one "
                "that moved is named. Or verify with views of the boards that stayed.",
            )
        x, z = prior.state.edges
        seen = replace(prior.state, edges=np.stack([x, z @ mean_transform(predicted.away(prior))]))
        covariance = prior.covariance.copy()
        covariance[6:12], covariance[:, 6:12] = 0.0, 0.0
        # Prior sigma of a board that was moved on purpose, around where it is seen [rad and m].
        covariance[6:12, 6:12] = np.eye(6)
        prior, boards = replace(prior, state=seen, covariance=covariance), None
    belief = prior.belief(problem, boards)
    causes = causes_of(predicted, prior, board_placed_anew=board_placed_anew)
    with one_blas_thread():
        unchanged = evidence_of(problem, belief)
        explanations = [evidence_of(problem, belief, cause) for cause in causes]
    likelihoods = np.array([explained.likelihood for explained in explanations])
    scores = likelihoods + np.log(prior_chances(causes))
    evidence = float(np.logaddexp.reduce(scores))
    compared = tuple(
        PossibleChange(causes[index], float(np.exp(scores[index] - evidence)), explanations[index])
        for index in np.argsort(-scores, kind="stable")
    )
    is_changed = evidence - unchanged.likelihood >= np.log(_LIMITS.likelihood_ratio)
    p_value = float(fdtrc(unchanged.freedom, prior.freedom, unchanged.misfit / unchanged.freedom))
    best, freedom = compared[0], compared[0].explained.freedom
    # Without degrees of freedom, or by larger noise, everything is explained.
    limit = f_limit(_LIMITS.unexplained, freedom, prior.freedom) if freedom > 0 else np.inf
    is_noise = best.cause.kind == NOISE
    is_explained = is_noise or best.explained.misfit < max(freedom, 1) * limit
    is_cell = is_explained and not is_noise and best.is_possible
    is_open = not is_cell if is_changed else p_value < _LIMITS.unexplained
    misread = misreading(predicted.run) if is_open else None
    named = _not_separated(compared) if is_changed and misread is None else ()
    changes = remaining = log(predicted.away(prior))
    if named:
        likeliest = named[0].cause
        corrected = undone(problem, likeliest, named[0].explained.values)
        remaining = log(board_changes(corrected, with_change(belief.state, likeliest)))
    return Check(
        predicted,
        prior,
        changes,
        remaining,
        0 if belief.repeated is None else len(belief.repeated.repeats),
        unchanged,
        p_value,
        compared,
        named,
        bool(is_explained),
        misread,
    )


def _not_separated(compared: Sequence[PossibleChange]) -> tuple[PossibleChange, ...]:
    """The likeliest change, and those that explain the stops about as well."""
    # These are about as likely, or fit about as well if it were not for their more unknowns: a
    # turned base looks like a slip of the first joint, however unlikely a turn about just that
    # axis.
    best, *others = compared
    if best.cause.kind in (NOISE, *PAIRS):
        return (best,)

    def penalised(change: PossibleChange) -> float:
        return change.explained.deviance + len(change.explained.values)

    most = penalised(best) + 2.0 * np.log(_LIMITS.ruled_out)
    rivals = [
        rival
        for rival in others
        # Two simultaneous changes can always imitate one of them, and are no rivals.
        if rival.cause.kind not in PAIRS
        and (
            rival.probability * _LIMITS.ruled_out > best.probability
            or (rival.cause.kind != NOISE and penalised(rival) < most)
        )
    ]
    return (best, *rivals)
