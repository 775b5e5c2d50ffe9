"""Sequential test of a calibration's residuals: has anything changed, what, by how much, and when?

A look's residual is `r = A x + b + H change + noise`. The state x has what is no fault: the
calibration's own errors (constant, of its covariance), motions of the frames over hours (an
Ornstein-Uhlenbeck process), changes that were acknowledged, and the joints' zeros; b is the arm's
error at a posture, where it stands again and again. A Kalman filter predicts the next look; its
innovations are white while nothing changes. A change at look k adds `(H - A F_k) change` to the
later ones; F_k, by which the filter follows it, has a recursion (Willsky and Jones 1976). The last
looks, and older ones at growing distances, are candidates (the window of Lai 1995, 1998): an update
costs the same after any history, and its state is small.

The statistic is that of Shiryaev and Roberts (Pollak 1987): the sum, over candidates, of the
likelihood ratio of a change there to none, averaged over causes and sizes as in `verify`. If
innovations were as modelled, it would grow by one a look in the mean, and the mean number of looks
to a false alarm would be about its limit. Therefore the noise, the share of the arm's error that is
new at a known posture, and the size of slow motions are learned; these by the innovations'
correlation with the motion that was predicted, which is none if it is as large as supposed (Mehra
1970). The influence of an innovation is bounded (Huber 1964), however wrong a look is.

Looks that are off by more than linear rows can say are counted alone: after a change of that size
nearly every look is so, and otherwise one of 200.

Events that no model has, as a machine that is off at weekends, give the statistic a heavier tail.
It is a power of the limit (in simulated cells with exponents of 0.6 to 1.3), as of the maxima of
many sequences (Hill 1975): how often two small limits are passed is counted, and the limit of the
stated rate extrapolated from them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from hashlib import sha256

import numpy as np

from visioncal.core.quantiles import chi2_limit
from visioncal.core.transforms import LEVER_M
from visioncal.core.types import FloatArray
from visioncal.robot.errors import SIZES_M

# Sizes of changes, as the mean squared shift of one look in units of its noise. Larger ones are
# found as soon, as looks have a bounded influence.
_SHIFTS = np.array([0.1, 0.6, 4.0])
# Squared shift of all looks together below which a change is not shown.
_SHOWN = 1e-3
# Prior size of a change in its estimate, and of one that is acknowledged [m]: hardly any.
_WIDEST_M = 0.1
# Squared length of an innovation that noise exceeds in one look of a hundred: the largest that
# counts in full.
_FAR = float(chi2_limit(0.01, 6))
# The likelihood of noise as unlikely as a wrong look: one of 200, over lengths of centimetres.
_WRONG = 60.0
# Rotation [rad] and distance [m] of a residual beyond which its rows say nothing, and the log
# likelihood ratio of such a look, and inverse of any other, after a change of that size to none.
_BEYOND, _LOG_BEYOND = np.array([0.5, 1.0]), float(np.log(200.0))
# Looks by which the noise is known at first.
_STATED = 200.0
# Small limits of the statistic; the looks by which it is known at first that each is passed as
# often as it should be, and those that are remembered.
_LEVELS, _SUPPOSED, _REMEMBERED = np.array([20.0, 200.0]), 2000.0, 20_000.0
# Postures that are kept.
_PLACES = 64
# Time constant of slow motions [s]: of hours, and fast enough for the day's.
_SLOW_S = 6 * 3600.0


@dataclass(frozen=True, eq=False)
class LookRows:
    """One look, linearised."""

    time_s: float  # When it was taken [s].
    residual: FloatArray  # (6,) `log(predicted^-1 measured)`.
    covariance: FloatArray  # (6, 6) of its noise by the calibration, but for the arm's.
    by_edges: FloatArray  # (6, e) Jacobian by the frames, with what the lens follows of them.
    by_motion: FloatArray  # (6, e) Jacobian by motions of the frames.
    by_joints: FloatArray  # (6, n) Jacobian by the joints' zeros; n is 0 without joint angles.
    posture: FloatArray  # (12,) features of the arm's posture, whose distance is in radians.
    by_arm: FloatArray  # (6, 6) covariance of the arm's error at the posture, by the calibration.


@dataclass(frozen=True, eq=False)
class ChangeKind:
    """A cause that the test compares."""

    name: str  # `camera`, `board NAME`, `joint 3`, or `none of these`.
    columns: tuple[int, ...]  # Its changes among those of frames and joints; none beyond rows.
    prior: float  # Prior probability.


@dataclass(frozen=True, eq=False)
class Detector:
    """State of the test; all that is needed to go on after a restart."""

    time_s: FloatArray  # () time of the last look [s].
    looks: FloatArray  # () number of looks.
    # (p,) state: frames, their slow motions, what is taken as moved of them, joints' zeros.
    mean: FloatArray
    covariance: FloatArray  # (p, p).
    shape: FloatArray  # (6, 6) covariance of the noise in units of the stated.
    fresh: FloatArray  # () share of the arm's error that is new at a known posture, in variance.
    slow: FloatArray  # (e,) variances of the frames' slow motions.
    forecast: FloatArray  # (b,) mean squared shift of a look by each frame's predicted motion.
    postures: FloatArray  # (s, 12) features of the postures at which the arm stood.
    stood: FloatArray  # (s,) looks at each; 0 of a free place.
    offsets: FloatArray  # (s, 6) error of the arm at each, as it shows in looks.
    offsets_covariance: FloatArray  # (s, 6, 6) of these.
    usual: FloatArray  # (d, d) mean information of one look on a change.
    # For each of c candidates: the look's number, the times of the last look before it and of
    # itself [s], and the number of looks that it stands for.
    born: FloatArray  # (c, 4).
    follows: FloatArray  # (c, p, d) F: what the filter takes of a change into its state.
    information: FloatArray  # (c, d, d) on the change, by innovations of bounded influence.
    gradient: FloatArray  # (c, d).
    raw_information: FloatArray  # (c, d, d) the same by the innovations that it may explain.
    raw_gradient: FloatArray  # (c, d).
    # (c,) by how much these exceed, in log likelihood ratio, those of a look that may be wrong.
    excess: FloatArray
    # (c,) looks that are off beyond their rows, less the others; and with those that are far off
    # and that the change does not explain.
    beyond: FloatArray
    raw_beyond: FloatArray
    # (2, 2) by small limits: the looks when each was last passed, and how often in a look it is.
    passed: FloatArray = field(default_factory=lambda: np.array([np.zeros(2), 1.0 / _LEVELS]))

    @classmethod
    def of(cls, edges: FloatArray, slow_m: float, joints_rad: FloatArray) -> "Detector":
        """Starts the test.

        Args:
            edges: (e, e) covariance of the calibrated frames.
            slow_m: Standard deviation of a frame's slow motions [m].
            joints_rad: (n,) standard deviations of the joints' zeros; empty without joint angles.
        """
        count, changes = len(edges), len(edges) + len(joints_rad)
        size = 2 * count + changes
        slow = np.tile(np.repeat([slow_m / LEVER_M, slow_m], 3), count // 6)
        none = np.zeros(count)
        covariance = np.diag(np.concatenate([none, slow, none, joints_rad]) ** 2)
        covariance[:count, :count] = edges
        shapes = ((_PLACES, 12), _PLACES, (_PLACES, 6), (_PLACES, 6, 6), (changes, changes))
        candidates = ((4,), (size, changes), *((changes, changes), (changes,)) * 2, (), (), ())
        # Share of the arm's error that is new, at first. Squared forecast that is supposed at
        # first.
        return cls(
            *(np.zeros(()), np.zeros(()), np.zeros(size), covariance, np.eye(6)),
            *(np.array(0.4), slow**2),
            np.full(count // 6, 0.1),
            *(np.zeros(shape) for shape in shapes),
            *(np.zeros((0, *shape)) for shape in candidates),
        )

    def without_candidates(self) -> "Detector":
        """The state of the test so far, with no change supposed."""
        none = {name: getattr(self, name)[:0] for name in CANDIDATE}
        return replace(self, **none)

    def digest(self) -> str:
        """The sha256 of the rows' numbers."""
        return sha256(b"".join(values.tobytes() for values in vars(self).values())).hexdigest()


