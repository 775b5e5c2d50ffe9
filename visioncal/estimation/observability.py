"""Observability of the unknown edges: directions that the motion leaves undetermined, in words."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from scipy.spatial.transform import Rotation

from visioncal.core.errors import DegenerateError
from visioncal.core.number_format import counted, figure
from visioncal.core.transforms import invert, rotation_angle
from visioncal.core.types import FloatArray, Mount
from visioncal.estimation.chain import edge_names, robot_part
from visioncal.estimation.corners import floored_sigma_px
from visioncal.estimation.linalg import covariance_among, spectrum
from visioncal.estimation.normal_equations import fisher_information
from visioncal.estimation.problem import Problem
from visioncal.estimation.problem_parts import Noise, State

# Scaled eigenvalue ratio below which the motion does not determine a direction.
_NULL_RATIO = 1e-8
# Largest predicted sigmas at a typical noise with which stops can calibrate.
SIGMA_LIMIT_M, SIGMA_LIMIT_RAD = 5e-3, float(np.deg2rad(0.5))
# Typical noise of robots and corners, per axis. Larger noise is no fault of the motion but of
# exchanged rows, another convention or wrong images; the verdict judges it.
TYPICAL_NOISE, TYPICAL_PX = Noise.of_robot(float(np.deg2rad(0.05)), 1e-4), 0.2
# Least component along an axis for a direction to be called by it.
_NEARLY_AXIS = 0.95
FEWEST_VIEWS = 3
# Least rotation of a robot between any of its stops.
_STILL_RAD = float(np.deg2rad(0.5))
_PAIRED = 300
# Cause and advice where unknowns common to all views are not determined.
_UNDETERMINED = {
    "camera": (
        "the views do not determine lens and board well enough",
        "Give matrix and distortion in [camera], state the board's size with its sigma, or add "
        "views tilted by 30 to 45 degrees.",
    ),
    "instrument": (
        "the readings do not determine where the points sit on the flange",
        "Add 3 or more stops in which the flange is tilted about different axes.",
    ),
}
# Least share of a unit null direction in a part of an edge that it makes undetermined.
_PART_OF_NULL = 0.05


@dataclass(frozen=True)
class Direction:
    """The least certain direction of an edge."""

    words: str  # Its name, such as `the camera's offset along the tool's z`.
    sigma: float  # Its predicted standard deviation [m or rad].
    limit: float  # The largest accepted one, in the same unit.
    is_rotation: bool  # Whether it is an angle.

    @property
    def figure(self) -> str:
        """The sigma and its limit with their unit."""
        unit, scale = ("deg", np.rad2deg(1.0)) if self.is_rotation else ("mm", 1e3)
        return f"{figure(self.sigma * scale)} {unit} (limit {figure(self.limit * scale)})"


def title(mount: Mount) -> str:
    """Prefix of messages about both edges."""
    return "instrument" if mount == "instrument" else "hand-eye"


def check_observability(
    problem: Problem,
    state: State,
    noise: Noise,
    mount: Mount,
    pixel_px: Mapping[str, float] = MappingProxyType({}),
    *,
    with_first_effect: bool = False,
) -> None:
    """Refuses motion that leaves a direction undetermined.

    The motion is judged by its geometry, at `TYPICAL_NOISE` and `TYPICAL_PX`, whatever noise these
    data show; lens and board, or points, at a corner noise of at most `TYPICAL_PX`.

    Args:
        problem: The used views.
        state: The solution.
        noise: Of the residuals.
        mount: Mounting of the camera.
        pixel_px: By camera, the corner noise behind its poses' covariance [px].
        with_first_effect: Whether the first effect has to be determined, too: lens and board, or
            points.

    Raises:
        DegenerateError: A direction is numerically null, or its predicted sigma is over the limit.
    """
    check_determined(
        problem, state, noise, _scene(problem, mount), pixel_px, with_first_effect=with_first_effect
    )


def refuse_open_motion(problem: Problem, state: State, noise: Noise, mount: Mount) -> None:
    """Refuses motion that leaves a direction undetermined at any noise, before a fit.

    Raises:
        DegenerateError: A direction is numerically null.
    """
    problem, noise = _at_typical_noise(problem, noise, {})
    _refuse_null(problem, state, noise, _scene(problem, mount))


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
    undetermined: tuple[str, str] = _UNDETERMINED["camera"]


def check_determined(
    problem: Problem,
    state: State,
    noise: Noise,
    scene: CellWords,
    pixel_px: Mapping[str, float] = MappingProxyType({}),
    *,
    with_first_effect: bool = False,
) -> None:
    """Refuses motion that leaves a direction of an unknown frame undetermined.

    Arguments are those of `check_observability`; `scene` is the wording.

    Raises:
        DegenerateError: A direction is numerically null, or its predicted sigma is over the limit.
    """
    typical, typical_noise = _at_typical_noise(problem, noise, pixel_px)
    frames, placed = typical.with_effects(()), State(state.edges, np.zeros(0))
    _refuse_null(frames, placed, typical_noise, scene)
    _refuse_vague(frames, placed, typical_noise, scene)
    if with_first_effect and problem.effects:
        problem, noise = _at_typical_noise(problem, noise, pixel_px, keeps_less=True)
        cause, advice = scene.undetermined
        first = problem.effects[0].determined
        _refuse_vague(
            problem.with_effects([first]),
            State(state.edges, state.values[: len(first)]),
            noise,
            replace(scene, motion=lambda _: cause, advice=lambda *_: advice),
        )


def _at_typical_noise(
    problem: Problem, noise: Noise, pixel_px: Mapping[str, float], *, keeps_less: bool = False
) -> tuple[Problem, Noise]:
    """The same observations at a typical noise, or at the data's where that is less and kept."""
    most = 1.0 if keeps_less else np.inf
    shares = {name: min(most, TYPICAL_PX / floored_sigma_px(px)) for name, px in pixel_px.items()}
    seen, least = problem.observations, min(shares.values(), default=1.0)
    scale = np.array([shares.get(observer, 1.0) for observer in seen.observers])[:, None, None]
    typical = replace(
        problem,
        observations=replace(seen, covariance=scale**2 * seen.covariance),
        effects=tuple(
            replace(
                effect, prior=replace(effect.prior, information=effect.prior.information / least**2)
            )
            for effect in problem.effects
        ),
    )
    robots = np.broadcast_to(TYPICAL_NOISE.robots, noise.robots.shape)
    if keeps_less:
        robots = np.minimum(noise.robots, robots)
    return typical, Noise(robots, np.minimum(noise.sensors, 1.0))


