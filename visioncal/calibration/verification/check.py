"""Whether a calibration still holds, by a few stops, and what has changed if it does not."""

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
    asked_of_boards,
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
    Belief,
    Cause,
    CauseEvidence,
    explain,
    undone,
    with_change,
)
from visioncal.results import Calibration, picked
from visioncal.session import Session
from visioncal.session.choosing import Choice

_LIMITS = CheckLimits()
_PAIRS = (BOTH, REPLACED)
# A board that was placed anew may lie anywhere near where it is seen [rad and m].
_ANYWHERE = np.repeat([1.0, 1.0], 3)


@dataclass(frozen=True, eq=False)
class Suspect:
    """A change that may have happened.

    Attributes:
        name: `camera`, `board` (with its name where there are several), `joint 3`, `arm_length`,
            `board_size`, `board_replaced`,
            `robot_noise`, or `view 7`.
        probability: Its share among all changes, given the stops.
        explained: What the stops say under it.
    """

    name: str
    probability: float
    explained: CauseEvidence


@dataclass(frozen=True, eq=False)
class Check:
    """What a few stops say about a calibration.

    Attributes:
        calibration: The one that was checked.
        seen: The stops.
        prior_calibration: What the calibration rests on.
        away: (m, 6) where each sight places its board, from where it was (rotation [rad],
            translation [m]), in its frame.
        left: (m, 6) the same with the likeliest change undone, where one was found.
        log_evidence: Logarithm of how many times as likely the stops are with a change as without.
        misfit: Squared distance of the stops from the prediction, in units of sigma.
        freedom: What that is on average where nothing has changed.
        p_value: How often chance makes it at least as large.
        suspects: All changes that were compared, the likeliest first.
        named: Those that cannot be distinguished from the likeliest, itself the first; empty where
            nothing has changed.
        explained: Whether the likeliest leaves no more unexplained than noise does.
        camera_sigma: (6,) standard deviations to which a moved camera would be seen, all about the
            camera's axes [rad, m].
    """

    calibration: Calibration
    seen: PredictedStops
    prior_calibration: CalibrationPrior
    away: FloatArray
    left: FloatArray
    log_evidence: float
    misfit: float
    freedom: int
    p_value: float
    suspects: tuple[Suspect, ...]
    named: tuple[Suspect, ...]
    explained: bool
    camera_sigma: FloatArray

    @property
    def passed(self) -> bool:
        """Whether the calibration still holds as far as the stops show."""
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
    """Checks a calibration by a few new stops of its cell.

    Several threads may do so at once, as with `calibrate`.

    Args:
        session: Five stops or more, with the same board where it was; nothing of it is fitted. It,
            or the path of its folder or recording.
        calibration: The one that is to hold, or the path of its folder or calibration.json.
        camera: Which camera is meant, where session or calibration is of a whole cell.
        robot: Which robot, likewise.
        target: Which target, likewise.
        board_placed_anew: Whether the board was put elsewhere meanwhile, so that its place says
            nothing.
        progress: Told of long work.

    Raises:
        DataError: The session is of another cell, or the calibration does not say enough.
    """
    session = session if isinstance(session, Session) else Session.load(session)
    if not isinstance(calibration, Calibration):
        calibration = Calibration.load(calibration)
    is_its_own = session.digest() == calibration.session_sha256
    session, calibration = picked(session, calibration, Choice(camera, robot, target))
    # What the calibration has left out contradicts it now as it did then.
    without = {view.view: view.reason for view in calibration.views if is_its_own and not view.used}
    prior_calibration = CalibrationPrior.of(calibration)
    seen = predict_stops(session, prior_calibration, progress, without)
    return check(seen, prior_calibration, board_placed_anew=board_placed_anew)