# Fields of a detector with a row for each candidate.
_SUMS = ("information", "gradient", "raw_information", "raw_gradient", "excess")
CANDIDATE = ("born", "follows", *_SUMS, "beyond", "raw_beyond")


def step(state: Detector, rows: LookRows, *, is_learning: bool) -> Detector:
    """The state after one more look.

    Args:
        state: State before it.
        rows: The look; no earlier than the last.
        is_learning: Whether noise and slow motions are learned, and a change may begin with this
            look: not after an alarm.
    """
    edges, count = rows.by_edges.shape[1], float(state.looks)
    before_s = float(state.time_s) if count else rows.time_s
    motions, motion = slice(edges, 2 * edges), np.ones(len(state.mean))
    motion[motions] = np.exp((before_s - rows.time_s) / _SLOW_S)
    mean, covariance = motion * state.mean, motion[:, None] * state.covariance * motion
    covariance[motions, motions] += (1.0 - motion[edges] ** 2) * np.diag(state.slow)
    first = np.array([[count, before_s, rows.time_s, 1.0]])
    grown = {"born": np.concatenate([state.born, first[: int(is_learning)]])}
    for name in CANDIDATE[1:]:
        held = getattr(state, name)
        grown[name] = np.concatenate([held, np.zeros((int(is_learning), *held.shape[1:]))])
    # Candidates for the look of the change.
    if len(grown["born"]) > 14:
        _thin(grown, count)
    follows = motion[:, None] * grown["follows"]
    is_beyond = bool((np.linalg.norm(rows.residual.reshape(2, 3), axis=1) > _BEYOND).any())
    for name in ("beyond", "raw_beyond"):
        grown[name] += 1.0 if is_beyond else -1.0
    now = {"time_s": np.array(rows.time_s), "looks": np.array(count + 1.0)}
    if is_beyond:
        grown["follows"] = follows
        return replace(state, **now, mean=mean, covariance=covariance, **grown)
    change = np.concatenate([rows.by_motion, rows.by_joints], axis=1)
    design = np.concatenate([rows.by_edges, rows.by_motion, change], axis=1)
    at, places = _place(state, rows)
    offset_covariance, root = places["offsets_covariance"][at], np.linalg.cholesky(rows.covariance)
    seen, part = design @ covariance, root @ state.shape @ root.T
    noise = part + state.fresh * rows.by_arm
    by_look = offset_covariance + noise
    whiten = np.linalg.inv(np.linalg.cholesky(seen @ design.T + by_look))
    white = whiten @ (rows.residual - design @ mean - places["offsets"][at])
    squared = float(white @ white)
    share = min(1.0, float(np.sqrt(_FAR / max(squared, 1e-12))))
    clipped = share * white
    # Gains on whitened innovations.
    gain, offset_gain = (whiten @ seen).T, (whiten @ offset_covariance).T
    signature = whiten @ (change - design @ follows)
    turned = np.swapaxes(signature, 1, 2)
    products, accepted = turned @ signature, np.ones(len(follows))
    if squared > _FAR:
        accepted = _explained(white, signature, grown["raw_information"], grown["raw_gradient"])
    grown["follows"] = follows + share * gain @ signature
    grown["information"] += products
    grown["gradient"] += turned @ clipped
    grown["raw_information"] += accepted[:, None, None] * products
    grown["raw_gradient"] += accepted[:, None] * (turned @ white)
    grown["excess"] += accepted * 0.5 * max(squared - _WRONG, 0.0)
    grown["raw_beyond"] += 2.0 * (1.0 - accepted) * (squared > _WRONG)
    # The part of predicted slow motions that innovations still have, by frames: none if these
    # are as large as supposed.
    forecast = (whiten @ (rows.by_motion * mean[motions])).reshape(6, -1, 6).sum(axis=2)
    mean = mean + gain @ clipped
    # In the form of Joseph: by plain differences it is indefinite after wide changes were accepted.
    kept, filled = np.eye(len(mean)) - gain @ whiten @ design, gain @ whiten
    covariance = kept @ covariance @ kept.T + filled @ by_look @ filled.T
    # The arm's error at a posture is learned beside the state, and its small share in what the
    # filter takes of a change is left out: it costs a little delay and no false alarm.
    places["offsets"][at] += offset_gain @ clipped
    places["offsets_covariance"][at] -= offset_gain @ offset_gain.T
    learned: dict[str, FloatArray] = {}
    if is_learning:
        # Of the noise in units of the stated: expectation and maximisation (Shumway and Stoffer
        # 1982), look by look. Of the arm's share and the slow motions: what innovations have too
        # much or too little of (Robbins and Monro 1951). Looks after which the noise is forgotten,
        # and its proportions.
        often = 1.0 / min(_STATED + count, 3000.0)
        soon = 1.0 / min(0.5 * (_STATED + count), 1000.0)
        of_noise, stated = whiten @ part, np.linalg.inv(root)
        found = of_noise.T @ clipped
        moment = stated @ (np.outer(found, found) + part - of_noise.T @ of_noise) @ stated.T
        arm = whiten @ rows.by_arm @ whiten.T
        more = clipped @ arm @ clipped / max(np.trace(arm), 1e-12) - 1.0
        power = state.forecast + often * (np.sum(forecast**2, axis=0) - state.forecast)
        larger = forecast.T @ clipped / power
        # Smallest slow motion [m, and radians].
        learned = {
            "shape": state.shape + often * (0.5 * (moment + moment.T) - state.shape),
            "fresh": state.fresh * np.exp(soon * more),
            "forecast": power,
            "slow": np.maximum(state.slow * np.exp(soon * np.repeat(larger, 6)), 3e-6**2),
            "usual": state.usual + (products[-1] - state.usual) / min(count + 1.0, 5e3),
        }
    return replace(state, **now, mean=mean, covariance=covariance, **grown, **places, **learned)