def _refuse_null(problem: Problem, state: State, noise: Noise, scene: CellWords) -> None:
    """Refuses frames that are not determined at all."""
    counted = problem.counted
    eigen = spectrum(fisher_information(problem, state, noise)[np.ix_(counted, counted)])
    if eigen.ratio < _NULL_RATIO:
        null = np.zeros((problem.size, int(np.sum(eigen.values < _NULL_RATIO * eigen.values[-1]))))
        null[counted] = eigen.vectors[:, : null.shape[1]]
        frame, culprit = _null_direction(null, problem, state, scene)
        verb = "are" if " and " in culprit else "is"
        raise DegenerateError(
            f"{scene.title}: {culprit} {verb} not determined at all: {scene.motion(frame)}.",
            culprits=[culprit],
            next_step=scene.advice(frame, culprit),
        )


def _refuse_vague(problem: Problem, state: State, noise: Noise, scene: CellWords) -> None:
    """Refuses frames whose predicted sigmas exceed the limit."""
    covariance = covariance_among(fisher_information(problem, state, noise), problem.counted)
    beyond = [
        (frame, direction)
        for frame in problem.unknown
        for direction in _frame_directions(problem, state, covariance, frame, scene.names[frame])
        if direction.sigma > direction.limit
    ]
    if beyond:
        frame, worst = beyond[0]
        raise DegenerateError(
            f"{scene.title}: {worst.words} has a predicted sigma of {worst.figure} at a typical "
            f"noise: "
            f"{scene.motion(frame)}.",
            culprits=[direction.words for _, direction in beyond],
            next_step=scene.advice(frame, ""),
        )