def check(
    seen: PredictedStops, prior_calibration: CalibrationPrior, *, board_placed_anew: bool = False
) -> Check:
    """Compares what may have changed by stops that have been looked at; see `verify`."""
    if board_placed_anew:
        if len(prior_calibration.boards) > 1:
            raise DataError(
                "verify: the calibration has several boards; where one was placed anew it is not "
                "known which of them still stand where they were.",
                next_step="Leave --board-moved out: each board is compared by itself, and the one "
                "that moved is named. Or verify with views of the boards that stayed.",
            )
        moved = mean_transform(seen.away(prior_calibration))
        prior_calibration = prior_calibration.placed_anew(
            prior_calibration.state.edges[1] @ moved, _ANYWHERE
        )
    belief = Belief(
        prior_calibration.state,
        prior_calibration.covariance,
        prior_calibration.noise(from_corners=seen.from_corners),
        prior_calibration.freedom,
    )
    causes = causes_of(seen, prior_calibration, board_placed_anew=board_placed_anew)
    with one_blas_thread():
        nothing = explain(seen.problem, belief)
        found = [explain(seen.problem, belief, cause) for cause in causes]
    scores = np.array([explained.likelihood for explained in found]) + np.log(_shares(causes))
    evidence = float(np.logaddexp.reduce(scores))
    order = np.argsort(-scores, kind="stable")
    shares = np.exp(scores - evidence)
    suspects = tuple(
        Suspect(causes[index].name, float(shares[index]), found[index]) for index in order
    )
    log_evidence = evidence - nothing.likelihood
    named = () if log_evidence < np.log(_LIMITS.likelihood_ratio) else _not_separated(suspects)
    camera = next(suspect for suspect in suspects if suspect.name == CAMERA)
    away = log(seen.away(prior_calibration))
    left = _left(seen, belief, causes[order[0]], suspects[0].explained) if named else away
    return Check(
        prior_calibration.calibration,
        seen,
        prior_calibration,
        away,
        left,
        log_evidence,
        nothing.misfit,
        nothing.freedom,
        float(fdtrc(nothing.freedom, prior_calibration.freedom, nothing.misfit / nothing.freedom)),
        suspects,
        named,
        _is_explained(suspects[0], prior_calibration.freedom),
        np.sqrt(np.diag(camera.explained.covariance)),
    )


def _left(
    seen: PredictedStops, belief: Belief, cause: Cause, explained: CauseEvidence
) -> FloatArray:
    """(m, 6) where each sight places its board with a change undone, from where it was."""
    before = undone(seen.problem, cause, explained.values)
    return log(asked_of_boards(before, with_change(belief.state, cause)))


def _shares(causes: Sequence[Cause]) -> FloatArray:
    """How likely each cause is beforehand: each kind alike, and each of a kind alike."""
    kinds = [kind_of(cause.name) for cause in causes]
    return np.array([1.0 / (len(set(kinds)) * kinds.count(kind)) for kind in kinds])


def _not_separated(suspects: Sequence[Suspect]) -> tuple[Suspect, ...]:
    """The likeliest, and what explains the stops about as well."""
    # That is what is about as likely, and what could explain them but for its more unknowns: a
    # turned base looks like a slip of the first joint, however unlikely a turn about just that
    # axis.
    best, *others = suspects
    if kind_of(best.name) in (NOISE, *_PAIRS):
        return (best,)
    margin = 2.0 * np.log(_LIMITS.ruled_out)

    def price(suspect: Suspect) -> float:
        return suspect.explained.misfit + len(suspect.explained.values)

    rivals = [
        other
        for other in others
        # Two changes at once imitate either: that says nothing against it.
        if kind_of(other.name) not in _PAIRS
        and (
            other.probability * _LIMITS.ruled_out > best.probability
            or (other.name != NOISE and price(other) < price(best) + margin)
        )
    ]
    return (best, *rivals)


def _is_explained(best: Suspect, freedom: float) -> bool:
    """Whether a change leaves no more than noise; one that fits anything cannot be judged."""
    left = best.explained.freedom
    if best.name == NOISE or left < 1:
        return True
    return bool(best.explained.misfit < left * f_limit(_LIMITS.unexplained, left, freedom))
