"""Observability of the unknown edges: directions that the motion leaves undetermined, in words."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from visioncal.core.directions import Direction, Turning, edge_directions
from visioncal.core.errors import DegenerateError
from visioncal.core.limits import FEWEST_VIEWS
from visioncal.core.linalg import covariance_among
from visioncal.core.number_format import counted, figure
from visioncal.core.transforms import robot_part
from visioncal.core.types import FloatArray, Mount
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State
from visioncal.session.frames import edge_names
from visioncal.vision.corners import floored_sigma_px

# Typical noise of robots and corners, per axis. Larger noise is no fault of the motion but of
# exchanged rows, another convention or wrong images; the verdict judges it.
TYPICAL_NOISE, TYPICAL_PX = Noise.of_robot(float(np.deg2rad(0.05)), 1e-4), 0.2
# Cause and advice where unknowns common to all views are not determined.
_LENS_OPEN = (
    "the views do not determine lens and board well enough",
    "Give matrix and distortion in [camera], state the board's size with its sigma, or add views "
    "tilted by 30 to 45 degrees.",
)
_POINTS_OPEN = (
    "the readings do not determine where the points sit on the flange",
    "Add 3 or more stops in which the flange is tilted about different axes.",
)


@dataclass(frozen=True)
class CellWords:
    """Wording of messages about a cell."""

    title: str  # Prefix of messages.
    names: Mapping[str, tuple[str, str]]  # Names of each unknown frame, and of its parent.
    # Words for what is wrong with the motion, given the undetermined frame.
    motion: Callable[[str], str]
    # Words for what to do, given that frame and its undetermined part in words, which may be empty.
    advice: Callable[[str, str], str]
    # Cause and advice where the first effect is not determined.
    undetermined: tuple[str, str] = _LENS_OPEN


def chain_words(problem: Problem, mount: Mount, *, can_tilt: bool | None = None) -> CellWords:
    """Wording of messages about one camera and one robot, whose unknowns begin with the camera.

    More views are advised, a measured offset beside them where the arm is not known, and that alone
    where it is known to tilt about one axis at most.
    """
    camera, *targets = problem.unknown
    sensor = "instrument" if mount == "instrument" else "camera"
    parent = "the base" if mount == "eye-in-hand" else "the tool"
    names = {target: (f"the {target.replace('_', ' ', 1)}", parent) for target in targets}
    names = {camera: (f"the {sensor}", f"the {_frame(mount)}"), **names}
    stops = np.unique(problem.observations.stops)
    flange = problem.poses[problem.robots[0]][stops]
    turning = Turning.of(robot_part(flange, mount)) if len(flange) > 1 else None

    def motion(frame: str) -> str:
        if frame in targets[1:] or turning is None:
            return "the views that show it are too few or too poor"
        return turning.words(flange, counted(len(stops), "used view"), f"the {_frame(mount)}")

    def advice(frame: str, open_part: str) -> str:
        if frame in targets[1:]:
            return f"Add views of {names[frame][0][4:]}, or take it out of the session."
        measured = ""
        carried, placed = edge_names(mount)
        if turning is None or turning.is_enough or can_tilt:
            return _advice(mount)
        if turning.is_still and "offset" in open_part:
            measured = _of_straight(placed.replace("target", targets[0]), flange)
        elif "offset along" in open_part:
            # A caliper reaches what is on the flange, and no instrument's origin.
            name = (carried, placed)[mount == "instrument"]
            keys = [f"{axis}_m" for axis in "xyz" if open_part.endswith(f"'s {axis}")]
            keys *= mount != "instrument"
            measured = f"measure that offset for [prior.{name}]"
            measured += f" ({keys[0]}, and its sigma_m)" if keys else ""
            if can_tilt is False:
                return f"This arm cannot tilt: {measured}."
            measured = f"where the arm cannot tilt, {measured}"
        return f"{_advice(mount)[:-1]}; {measured}." if measured else _advice(mount)

    undetermined = _POINTS_OPEN if mount == "instrument" else _LENS_OPEN
    return CellWords(title(mount), names, motion, advice, undetermined)


def _of_straight(placed: str, flange: FloatArray) -> str:
    """Advice where (m, 4, 4) flange poses differ in position alone; or empty."""
    away = flange[:, :3, 3] - flange[:, :3, 3].mean(axis=0)
    directions = int(np.sum(np.linalg.norm(away @ np.linalg.svd(away)[2].T, axis=0) > 1e-2))
    if not directions:
        return ""
    words = (
        "where the machine cannot turn (a gantry, a rail), measure where the target's origin is, "
        f"as by touching it, and state x_m, y_m, z_m and their sigma_m in [prior.{placed}]"
    )
    if directions == 1:
        words += ", and move along a second direction: one leaves the turn about it open"
    return words


def title(mount: Mount) -> str:
    """Prefix of messages about both edges."""
    return "instrument" if mount == "instrument" else "hand-eye"


def _frame(mount: Mount) -> str:
    """The camera's parent frame, in which the relative motions act."""
    return "tool" if mount == "eye-in-hand" else "base"


def _advice(mount: Mount) -> str:
    return (
        "Add 3 or more views in which the flange is tilted by 20 to 40 degrees about different "
        f"axes, not only about one axis of the {_frame(mount)}."
    )


def too_little_motion(base_from_flange: FloatArray, mount: Mount) -> tuple[str, str]:
    """Why (m, 4, 4) flange poses alone leave a calibration undetermined, and advice; or empty."""
    turning = Turning.of(robot_part(base_from_flange, mount))
    if turning.is_enough:
        return "", ""
    views = f"{counted(len(base_from_flange), 'view')} with poses"
    words = turning.words(base_from_flange, views, f"the {_frame(mount)}")
    return f"{title(mount)}: {words}.", _advice(mount)