def _place(state: Detector, rows: LookRows) -> tuple[int, dict[str, FloatArray]]:
    """The place of a look's posture among those known; a new one takes the least used."""
    names = ("postures", "stood", "offsets", "offsets_covariance")
    places = {name: getattr(state, name).copy() for name in names}
    away = np.linalg.norm(state.postures - rows.posture, axis=1) + 1e9 * (state.stood == 0)
    at = int(away.argmin())
    # Distance within which postures are one [rad, and 2 rad a metre].
    if away[at] > 0.05:
        at = int(state.stood.argmin())
        for name, value in zip(names, (rows.posture, 0.0, 0.0, rows.by_arm), strict=True):
            places[name][at] = value
    places["stood"][at] += 1.0
    return at, places


def _explained(
    white: FloatArray, signature: FloatArray, information: FloatArray, gradient: FloatArray
) -> FloatArray:
    """(c,) 1 where a candidate's estimate of the change explains a far innovation, else 0."""
    covariance = np.linalg.inv(information + np.eye(information.shape[1]) / _WIDEST_M**2)
    away = white - (signature @ (covariance @ gradient[:, :, None]))[:, :, 0]
    total = np.eye(6) + signature @ covariance @ np.swapaxes(signature, 1, 2)
    squares = np.sum(away * np.linalg.solve(total, away[:, :, None])[:, :, 0], axis=1)
    return np.where(squares < _FAR, 1.0, 0.0)


