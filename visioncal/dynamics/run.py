"""`visioncal dynamics identify`: from a session to its dynamics, and their proof."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

import numpy as np

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.number_format import did_you_mean
from visioncal.core.threads import on_one_blas_thread
from visioncal.core.types import FloatArray
from visioncal.dynamics.conditioning import Conditioned, condition
from visioncal.dynamics.identified import Identified, Lag
from visioncal.dynamics.identify import Identification, Options, find_lag, identify
from visioncal.dynamics.reading import RecordedSamples, read_recorded
from visioncal.dynamics.validate import Prediction, friction_of_known, predict, validate
from visioncal.robot import Robot
from visioncal.session import STREAMS, Session
from visioncal.session.choosing import ARM, Choice
from visioncal.session.selecting import check_one_of_each, select

# The share of a motion's end that is predicted where no other motion is named.
HELD_OUT = 0.3
# Rotors are there where with them an error of some joint's unseen torques falls to this share.
_ROTORS = 0.75


@dataclass(frozen=True)
class IdentificationRequest:
    """What is asked for.

    Attributes:
        streams: Names of the streams to fit; all with torques or currents where empty.
        validate_on: The stream to predict; the end of the fastest motion where empty.
        cutoff_hz: Of the low-pass [Hz]; by the motion where None.
        gains_nm_a: Torque for a current, by joint, where currents were recorded [N m/A].
        options: What is estimated.
        rotors: Whether rotors' inertias are estimated; None to let the torques decide: those behind
            the gears have none in them.
        robot: Which robot of a whole cell; its streams are those that have or begin with its name.
        lag_s: How much later torques come than their angles; sought where None [s].
    """

    streams: tuple[str, ...] = ()
    validate_on: str = ""
    cutoff_hz: float | None = None
    gains_nm_a: tuple[float, ...] = ()
    options: Options = field(default_factory=Options)
    rotors: bool | None = None
    robot: str | None = None
    lag_s: float | None = None


@dataclass(frozen=True, eq=False)
class _Split:
    """Streams without the end of the fastest motion, that, and whose it is."""

    rest: tuple[Conditioned, ...]
    unseen: Conditioned
    fastest: int


@dataclass(frozen=True, eq=False)
class Run:
    """A result with its evidence.

    Attributes:
        session: What it was identified from.
        identified: The result.
        identification: How it was fitted.
        predicted: Torques that were not fitted, measured and predicted; None where there are none.
        fitted: Those that were.
    """

    session: Session
    identified: Identified
    identification: Identification
    predicted: Prediction | None
    fitted: tuple[Prediction, ...]

    @property
    def predictions(self) -> tuple[Prediction, ...]:
        """All of them, those that were not fitted last."""
        return self.fitted if self.predicted is None else (*self.fitted, self.predicted)


@on_one_blas_thread
def identify_session(session: Session, request: IdentificationRequest | None = None) -> Run:
    """Identifies the dynamics of a session's arm.

    Args:
        session: With streams of angles and torques.
        request: What is asked for.

    Raises:
        DataError: The session has no robot or no such stream, or a stream is wrong.
        DegenerateError: The motion does not determine all base parameters.
    """
    request = IdentificationRequest() if request is None else request
    session = of_one_arm(session, request.robot)
    robot = robot_of(session)
    names = [
        stream
        for stream in _torque_streams(session, request.streams)
        if stream != request.validate_on
    ]
    if not names:
        raise DataError(
            f"session {session.name!r}: {request.validate_on} is its only stream of torques, and "
            "what is fitted is no proof.",
            culprits=[request.validate_on],
            next_step="Leave --validate-on out: then the end of the motion is predicted.",
        )
    recorded = [_read(session, robot, name, request) for name in names]
    streams, lag = _lagging(
        robot, [_conditioned(robot, item, request) for item in recorded], request
    )
    request = replace(request, lag_s=request.lag_s if lag is None else lag.seconds)
    split = _split(robot, recorded, streams, request)
    options = _with_rotors(robot, split, request)
    whole = identify(robot, streams, options)
    proof, validation = None, None
    if request.validate_on:
        other = _read(session, robot, request.validate_on, request)
        proof = _predicted(whole, _conditioned(robot, other, request))
        validation = validate(whole.identified, proof)
    elif split is not None:
        of_rest = identify(robot, split.rest, replace(options, checked=False))
        proof = _predicted(of_rest, split.unseen, "the last 30 % of ")
        # In a part of a motion a joint may bear the same torque all the time.
        ranges_nm = whole.identified.streams[split.fastest].torque_nm
        validation = replace(validate(whole.identified, proof), torque_nm=ranges_nm)
    identified = replace(
        whole.identified,
        validation=validation,
        lag=lag,
        facts={
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "session": {"name": session.name, "sha256": session.digest()},
        },
    )
    friction = friction_of_known(whole)
    fitted = tuple(predict(identified, stream, friction) for stream in streams)
    return Run(session, identified, whole, proof, fitted)


def validate_session(
    session: Session, identified: Identified, request: IdentificationRequest
) -> list[Prediction]:
    """Predicts the torques of a session's streams by dynamics that were identified before.

    Raises:
        DataError: The robot is another one, there is no such stream, or a stream is wrong.
    """
    return [
        predict(identified, stream) for stream in conditioned_streams(session, identified, request)
    ]


@on_one_blas_thread
def conditioned_streams(
    session: Session, identified: Identified, request: IdentificationRequest
) -> list[Conditioned]:
    """Reads a session's streams, filtered as those from which an arm was identified.

    Raises:
        DataError: The robot is another one, there is no such stream, or a stream is wrong.
    """
    robot, session = identified.robot, of_one_arm(session, request.robot)
    names = _torque_streams(session, request.streams)
    recorded = [_read(session, robot, name, request) for name in names]
    cutoff_hz = request.cutoff_hz or identified.streams[0].cutoff_hz
    filtered = replace(request, cutoff_hz=cutoff_hz)
    streams = [_conditioned(robot, item, filtered) for item in recorded]
    streams, lag = _lagging(robot, streams, request)
    if lag is None:
        return streams
    return [
        replace(stream, notes=(*stream.notes, f"{stream.label}: {lag.words}")) for stream in streams
    ]


@on_one_blas_thread
def current_streams(
    session: Session, robot: Robot, cutoff_hz: float | None = None
) -> list[Conditioned]:
    """Reads a session's streams of currents, for drives whose gains are not known.

    Args:
        session: The session.
        robot: Its arm.
        cutoff_hz: Of the low-pass [Hz]; by the motion where None.

    Returns:
        The streams, whose torques are currents [A].

    Raises:
        DataError: There is no stream of currents, or one is wrong.
    """
    request = IdentificationRequest(cutoff_hz=cutoff_hz, gains_nm_a=(1.0,) * robot.joint_count)
    recorded = [_read(session, robot, stream, request) for stream in _torque_streams(session)]
    recorded = [item for item in recorded if item.of_currents]
    if not recorded:
        raise DataError(
            f"session {session.name!r} has torques and no currents.",
            culprits=[f"{STREAMS}/{stream}.csv" for stream in session.streams],
            next_step="Drives that report torques need no gains: visioncal dynamics identify.",
        )
    return [condition(item, cutoff_hz) for item in recorded]


def of_one_arm(session: Session, robot: str | None = None) -> Session:
    """Takes one robot with its streams out of a session of several.

    Raises:
        DataError: There is no such robot, or several are meant.
    """
    return select(session, Choice(robot=robot), ARM)


def robot_of(session: Session) -> Robot:
    """The session's robot.

    Raises:
        DataError: It names none that is known, or several.
    """
    check_one_of_each(session)
    if session.robot_document is None:
        raise DataError(
            f"session {session.name!r} names no known robot, and torques are its links'.",
            culprits=["session.toml: robot.model"],
            next_step=" ".join(session.warnings)
            or 'Add model = "ur10e", or a path, to [robot], of a whole cell to its table, as '
            "[robots.a].",
        )
    return Robot.from_document(session.robot_document)


def _torque_streams(session: Session, wanted: Sequence[str] = ()) -> list[str]:
    """Names of the streams that have torques or currents, or of those that are wanted."""
    for name in wanted:
        if name not in session.streams:
            raise DataError(
                f"session {session.name!r} has no stream {name!r}; it has "
                f"{', '.join(session.streams) or 'none'}.",
                culprits=[name],
                next_step=did_you_mean(name, session.streams),
            )
    if wanted:
        return list(dict.fromkeys(wanted))
    drives = ("tau1_nm", "current1_a")
    found = [
        name for name, stream in session.streams.items() if any(one in stream for one in drives)
    ]
    if not found:
        raise DataError(
            f"session {session.name!r} has no stream with torques or currents: "
            f"{', '.join(session.streams) or 'it has no streams'}.",
            culprits=[f"{STREAMS}/{stream}.csv" for stream in session.streams],
            next_step=f"Put them into {STREAMS}/NAME.csv: stamp_s, q1_rad ..., and tau1_nm ... or "
            "current1_a ....",
        )
    return found


def _read(
    session: Session, robot: Robot, name: str, request: IdentificationRequest
) -> RecordedSamples:
    (name,) = _torque_streams(session, [name])
    label = f"{STREAMS}/{name}.csv"
    return read_recorded(session.streams[name], label, robot.joint_count, request.gains_nm_a)


def _conditioned(
    robot: Robot, recorded: RecordedSamples, request: IdentificationRequest
) -> Conditioned:
    found = condition(recorded, request.cutoff_hz, robot.torque_nm)
    return found.advanced(request.lag_s) if request.lag_s else found


def _lagging(
    robot: Robot, streams: list[Conditioned], request: IdentificationRequest
) -> tuple[list[Conditioned], Lag | None]:
    """The streams with their torques at the angles' times, and by how much they were later."""
    lag = None
    if request.lag_s is None:
        lag = find_lag(robot, streams, request.options.terms)
    return streams if lag is None else [stream.advanced(lag.seconds) for stream in streams], lag


