"""Verifies a calibration with a few new stops, and ranks what may have changed."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.special import fdtrc

from visioncal.calibration.verification.calibration_prior import CalibrationPrior
from visioncal.calibration.verification.change_hypotheses import (
    BOTH,
    CAMERA,
    NOISE,
    REPLACED,
    causes_of,
    kind_of,
)
from visioncal.calibration.verification.prediction import (
    PredictedStops,
    board_changes,
    predict_stops,
)
from visioncal.core.arguments import typed
from visioncal.core.errors import DataError
from visioncal.core.limits import CheckLimits
from visioncal.core.quantiles import f_limit
from visioncal.core.threads import one_blas_thread
from visioncal.core.transforms import log, mean_transform
from visioncal.core.types import FloatArray, Progress
from visioncal.estimation.model_evidence import (
    CalibrationPosterior,
    ChangeHypothesis,
    HypothesisEvidence,
    evidence_of,
    undone,
    with_change,
)
from visioncal.results import Calibration, select_matching
from visioncal.session import Session
from visioncal.session.selecting import Choice

_LIMITS = CheckLimits()
_PAIRS = (BOTH, REPLACED)
# Prior sigma of a board that was moved on purpose, around where it is seen [rad, m].
_ANYWHERE = np.repeat([1.0, 1.0], 3)


@dataclass(frozen=True, eq=False)
class Suspect:
    """A change that may have happened."""

    # `camera`, `board` (with its name where there are several), `joint 3`, `arm_length`,
    # `board_size`, `board_replaced`, `robot_noise`, or `view 7`.
    name: str
    probability: float  # Posterior probability among all changes.
    explained: HypothesisEvidence  # Fit and evidence of the change.


@dataclass(frozen=True, eq=False)
class Check:
    """Result of verifying a calibration with a few new stops."""

    calibration: Calibration  # The calibration.
    predicted: PredictedStops  # The stops.
    prior: CalibrationPrior  # The calibration as a prior.
    # (m, 6) displacement of each board from its calibrated pose, by each observation (rotation
    # [rad], translation [m]), in the board's frame.
    residuals: FloatArray
    remaining: FloatArray  # (m, 6) the same with the likeliest change undone, where one was found.
    log_evidence: float  # Logarithm of the likelihood ratio of any change to none.
    misfit: float  # Squared Mahalanobis distance of the stops from the prediction.
    freedom: int  # Its degrees of freedom.
    p_value: float  # Probability of a misfit at least as large if nothing has changed.
    suspects: tuple[Suspect, ...]  # All changes that were compared, the likeliest first.
    # Changes that cannot be distinguished from the likeliest, which is the first; empty where
    # nothing has changed.
    named: tuple[Suspect, ...]
    explained: bool  # Whether the likeliest change leaves no more residuals than noise.
    # (6,) standard deviations of an estimated motion of the camera, about its axes [rad, m].
    camera_sigma: FloatArray

    @property
    def passed(self) -> bool:
        """Whether the stops agree with the calibration."""
        return bool(self.log_evidence < np.log(_LIMITS.likelihood_ratio))


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
    is_its_own = session.digest() == calibration.session_sha256
    session, calibration = select_matching(session, calibration, Choice(camera, robot, target))
    # Views of its own session that the calibration rejected are rejected here, too.
    without = {view.view: view.reason for view in calibration.views if is_its_own and not view.used}
    prior = CalibrationPrior.of(calibration)
    predicted = predict_stops(session, prior, progress, without)
    return check(predicted, prior, board_placed_anew=board_placed_anew)


def check(
    predicted: PredictedStops, prior: CalibrationPrior, *, board_placed_anew: bool = False
) -> Check:
    """Compares possible changes by the evidence of predicted stops; see `verify`."""
    if board_placed_anew:
        if len(prior.boards) > 1:
            raise DataError(
                "verify: the calibration has several boards; where one was placed anew it is not "
                "known which of them still stand where they were.",
                next_step="Leave --board-moved out: each board is compared by itself, and the one "
                "that moved is named. Or verify with views of the boards that stayed.",
            )
        change = mean_transform(predicted.away(prior))
        prior = prior.with_board_at(prior.state.edges[1] @ change, _ANYWHERE)
    belief = CalibrationPosterior(
        prior.state,
        prior.covariance,
        prior.noise(from_corners=predicted.from_corners),
        prior.freedom,
    )
    causes = causes_of(predicted, prior, board_placed_anew=board_placed_anew)
    with one_blas_thread():
        unchanged = evidence_of(predicted.problem, belief)
        explanations = [evidence_of(predicted.problem, belief, cause) for cause in causes]
    likelihoods = np.array([explained.likelihood for explained in explanations])
    scores = likelihoods + np.log(_prior_probabilities(causes))
    evidence = float(np.logaddexp.reduce(scores))
    order = np.argsort(-scores, kind="stable")
    probabilities = np.exp(scores - evidence)
    suspects = tuple(
        Suspect(causes[index].name, float(probabilities[index]), explanations[index])
        for index in order
    )
    log_evidence = evidence - unchanged.likelihood
    named = () if log_evidence < np.log(_LIMITS.likelihood_ratio) else _not_separated(suspects)
    camera = next(suspect for suspect in suspects if suspect.name == CAMERA)
    changes = remaining = log(predicted.away(prior))
    if named:
        cause = causes[order[0]]
        corrected = undone(predicted.problem, cause, suspects[0].explained.values)
        remaining = log(board_changes(corrected, with_change(belief.state, cause)))
    return Check(
        prior.calibration,
        predicted,
        prior,
        changes,
        remaining,
        log_evidence,
        unchanged.misfit,
        unchanged.freedom,
        float(fdtrc(unchanged.freedom, prior.freedom, unchanged.misfit / unchanged.freedom)),
        suspects,
        named,
        _is_explained(suspects[0], prior.freedom),
        np.sqrt(np.diag(camera.explained.covariance)),
    )


def _prior_probabilities(causes: Sequence[ChangeHypothesis]) -> FloatArray:
    """Prior probabilities of the causes: equal for each kind, and within a kind."""
    kinds = [kind_of(cause.name) for cause in causes]
    return np.array([1.0 / (len(set(kinds)) * kinds.count(kind)) for kind in kinds])


def _not_separated(suspects: Sequence[Suspect]) -> tuple[Suspect, ...]:
    """The likeliest change, and those that explain the stops about as well."""
    # These are about as likely, or fit about as well if it were not for their more unknowns: a
    # turned base looks like a slip of the first joint, however unlikely a turn about just that
    # axis.
    best, *others = suspects
    if kind_of(best.name) in (NOISE, *_PAIRS):
        return (best,)
    margin = 2.0 * np.log(_LIMITS.ruled_out)

    def penalised_misfit(suspect: Suspect) -> float:
        return suspect.explained.misfit + len(suspect.explained.values)

    rivals = [
        rival
        for rival in others
        # Two simultaneous changes can always imitate one of them, and are no rivals.
        if kind_of(rival.name) not in _PAIRS
        and (
            rival.probability * _LIMITS.ruled_out > best.probability
            or (rival.name != NOISE and penalised_misfit(rival) < penalised_misfit(best) + margin)
        )
    ]
    return (best, *rivals)


def _is_explained(best: Suspect, freedom: float) -> bool:
    """Whether a change leaves residuals no larger than noise; true without degrees of freedom."""
    remaining = best.explained.freedom
    if best.name == NOISE or remaining < 1:
        return True
    limit = f_limit(_LIMITS.unexplained, remaining, freedom)
    return bool(best.explained.misfit < remaining * limit)