def _thin(grown: dict[str, FloatArray], looks: float) -> None:
    """Gives up the oldest candidate, or the one whose neighbours are nearest for their age."""
    born, ages = grown["born"], looks + 1.0 - grown["born"][:, 0]
    at = 0
    # Looks after which a candidate is given up.
    if ages[0] <= 1000:
        at = 1 + int(np.argmin((ages[:-2] - ages[2:]) / ages[1:-1]))
        born[at + 1, 1], born[at + 1, 3] = born[at, 1], born[at + 1, 3] + born[at, 3]
    for name in CANDIDATE:
        grown[name] = np.delete(grown[name], at, axis=0)


def weighed(
    state: Detector, kinds: Sequence[ChangeKind], units: FloatArray, *, is_raw: bool = False
) -> FloatArray:
    """(h, c) log likelihood ratio of each kind of change at each candidate to none, weighted.

    Weights are prior probabilities, and the numbers of looks that candidates stand for; the sum of
    the ratios is the statistic. Innovations of bounded influence say whether something changed;
    `is_raw` ones, as they are, what it was and when. `units` (d,) are the sizes of each change for
    one of a metre. A kind without columns is a change beyond what rows can say.
    """
    scores = np.zeros((len(kinds), len(state.born)))
    every, slopes = state.information, state.gradient
    if is_raw:
        every, slopes = state.raw_information, state.raw_gradient
    for at, kind in enumerate(kinds):
        columns = np.array(kind.columns, dtype=np.int64)
        if not kind.columns:
            looks = state.raw_beyond if is_raw else state.beyond
            scores[at] = _LOG_BEYOND * looks + np.log(kind.prior)
            continue
        usual = float(np.diagonal(state.usual)[columns] @ units[columns] ** 2)
        sizes_m = np.array(SIZES_M) if is_raw else np.sqrt(_SHIFTS / max(usual, 1e-12))
        sizes = sizes_m[:, None] * units[columns]
        information = every[:, columns[:, None], columns]
        ratios = log_ratios(information, slopes[:, columns], sizes)
        # Of what looks do not show there is no evidence yet: of another board, of joints.
        is_shown = np.diagonal(information, axis1=1, axis2=2) @ sizes[-1] ** 2 > _SHOWN
        mean = np.logaddexp.reduce(ratios, axis=0) - np.log(len(sizes_m))
        scores[at] = np.where(is_shown, mean, -np.inf) + np.log(kind.prior) - is_raw * state.excess
    return scores + np.log(state.born[:, 3])