def refuse_too_few(problem: Problem, mount: Mount) -> None:
    """Refuses fewer than three stops.

    Raises:
        DegenerateError: There are fewer.
    """
    stops = len(np.unique(problem.observations.stops))
    if stops >= FEWEST_VIEWS:
        return
    sensor = "instrument" if mount == "instrument" else "camera"
    culprit = f"the {sensor}'s offset from the {_frame(mount)}"
    raise DegenerateError(
        f"{title(mount)}: {counted(stops, 'usable stop')} of the robot, but it takes at least "
        f"{FEWEST_VIEWS}; {culprit} is not determined without two different axes of rotation "
        "between views.",
        culprits=[culprit],
        next_step=_advice(mount),
    )


def check_determined(
    problem: Problem,
    state: State,
    noise: Noise,
    words: CellWords,
    pixel_px: Mapping[str, float] = MappingProxyType({}),
    *,
    with_first_effect: bool = False,
    only_open: bool = False,
) -> None:
    """Refuses motion that leaves a direction of an unknown frame undetermined.

    The motion is judged by its geometry, at `TYPICAL_NOISE` and `TYPICAL_PX`, whatever noise these
    data show; lens and board, or points, at a corner noise of at most `TYPICAL_PX`.

    Args:
        problem: The used views.
        state: The solution.
        noise: Of the residuals.
        words: The wording.
        pixel_px: By camera, the corner noise behind its poses' covariance [px].
        with_first_effect: Whether lens and board, or points, have to be determined, too.
        only_open: Whether a direction that is known poorly is left to later checks.

    Raises:
        DegenerateError: The predicted sigma of a direction is over the limit.
    """
    frames, typical_noise = _at_typical_noise(problem, noise, pixel_px)
    frames, placed = frames.with_effects(()), State(state.edges, np.zeros(0))
    _refuse_open(frames, placed, typical_noise, words, only_open=only_open)
    if with_first_effect and problem.effects:
        problem, noise = _at_typical_noise(problem, noise, pixel_px, keeps_less=True)
        cause, advice = words.undetermined
        first = problem.effects[0]
        _refuse_open(
            problem.with_effects([first]),
            State(state.edges, state.values[: len(first)]),
            noise,
            replace(words, motion=lambda _: cause, advice=lambda *_: advice),
        )


def _at_typical_noise(
    problem: Problem, noise: Noise, pixel_px: Mapping[str, float], *, keeps_less: bool = False
) -> tuple[Problem, Noise]:
    """The same observations at a typical noise, or at the data's where that is less and kept."""
    most = 1.0 if keeps_less else np.inf
    shares = {name: min(most, TYPICAL_PX / floored_sigma_px(px)) for name, px in pixel_px.items()}
    seen, least = problem.observations, min(shares.values(), default=1.0)
    scale = np.array([shares.get(observer, 1.0) for observer in seen.observers])[:, None, None]
    effects = []
    for effect in problem.effects:
        information = effect.prior.information / least**2
        effects.append(replace(effect, prior=replace(effect.prior, information=information)))
    observations = replace(seen, covariance=scale**2 * seen.covariance)
    robots = np.broadcast_to(TYPICAL_NOISE.robots, noise.robots.shape)
    if keeps_less:
        robots = np.minimum(noise.robots, robots)
    typical = replace(problem, observations=observations, effects=tuple(effects))
    return typical, Noise(robots, np.minimum(noise.sensors, 1.0))


def _refuse_open(
    problem: Problem, state: State, noise: Noise, words: CellWords, *, only_open: bool = False
) -> None:
    """Refuses frames that are not determined, by the first of them."""
    covariance = covariance_among(fisher_information(problem, state, noise), problem.counted)
    found = directions(problem, state, covariance, words.names)
    beyond = [
        pair for pair in found if (pair[1].is_open if only_open else pair[1].sigma > pair[1].limit)
    ]
    if beyond:
        frame, worst = beyond[0]
        fault = worst.fault(" at a typical noise")
        priors = [] if worst.is_rotation else [prior for prior in problem.priors if prior.axes]
        stated = "".join(
            f" [prior.{prior.name}] counts, with {', '.join('xyz'[axis] for axis in prior.axes)} "
            f"known to {figure(1e3 * prior.sigma_m)} mm."
            for prior in priors
        )
        advice = words.advice(frame, worst.words if worst.is_open else "")
        if priors and not worst.is_open:
            # With what the views add, a tenth less meets the limit.
            needed_m = 0.9 * min(prior.sigma_m for prior in priors) * worst.limit / worst.sigma
            advice = f"Measure that to {figure(1e3 * needed_m)} mm (sigma_m) or better. {advice}"
        raise DegenerateError(
            f"{words.title}: {worst.words} {fault}: {words.motion(frame)}.{stated}",
            culprits=[direction.words for _, direction in beyond],
            next_step=advice,
        )


def directions(
    problem: Problem, state: State, covariance: FloatArray, names: Mapping[str, tuple[str, str]]
) -> tuple[tuple[str, Direction], ...]:
    """Least certain directions of all unknown frames, offset before rotation.

    By the covariance (p, p) of all unknowns; `names` are those of each frame and of its parent.
    """
    found = []
    for frame, edge in problem.unknown.items():
        columns = problem.edge_columns(frame)
        ordered = edge_directions(state.edges[edge], covariance[columns, columns], *names[frame])
        found += [(frame, item) for item in (ordered[:1] if frame in problem.points else ordered)]
    return tuple(found)
