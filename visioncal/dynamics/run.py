"""`visioncal dynamics identify`: identification from a session, with its validation."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime

import numpy as np

from visioncal.core.errors import DataError, DegenerateError
from visioncal.core.limits import DynamicsLimits
from visioncal.core.number_format import known_name
from visioncal.core.threads import on_one_blas_thread
from visioncal.dynamics.conditioning import Conditioned, condition
from visioncal.dynamics.differences import scale_difference, stream_differences
from visioncal.dynamics.identified import Identified
from visioncal.dynamics.identify import (
    Identification,
    Options,
    Prediction,
    find_lag,
    identify,
    predict,
    validate,
)
from visioncal.dynamics.reading import RecordedSamples, read_recorded
from visioncal.dynamics.statistics import Lag
from visioncal.robot import Robot
from visioncal.session import STREAMS, Session
from visioncal.session.selecting import ARM, Choice, check_one_of_each, select

# Share of the fastest motion, at its end, held out for validation where no other stream is.
HELD_OUT = 0.3


@dataclass(frozen=True)
class IdentificationRequest:
    """Options of `identify_session`."""

    # Names of the streams to fit; all with torques or currents where empty.
    streams: tuple[str, ...] = ()
    validate_on: str = ""  # The stream to predict; the end of the fastest motion where empty.
    cutoff_hz: float | None = None  # Cut-off of the low-pass [Hz]; by the motion where None.
    # Torque per current, by joint, where currents were recorded [N m/A].
    gains_nm_a: tuple[float, ...] = ()
    options: Options = field(default_factory=Options)  # The unknowns.
    # Whether rotor inertias are estimated; None to decide by the held-out torques, since torques
    # sensed behind the gears do not include them.
    rotors: bool | None = None
    # A robot of a whole cell; its streams have, or begin with, its name.
    robot: str | None = None
    lag_s: float | None = None  # Delay of the torques behind the angles; estimated where None [s].


@dataclass(frozen=True, eq=False)
class _Split:
    """Streams without the end of the fastest one, that held-out end, and the stream's index."""

    fitted: tuple[Conditioned, ...]
    held_out: Conditioned
    fastest: int


@dataclass(frozen=True, eq=False)
class Run:
    """Identified dynamics of a session, the fit, and measured and predicted torques.

    `fitted` are those of the fitted streams; `predicted` were not fitted, and may be None.
    """

    session: Session
    identified: Identified
    identification: Identification
    predicted: Prediction | None
    fitted: tuple[Prediction, ...]

    @property
    def predictions(self) -> tuple[Prediction, ...]:
        """All predictions, the unfitted ones last."""
        return self.fitted if self.predicted is None else (*self.fitted, self.predicted)


@on_one_blas_thread
def identify_session(session: Session, request: IdentificationRequest | None = None) -> Run:
    """Identifies the dynamics of a session's arm.

    Args:
        session: With streams of angles and torques.
        request: Options.

    Raises:
        DataError: The session has no robot or no such stream, or a stream is wrong.
        DegenerateError: The motion does not determine all base parameters.
    """
    request = IdentificationRequest() if request is None else request
    session = select_arm(session, request.robot)
    robot = robot_of(session)
    candidates = _torque_streams(session, request.streams)
    names = [name for name in candidates if name != request.validate_on]
    if not names:
        raise DataError(
            f"session {session.name!r}: {request.validate_on} is its only stream of torques, and "
            "a fit cannot be validated by its own data.",
            culprits=[request.validate_on],
            next_step="Leave --validate-on out: then the end of the motion is predicted.",
        )
    recorded = [_read(session, robot, name, request) for name in names]
    streams, lag = _lag_corrected(
        robot, [_conditioned(robot, item, request) for item in recorded], request
    )
    request = replace(request, lag_s=request.lag_s if lag is None else lag.seconds)
    split = _split(robot, recorded, streams, request)
    options, rotors = request.options, request.rotors
    if rotors is None and split is not None:
        errors = []
        for with_rotors in (False, True):
            fit = identify(robot, split.fitted, _quick(options, with_rotors))
            ahead = predict(fit.identified, split.held_out)
            errors.append(ahead.rms_nm(ahead.predicted_nm))
        # Rotors are kept where they help some joint clearly.
        rotors = bool(np.min(errors[1] / np.maximum(errors[0], 1e-12)) < 0.75)
    options = replace(options, terms=replace(options.terms, motor_inertia=bool(rotors)))
    identification = identify(robot, streams, options)
    predicted, validation, compared = None, None, list(streams)
    compared.insert(0, compared.pop(_fastest(streams)))
    if request.validate_on:
        validation_samples = _read(session, robot, request.validate_on, request)
        fresh = _conditioned(robot, validation_samples, request)
        predicted = predict(identification.identified, fresh)
        validation = validate(identification.identified, predicted)
        compared.append(fresh)
    elif split is not None:
        without_end = identify(robot, split.fitted, replace(options, checked=False))
        predicted = predict(without_end.identified, split.held_out)
        predicted = replace(predicted, label=f"the last 30 % of {predicted.label}")
        # In a part of a motion a joint's torque may be constant.
        ranges_nm = identification.identified.streams[split.fastest].torque_nm
        validation = replace(validate(identification.identified, predicted), torque_nm=ranges_nm)
    differences: tuple[str, ...] = ()
    if validation is not None and validation.shares.max() > DynamicsLimits().differs_share:
        differences = tuple(stream_differences(robot, compared, options))
        if not differences and (words := scale_difference(identification)):
            differences = (words,)
    identified = replace(
        identification.identified,
        differences=differences,
        validation=validation,
        lag=lag,
        facts={
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "session": {"name": session.name, "sha256": session.digest()},
        },
    )
    fitted = tuple(predict(identified, stream) for stream in streams)
    return Run(session, identified, identification, predicted, fitted)