def _frame_directions(
    problem: Problem, state: State, covariance: FloatArray, frame: str, names: tuple[str, str]
) -> tuple[Direction, ...]:
    """Least certain directions of a frame: of its offset and, if it has one, of its rotation."""
    columns = problem.edge_columns(frame)
    edge = state.edges[problem.unknown[frame]]
    found = edge_directions(edge, covariance[columns, columns], *names)
    return found[:1] if frame in problem.points else found


def _scene(problem: Problem, mount: Mount) -> CellWords:
    """Wording of messages about one camera and one robot."""
    stops = np.unique(problem.observations.stops)
    flange = problem.poses[problem.robots[0]][stops]
    views, names = counted(len(stops), "used view"), _names(problem, mount)
    further = tuple(names)[2:]

    def motion(frame: str) -> str:
        if frame in further:
            return "the views that show it are too few or too poor"
        return motion_words(robot_part(flange, mount), flange, views, f"the {_frame(mount)}")

    def advice(frame: str, open_part: str) -> str:
        if frame in further:
            return f"Add views of {names[frame][0][4:]}, or take it out of the session."
        # One measured offset is of no help to a robot that does not turn at all.
        is_turned = np.linalg.norm(_turns(robot_part(flange, mount)), axis=1).max() >= _STILL_RAD
        return f"{_or_measured(mount, open_part) if is_turned else ''}{_advice(mount)}"

    return CellWords(title(mount), names, motion, advice, _UNDETERMINED[_sensor(mount)])


def directions(
    problem: Problem, state: State, covariance: FloatArray, mount: Mount
) -> tuple[Direction, ...]:
    """Least certain directions of the camera's edge and of each target's, offset before rotation.

    `covariance` is (p, p), of all unknowns.
    """
    return tuple(
        direction
        for frame, names in _names(problem, mount).items()
        for direction in _frame_directions(problem, state, covariance, frame, names)
    )


def edge_directions(
    matrix: FloatArray, covariance: FloatArray, thing: str, frame: str
) -> tuple[Direction, Direction]:
    """Least certain directions of an edge: of its offset, and of its rotation.

    Args:
        matrix: (4, 4) the edge.
        covariance: (6, 6) its covariance.
        thing: Name of the frame it places.
        frame: Name of the parent frame.
    """
    directions = []
    for is_rotation in (False, True):
        block = slice(0, 3) if is_rotation else slice(3, 6)
        values, vectors = np.linalg.eigh(covariance[block, block])
        limit = SIGMA_LIMIT_RAD if is_rotation else SIGMA_LIMIT_M
        words = _words(thing, frame, matrix[:3, :3] @ vectors[:, -1], is_rotation)
        sigma = float(np.sqrt(max(values[-1], 0.0)))
        directions.append(Direction(words, sigma, float(limit), is_rotation))
    return directions[0], directions[1]