def log_ratios(information: FloatArray, gradient: FloatArray, sizes: FloatArray) -> FloatArray:
    """(s, c) log likelihood ratios of changes to none, by prior standard deviations (s, q).

    Each of c candidates has the information (q, q) of its innovations on a change of q unknowns,
    and their gradient (q,); the change is integrated out.
    """
    scale = sizes[:, None]
    inner = np.eye(sizes.shape[1]) + information * scale[..., None] * scale[..., None, :]
    scaled = scale * gradient
    squares = np.sum(scaled * np.linalg.solve(inner, scaled[..., None])[..., 0], axis=2)
    return np.asarray(0.5 * (squares - np.linalg.slogdet(inner)[1]))


def counted(state: Detector, statistic: FloatArray) -> Detector:
    """The state after it is counted whether the statistic (c,), by candidates, passes small limits.

    Of each limit, the test begins anew where it was passed.
    """
    since, rates = state.passed
    sums = ((state.born[:, 0] >= since[:, None]) * statistic).sum(axis=1)
    often = 1.0 / min(_SUPPOSED + float(state.looks), _REMEMBERED)
    is_passed = sums >= _LEVELS
    since = np.where(is_passed, state.looks, since)
    return replace(state, passed=np.array([since, rates + often * (is_passed - rates)]))


def limit(state: Detector, looks: float) -> float:
    """The statistic's limit that is passed once in so many looks, in the mean, by no change."""
    rates = state.passed[1]
    tail = np.log(rates[0] / rates[1]) / np.log(_LEVELS[1] / _LEVELS[0])
    # Least exponent of the tail: with a smaller one hardly anything would be an alarm.
    return float(_LEVELS[1] * (looks * rates[1]) ** (1.0 / max(tail, 0.4)))


def estimate(
    state: Detector, kind: ChangeKind, candidate: int, units: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """A change at a candidate, (q,), and its covariance (q, q)."""
    columns = np.array(kind.columns, dtype=np.int64)
    information = state.raw_information[candidate][np.ix_(columns, columns)]
    prior = np.diag((_WIDEST_M * units[columns]) ** -2.0)
    covariance = np.linalg.inv(information + prior)
    return covariance @ state.raw_gradient[candidate, columns], covariance


def accepted(
    state: Detector,
    kinds: Sequence[ChangeKind],
    shares: FloatArray,
    candidate: int,
    units: FloatArray,
) -> Detector:
    """The state by which a change at a candidate, of kinds with these probabilities, is no change.

    The mixture of the kinds' estimates, and of no change where the probabilities leave some, has
    one mean and covariance; what the filter took of a change into the state is taken back.
    """
    size = len(units)
    mean, moment = np.zeros(size), np.zeros((size, size))
    for kind, share in zip(kinds, shares, strict=True):
        change, covariance = estimate(state, kind, candidate, units)
        columns = np.array(kind.columns, dtype=np.int64)
        mean[columns] += share * change
        moment[np.ix_(columns, columns)] += share * (covariance + np.outer(change, change))
    by_change = -state.follows[candidate]
    by_change[-size:] += np.eye(size)
    more = by_change @ (moment - np.outer(mean, mean)) @ by_change.T
    return replace(
        state, mean=state.mean + by_change @ mean, covariance=state.covariance + more
    ).without_candidates()