def _split(
    robot: Robot,
    recorded: Sequence[RecordedSamples],
    streams: Sequence[Conditioned],
    request: IdentificationRequest,
) -> _Split | None:
    """Leaves the end of the fastest motion out; None where the rest determines too little."""
    # Sweeps move one joint after the other: no part of them stands for the others.
    fastest = int(np.argmax([_speed(stream) for stream in streams]))
    filtered = replace(request, cutoff_hz=streams[fastest].cutoff_hz)
    begin = recorded[fastest].part(0.0, 1.0 - HELD_OUT)
    end = recorded[fastest].part(1.0 - HELD_OUT, 1.0)
    rest = list(streams)
    try:
        rest[fastest] = _conditioned(robot, begin, filtered)
        split = _Split(tuple(rest), _conditioned(robot, end, filtered), fastest)
        identify(robot, split.rest, _quick(request.options, request.rotors is not False))
    except (DataError, DegenerateError):
        return None
    return split


def _with_rotors(robot: Robot, split: _Split | None, request: IdentificationRequest) -> Options:
    """The options with rotors, where these are asked for, or predict by far better."""
    options, rotors = request.options, request.rotors
    if rotors is None and split is not None:
        errors = []
        for there in (False, True):
            found = identify(robot, split.rest, _quick(options, there))
            unseen = predict(found.identified, split.unseen)
            errors.append(unseen.rms_nm(unseen.predicted_nm))
        rotors = bool(np.min(errors[1] / np.maximum(errors[0], 1e-12)) < _ROTORS)
    return replace(options, terms=replace(options.terms, motor_inertia=bool(rotors)))


def _quick(options: Options, rotors: bool) -> Options:
    """The same for base parameters alone."""
    terms = replace(options.terms, motor_inertia=rotors)
    return Options(terms, stribeck=False, consistent=False, checked=False)


def _speed(stream: Conditioned) -> FloatArray:
    """How fast the slowest joint is [rad/s]."""
    speeds = np.concatenate([piece.measured.motion.dq for piece in stream.pieces])
    return np.asarray(np.sqrt(np.mean(speeds**2, axis=0)).min())


def _predicted(identification: Identification, stream: Conditioned, which: str = "") -> Prediction:
    friction = friction_of_known(identification)
    found = predict(identification.identified, stream, friction)
    return replace(found, label=f"{which}{stream.label}")