@on_one_blas_thread
def conditioned_streams(
    session: Session, identified: Identified, request: IdentificationRequest
) -> list[Conditioned]:
    """Reads a session's streams, filtered like those of an identification.

    Raises:
        DataError: The robot is another one, there is no such stream, or a stream is wrong.
    """
    robot, session = identified.robot, select_arm(session, request.robot)
    names = _torque_streams(session, request.streams)
    recorded = [_read(session, robot, name, request) for name in names]
    cutoff_hz = request.cutoff_hz or identified.streams[0].cutoff_hz
    filtered = replace(request, cutoff_hz=cutoff_hz)
    streams = [_conditioned(robot, item, filtered) for item in recorded]
    streams, lag = _lag_corrected(robot, streams, request)
    if lag is None:
        return streams
    return [
        replace(stream, notes=(*stream.notes, f"{stream.label}: {lag.words}")) for stream in streams
    ]


@on_one_blas_thread
def current_streams(
    session: Session, robot: Robot, cutoff_hz: float | None = None
) -> list[Conditioned]:
    """Reads a session's streams of currents, for drives of unknown gains; torques are currents [A].

    The low-pass is chosen by the motion where no cut-off is given [Hz].

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


def select_arm(session: Session, robot: str | None = None) -> Session:
    """Selects one robot and its streams from a session; raises DataError if that is ambiguous."""
    return select(session, Choice(robot=robot), ARM)


def robot_of(session: Session) -> Robot:
    """The session's robot; raises DataError if it names none that is known, or several."""
    check_one_of_each(session)
    if session.robot_document is None:
        raise DataError(
            f"session {session.name!r} names no known robot, and torques are those of its links.",
            culprits=["session.toml: robot.model"],
            next_step=" ".join(session.warnings)
            or 'Add model = "ur10e", or a path, to [robot], of a whole cell to its table, as '
            "[robots.a].",
        )
    return Robot.from_document(session.robot_document)


def _torque_streams(session: Session, wanted: Sequence[str] = ()) -> list[str]:
    """Names of the wanted streams; by default of all with torques or currents."""
    for name in wanted:
        known_name("stream", name, session.streams, of=f"session {session.name!r}")
    if wanted:
        return list(dict.fromkeys(wanted))
    drives = ("tau1_nm", "current1_a")
    names = [
        name
        for name, stream in session.streams.items()
        if any(column in stream for column in drives)
    ]
    if not names:
        raise DataError(
            f"session {session.name!r} has no stream with torques or currents: "
            f"{', '.join(session.streams) or 'it has no streams'}.",
            culprits=[f"{STREAMS}/{stream}.csv" for stream in session.streams],
            next_step=f"Put them into {STREAMS}/NAME.csv: stamp_s, q1_rad ..., and tau1_nm ... or "
            "current1_a ....",
        )
    return names


def _read(
    session: Session, robot: Robot, name: str, request: IdentificationRequest
) -> RecordedSamples:
    (name,) = _torque_streams(session, [name])
    label = f"{STREAMS}/{name}.csv"
    return read_recorded(session.streams[name], label, robot.joint_count, request.gains_nm_a)


def _conditioned(
    robot: Robot, recorded: RecordedSamples, request: IdentificationRequest
) -> Conditioned:
    conditioned = condition(recorded, request.cutoff_hz, robot.rates.torque)
    return conditioned.lag_corrected(request.lag_s) if request.lag_s else conditioned


def _lag_corrected(
    robot: Robot, streams: list[Conditioned], request: IdentificationRequest
) -> tuple[list[Conditioned], Lag | None]:
    """The streams with the torques' lag corrected, and the lag if it was estimated."""
    lag = None
    if request.lag_s is None:
        lag = find_lag(robot, streams, request.options.terms)
    return streams if lag is None else [
        stream.lag_corrected(lag.seconds) for stream in streams
    ], lag


def _split(
    robot: Robot,
    recorded: Sequence[RecordedSamples],
    streams: Sequence[Conditioned],
    request: IdentificationRequest,
) -> _Split | None:
    """Holds out the end of the fastest motion; None where the rest determines too little."""
    fastest = _fastest(streams)
    filtered = replace(request, cutoff_hz=streams[fastest].cutoff_hz)
    begin = recorded[fastest].part(0.0, 1.0 - HELD_OUT)
    end = recorded[fastest].part(1.0 - HELD_OUT, 1.0)
    rest = list(streams)
    try:
        rest[fastest] = _conditioned(robot, begin, filtered)
        split = _Split(tuple(rest), _conditioned(robot, end, filtered), fastest)
        identify(robot, split.fitted, _quick(request.options, request.rotors is not False))
    except (DataError, DegenerateError):
        return None
    return split


def _fastest(streams: Sequence[Conditioned]) -> int:
    """Index of the stream with the greatest root mean square speed of its slowest joint."""
    # Sweeps move one joint after the other: no part of them is representative.
    speeds = [
        np.concatenate([piece.measured.motion.dq for piece in stream.pieces]) for stream in streams
    ]
    return int(np.argmax([np.sqrt(np.mean(dq**2, axis=0)).min() for dq in speeds]))


def _quick(options: Options, rotors: bool) -> Options:
    """Options for base parameters alone."""
    terms = replace(options.terms, motor_inertia=rotors)
    return Options(terms, stribeck=False, consistent=False, checked=False)