def refuse_too_few(problem: Problem, mount: Mount, views: int = 1) -> None:
    """Refuses fewer stops, of a number of used views, than any calibration needs.

    Raises:
        DegenerateError: There are fewer than three stops.
    """
    stops = np.unique(problem.observations.stops)
    if len(stops) >= FEWEST_VIEWS:
        return
    culprit = f"the {_sensor(mount)}'s offset from the {_frame(mount)}"
    cause = "it takes two different axes of rotation between views to determine it"
    if len(stops) == 2:
        flange = problem.poses[problem.robots[0]][stops]
        axis = _main_axis(_turns(robot_part(flange, mount)))
        culprit += f" along the {_frame(mount)}'s {axis_words(axis)}"
        cause = f"two views share that axis of rotation, and {cause}"
    found = f"{counted(len(stops), 'usable stop')} of the robot"
    if len(stops) == 1 < views:
        found = f"all {views} used views are from one pose of the robot"
    raise DegenerateError(
        f"{title(mount)}: {found}, at least {FEWEST_VIEWS} are needed; {culprit} is not "
        f"determined: {cause}.",
        culprits=[culprit],
        next_step=_advice(mount),
    )


def _null_direction(
    null: FloatArray, problem: Problem, state: State, scene: CellWords
) -> tuple[str, str]:
    """The first frame with (p, k) null directions, and its undetermined part in words."""
    for frame, edge in problem.unknown.items():
        axes, start = state.edges[edge][:3, :3], problem.edge_columns(frame).start
        rotation, translation = (axes @ null[start + at : start + at + 3] for at in (0, 3))
        parts = [
            _open_part(scene.names[frame], directions, is_rotation)
            for directions, is_rotation in ((translation, False), (rotation, True))
        ]
        named = [part for part in parts if part]
        if named:
            return frame, " and ".join(named)
    return next(iter(problem.unknown)), "a combination of all edges"


def _open_part(names: tuple[str, str], directions: FloatArray, is_rotation: bool) -> str:
    """Names the part of a rotation or an offset in (3, k) null directions, if any."""
    vectors, sizes, _ = np.linalg.svd(directions)
    # Null vectors have unit length over all unknowns, a radian counting as a metre.
    rank = int(np.sum(sizes > _PART_OF_NULL))
    if rank == 1:
        return _words(*names, vectors[:, 0], is_rotation)
    if rank == 0:
        return ""
    return f"{names[0]}'s {'rotation' if is_rotation else 'offset from ' + names[1]}"


def _words(thing: str, frame: str, direction: FloatArray, is_rotation: bool) -> str:
    """Words for a direction of an edge, in its parent frame."""
    quantity = "rotation about" if is_rotation else "offset along"
    return f"{thing}'s {quantity} {frame}'s {axis_words(direction)}"


def _names(problem: Problem, mount: Mount) -> dict[str, tuple[str, str]]:
    """Names of the frames of the edges, the camera's first, and of their parents."""
    camera, *targets = problem.unknown
    parent = "the base" if mount == "eye-in-hand" else "the tool"
    return {
        camera: (f"the {_sensor(mount)}", f"the {_frame(mount)}"),
        **{target: (f"the {target.replace('_', ' ', 1)}", parent) for target in targets},
    }


def _sensor(mount: Mount) -> str:
    return "instrument" if mount == "instrument" else "camera"


def axis_words(direction: FloatArray) -> str:
    """Names a direction (3,): `x`, or `direction (0.71, 0.71, 0.00)`."""
    axis = int(np.argmax(np.abs(direction)))
    if abs(direction[axis]) > _NEARLY_AXIS:
        return "xyz"[axis]
    signed = direction * np.sign(direction[axis])
    return "direction ({:.2f}, {:.2f}, {:.2f})".format(*signed)


def _frame(mount: Mount) -> str:
    """The camera's parent frame, in which the relative motions act."""
    return "tool" if mount == "eye-in-hand" else "base"


def _turns(robot: FloatArray) -> FloatArray:
    """Rotation vectors (p, 3) of the relative motions between all pairs of (m, 4, 4) poses [rad].

    Of many poses a subset is paired, which includes those that rotate least and most.
    """
    ranked = robot[np.argsort(rotation_angle(invert(robot[0]) @ robot))]
    chosen = np.linspace(0, len(robot) - 1, min(len(robot), _PAIRED)).round().astype(np.int64)
    i, j = np.triu_indices(len(chosen), 1)
    relative = invert(ranked[chosen[j]]) @ ranked[chosen[i]]
    return np.asarray(Rotation.from_matrix(relative[:, :3, :3]).as_rotvec())


