"""Records of `visioncal dynamics`: its commands' options, and their help."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

from visioncal.cli.options import json_flag, out_folder
from visioncal.cli.session_options import ClearanceOptions, kept_option
from visioncal.core.choice import robot_name
from visioncal.core.choices import DYNAMICS_FILE, GAIN_SIGMA
from visioncal.core.options import REQUIRED, argument, flag, numbers_option, option

# Terms of friction that torques determine, and those that a motion can be planned for.
FRICTION = ("coulomb", "viscous", "offset")
PLANNED_FRICTION = (*FRICTION, "motor-inertia")

motions_argument = partial(argument, "A session with streams of angles and torques.")
cutoff_option = partial(
    option, "Of the low-pass; else ten times the motion's band.", "--cutoff-hz", min=0.1
)
against_option = partial(
    option, f"A folder of identify, or its {DYNAMICS_FILE}.", "--against", default=REQUIRED
)


@dataclass(frozen=True, kw_only=True)
class StreamOptions:
    """Choice of samples, and conversion of currents to torques."""

    stream: list[str] | None = option("A stream with torques; may be repeated. Default: all.")
    cutoff_hz: float | None = cutoff_option()
    gains: str | None = option("Torque for a current, by joint [N m/A].", metavar="K1,K2,...")
    robot: str | None = robot_name()


_motion = partial(option, panel="The motion")
_missing = partial(option, panel="What its description lacks")


@dataclass(frozen=True, kw_only=True)
class DynamicsPlanOptions(ClearanceOptions):
    """Plan the motions that determine an arm's inertias and friction.

    Writes an exciting motion and sweeps as tables (.csv), plan.json and plan.rrd to look at.
    Nothing is sent to a robot. Exit status 2: the limits allow none.
    """

    first: ClassVar = "out duration payload tool"
    robot: str = argument("A built-in robot, or the path of a .urdf, .toml or .json.")
    duration: float = _motion("Duration of the exciting motion, in s.", default=20.0)
    harmonics: int = _motion("Harmonics of that period.", default=5)
    friction: str = _motion(
        f"Identified, too: {', '.join(PLANNED_FRICTION)}; or none.",
        default="coulomb,viscous,offset",
    )
    sweep_speeds: int = _motion("Speeds at which each joint sweeps.", default=6, min=2, max=30)
    no_sweeps: bool = _motion("Only the exciting motion.", "--no-sweeps", default=False)
    rate_hz: float = _motion(
        "Sampling rate of the tables.", "--rate", default=500.0, min=1.0, max=4000.0
    )
    starts: int = _motion("Random motions to search from.", default=4)
    seconds: float | None = _motion("Longest search on one core (s).", min=1.0)
    seed: int = _motion("Random seed of the starts.", default=0, min=0)
    speed: float = kept_option("Fraction of the maximum speeds.", default=0.9)
    acceleration: float = kept_option("Fraction of the maximum accelerations.", default=0.9)
    torque_margin: float = kept_option("Safety factor on nominal torques.", default=1.2)
    tool: tuple[float, float] | None = numbers_option(
        "A tool that sticks out of the flange, along its z, in mm.",
        form="length,radius",
        panel="What the arm must keep",
    )
    payload: tuple[float, ...] | None = numbers_option(
        "Payload of the flange: its mass, and its centre in the flange's frame in mm.",
        form="kg,x,y,z",
        panel="What the arm must keep",
    )
    range_deg: float | None = _missing("Either way, of joints without limits.", min=1e-3, max=1e6)
    speed_deg: float | None = _missing("Maximum speed, in deg/s.", min=1e-3, max=1e6)
    acceleration_deg: float | None = _missing(
        "Largest acceleration, in deg/s^2.", min=1e-3, max=1e6
    )
    out: Path = out_folder(default=Path("motions"))
    as_json: bool = json_flag()


@dataclass(frozen=True, kw_only=True)
class DynamicsRecordOptions:
    """Record angles, speeds and motor currents at the controller's full rate.

    The motion is another program's: start that once this command waits for it. Exit status 0: it
    is recorded; 2: it is not.
    """

    out: Path = argument("The session's folder, which is made or gets another stream.")
    arm: str = option("The arm: ur:HOST.", default=REQUIRED)
    stream: str = option("Name of the recorded stream.", default="excite")
    robot: str | None = option("Model of the arm; by default the controller's.")
    rest_s: float = option("The motion ends after this time at rest (s).", default=3.0, min=0.5)


@dataclass(frozen=True, kw_only=True)
class DynamicsIdentifyOptions(StreamOptions):
    """Identify an arm's inertias and friction from the torques of its motions.

    Exit status 0: there is a result to use; 3: its verdict is bad; 2: there is none, for the reason
    given.
    """

    first: ClassVar = "output validate_on robot as_json"
    session: Path = motions_argument()
    validate_on: str | None = option("A stream to predict; else the end of the fastest.")
    output: Path | None = out_folder(f"A folder for {DYNAMICS_FILE} and report.", "-o", "--output")
    friction: str = option(
        f"Terms: {', '.join(FRICTION)}; or none.", default="coulomb,viscous,offset"
    )
    rotors: bool | None = option(
        "Motors' inertia in the torques; else as fits best.", "--rotors/--no-rotors"
    )
    stribeck: bool = option("Humps of friction.", "--stribeck/--no-stribeck", default=True)
    unchecked: bool = flag("Take torques that contradict the robot's inertias.")
    as_json: bool = json_flag()


@dataclass(frozen=True, kw_only=True)
class DynamicsValidateOptions(StreamOptions):
    """Predict the torques of other motions, and say how near that comes.

    Exit status 0: there are figures; 3: a joint's errors exceed half of its torques' standard
    deviation; 2: there are no figures, for the reason given.
    """

    session: Path = motions_argument()
    against: Path = against_option()
    as_json: bool = json_flag()


@dataclass(frozen=True, kw_only=True)
class DynamicsPayloadOptions(StreamOptions):
    """Weigh what the arm carries, by how much more its drives gave than without it.

    Exit status 0: there are figures; 2: there are none, for the reason given.
    """

    session: Path = motions_argument()
    against: Path = against_option()
    same_friction: bool = flag("Friction is as it was without the payload, however it presses.")
    gains_sigma: float = option("Sigma of --gains, in %.", default=100.0 * GAIN_SIGMA, min=0.0)
    as_json: bool = json_flag()


@dataclass(frozen=True, kw_only=True)
class DynamicsGainsOptions:
    """Find how much torque a drive's current makes, by a body that is known.

    Exit status 0: there are gains; 2: there are none, for the reason given.
    """

    session: Path = motions_argument()
    loaded: Path = option("A session of the same arm with the body on it.", default=REQUIRED)
    mass_kg: float = option("Of the body (kg).", default=REQUIRED)
    com_mm: tuple[float, float, float] = numbers_option(
        "Its centre of mass in the flange's frame (mm).", form="x,y,z", default=REQUIRED
    )
    inertia: tuple[float, ...] = numbers_option(
        "Its inertia about that centre (kg m^2).", form="xx,xy,yy,xz,yz,zz", default="0,0,0,0,0,0"
    )
    cutoff_hz: float | None = cutoff_option()
    named: str | None = robot_name()
    unchecked: bool = flag("Take gains that contradict the currents or the robot's inertias.")
    as_json: bool = json_flag()