def _main_axis(turns: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.svd(turns, full_matrices=False)[2][0])


def turn_axis(turns: FloatArray) -> tuple[FloatArray, float, bool]:
    """Main axis of rotations, the rotation beside it [deg], and whether that is small."""
    main = _main_axis(turns)
    aside = np.rad2deg(np.linalg.norm(turns - np.outer(turns @ main, main), axis=1).max())
    return main, float(aside), bool(aside < 0.1 * np.rad2deg(np.linalg.norm(turns, axis=1).max()))


def open_offset(robot: FloatArray, thing: str, frame: str) -> str:
    """The offset left undetermined by rotation about one axis, in words; empty for more axes.

    `robot` is its part (m, 4, 4) of a chain, which rotates in `frame`; `thing` is to be placed.
    """
    main, _, is_lone = turn_axis(_turns(robot))
    return _words(thing, frame, main, is_rotation=False) if is_lone else ""


def motion_words(robot: FloatArray, flange: FloatArray, stops: str, frame: str) -> str:
    """Words for what is wrong with the motion of a robot.

    Args:
        robot: (m, 4, 4) the robot's part of a chain.
        flange: (m, 4, 4) poses of its flange.
        stops: Name of the stops.
        frame: Name of the frame in which the robot's part rotates.
    """
    turns = _turns(robot)
    largest_rad = np.linalg.norm(turns, axis=1).max()
    largest, is_still = np.rad2deg(largest_rad), largest_rad < _STILL_RAD
    spread_mm = 1e3 * np.linalg.norm(np.ptp(flange[:, :3, 3], axis=0))
    if is_still and spread_mm < 1.0:
        return f"the {stops} are all from one pose of the robot"
    if is_still:
        return (
            f"the {stops} differ in position only (largest rotation between two of "
            f"them: {figure(largest)} deg)"
        )
    main, aside, is_lone = turn_axis(turns)
    if is_lone:
        return (
            f"all {stops} turn about {frame}'s {axis_words(main)} to "
            f"within {figure(max(aside, 0.01))} deg"
        )
    about_second = f"by {figure(aside)} deg about a second axis"
    return f"the {stops} turn by at most {figure(largest)} deg, and {about_second}"


def turns_about_two_axes(robot: FloatArray) -> bool:
    """Whether a robot's part of a chain (m, 4, 4), m of two or more, rotates about two axes."""
    turns = _turns(robot)
    return bool(np.linalg.norm(turns, axis=1).max() >= _STILL_RAD) and not turn_axis(turns)[2]


def too_little_motion(base_from_flange: FloatArray, mount: Mount) -> tuple[str, str]:
    """Why (m, 4, 4) flange poses alone leave a calibration undetermined, and advice; or empty."""
    robot = robot_part(base_from_flange, mount)
    if turns_about_two_axes(robot):
        return "", ""
    views = f"{counted(len(robot), 'view')} with poses"
    words = motion_words(robot, base_from_flange, views, f"the {_frame(mount)}")
    return f"{title(mount)}: {words}.", _advice(mount)


def _or_measured(mount: Mount, culprit: str) -> str:
    """Further advice for an undetermined offset of an arm that cannot tilt, as with four axes."""
    if "offset along" not in culprit:
        return ""
    # A caliper reaches what is on the flange, and no instrument's origin.
    name = edge_names(mount)[mount == "instrument"]
    return f"Where the arm cannot tilt, measure that offset for [prior.{name}]. "


def _advice(mount: Mount) -> str:
    return (
        f"Add 3 or more views in which the flange is tilted by 20 to 40 degrees about different "
        f"axes, not only about one axis of the {_frame(mount)}."
    )
