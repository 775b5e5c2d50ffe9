"""The result of dynamic identification, its verdict, and its file dynamics.json."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Self, TypeAlias

import numpy as np

from visioncal.core.choices import DYNAMICS_FILE
from visioncal.core.codec import read, reading, write
from visioncal.core.documents.jsons import check_schema, parse_stored
from visioncal.core.errors import DataError
from visioncal.core.files import read_bytes, write_json
from visioncal.core.limits import DynamicsLimits
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray, Mask
from visioncal.core.verdict import NOTE, Finding, Remedy, Verdict, VerdictStatus
from visioncal.core.version import __version__
from visioncal.dynamics.base import BaseModel, Consistent, random_motion
from visioncal.dynamics.model import DynamicModel, FrictionTerms, JointMotion
from visioncal.dynamics.regression import Stribeck
from visioncal.dynamics.statistics import Lag, StreamStatistics, TorqueValidation
from visioncal.robot import Robot
from visioncal.robot.files import robot_names
from visioncal.robot.inertia import Inertias
from visioncal.robot.loads import STANDARD_GRAVITY_M_S2

# Classes of a parameter's relative sigma; beyond the last it is not determined.
CLASSES = ((0.02, "2 %"), (0.1, "10 %"), (1.0, "poorly"))
UNKNOWN = "not at all"
_LIMITS = DynamicsLimits()
_Judged: TypeAlias = tuple[VerdictStatus, Finding]
_MOTION = "Record, and fit with this one, a motion"
SCHEMA = 1  # Version of the file's form.


@dataclass(frozen=True, eq=False)
class Identified:
    """Identified dynamics of an arm; `save` writes them as dynamics.json."""

    robot: Robot  # The arm before identification.
    base: BaseModel  # Its model in base parameters.
    values: FloatArray  # (b,) the base parameters.
    # (b + 2 a, b + 2 a) of these, of a Stribeck humps [N m], and of the logarithms of their speeds.
    covariance: FloatArray
    stribeck: Stribeck  # The humps.
    # Consistent standard parameters; None where the robot's inertias are not known.
    consistent: Consistent | None
    streams: tuple[StreamStatistics, ...]  # Statistics of the fitted streams.
    # Prediction errors of torques that were not fitted; None where there were none.
    validation: TorqueValidation | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)  # Provenance: session, digest, date.
    lag: Lag | None = None  # Delay of the torques, which was corrected; None where not significant.
    differences: tuple[str, ...] = ()  # How streams differ that are predicted badly from another.

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Loads a dynamics.json, or that of a folder; raises DataError if missing or invalid."""
        path = Path(path)
        if path.is_dir() and not (path / DYNAMICS_FILE).exists():
            raise DataError(
                f"{path} has no {DYNAMICS_FILE}, as visioncal dynamics identify writes it.",
                culprits=[str(path)],
                next_step="Identify the arm first, and name its output folder: visioncal dynamics "
                "identify --help",
            )
        path = path / DYNAMICS_FILE if path.is_dir() else path
        with reading(
            str(path), f"a {DYNAMICS_FILE}", "Write one with visioncal dynamics identify."
        ):
            return cls(**fields_from_document(parse_stored(read_bytes(path), str(path))))

    def save(self, path: Path | str) -> None:
        """Writes a dynamics.json atomically; raises DataError where it cannot be written."""
        write_json(path, to_document(self))

    @property
    def sigmas(self) -> FloatArray:
        """(b,) standard deviations of the base parameters."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[: self.base.rank]))

    @property
    def determined(self) -> tuple[str, ...]:
        """Class of each base parameter's relative sigma: `2 %`, `10 %`, `poorly`, `not at all`."""
        shares = self.sigmas / np.maximum(np.abs(self.values), 1e-300)
        return tuple(
            next((word for most, word in CLASSES if share < most), UNKNOWN) for share in shares
        )

    @cached_property
    def inertias(self) -> Inertias | None:
        """Consistent inertias of the links; None where the robot's own were not known."""
        return None if self.consistent is None else self.consistent.inertias(self.robot.joint_count)

    @property
    def standard(self) -> Consistent:
        """The consistent standard parameters; raises DataError where there are none."""
        if self.consistent is None:
            raise DataError(
                f"dynamics: the inertias of {self.robot.name} were not known when it was "
                "identified, so its links have none.",
                culprits=[self.robot.name],
                next_step="State mass_kg, com_m and inertia_kg_m2 of its joints, and identify "
                "again.",
            )
        return self.consistent

    def torques(self, motion: JointMotion) -> FloatArray:
        """Drive torques (m, n) by the base parameters [N m]."""
        return np.asarray(self.base.regressor(motion) @ self.values + self.stribeck.torques(motion))

    def consistent_torques(self, motion: JointMotion) -> FloatArray:
        """Drive torques (m, n) by the consistent standard parameters [N m], or DataError."""
        values = self.base.of(self.standard.values)
        return np.asarray(self.base.regressor(motion) @ values + self.stribeck.torques(motion))


def _check(kind: str, words: str, do: Remedy) -> _Judged:
    return "check", Finding(kind, words, do)


def _plan(identified: Identified, words: str) -> Remedy:
    """Advice to record a planned motion, with the command for a robot that visioncal knows."""
    name = identified.robot.name
    command = f"visioncal dynamics plan {name} -o motions" if name in robot_names() else ""
    return Remedy(f"{words}; visioncal dynamics plan writes some.", command)


def judge(identified: Identified) -> Verdict:
    """Judges identified dynamics by their predictions, and by what the motion determined."""
    judged = [
        *_of_size(identified),
        *_of_signs(identified),
        *_of_differences(identified),
        *_of_lag(identified),
        *_of_prediction(identified),
        *_of_range(identified),
    ]
    statuses = {status for status, _ in judged}
    worst: VerdictStatus = (
        "bad" if "bad" in statuses else "check" if "check" in statuses else "good"
    )
    return Verdict(worst, tuple(finding for _, finding in judged))


def _of_size(identified: Identified) -> Iterator[_Judged]:
    """Checks that links of an arm of this reach can be as heavy as their torques say."""
    model = identified.base.model
    motion = random_motion(model, np.random.default_rng(0))
    is_link = identified.base.independent < len(model.names) - len(
        model.terms.names(identified.robot.joint_count)
    )
    still = np.zeros_like(motion.q)
    by_weight, by_inertia = (
        identified.base.regressor(JointMotion(motion.times_s, motion.q, still, ddq))
        @ np.where(is_link, identified.values, 0.0)
        for ddq in (still, motion.ddq)
    )
    flange = identified.robot.base_from_flange(motion.q)[:, :3, 3]
    reach_m = float(np.linalg.norm(flange, axis=1).max())
    push = float(np.linalg.norm(motion.ddq, axis=1).max())
    # A torque is at most that of all of the mass at the full reach.
    mass_kg = max(
        float(np.abs(by_weight).max()) / (STANDARD_GRAVITY_M_S2 * reach_m),
        float(np.abs(by_inertia - by_weight).max()) / (push * reach_m**2),
    )
    # Mass at the full reach that would have an arm's torques, over the cube of the reach [kg/m^3].
    # The whole mass of arms is 6 (a light cobot) to 150 (a foundry's robot) by this, a tenth of it
    # or more acts there, and wrong units differ by a thousand.
    light, heavy = (density * reach_m**3 for density in (0.1, 1000.0))
    if light <= mass_kg <= heavy:
        return
    factor = 0.001 if mass_kg > heavy else 1000.0
    unit = "N mm, or mA for A" if mass_kg > heavy else "kN m, or A for mA"
    words = (
        f"The torques are in another unit ({unit}): by them links that reach {figure(reach_m)} m "
        f"have {figure(mass_kg)} kg at that distance, and such arms have {figure(light)} to "
        f"{figure(heavy)} kg."
    )
    step = f"Give tau1_nm ... in N m: multiply them, or their gains, by {factor:g}."
    yield "bad", Finding("torque_unit", words, Remedy(step))


def _of_signs(identified: Identified) -> Iterator[_Judged]:
    """Checks that dry friction brakes each joint: what drives it is a torque of the other sign."""
    names, values = identified.base.names, identified.values
    for joint in range(identified.robot.joint_count):
        if (name := f"Fc{joint + 1}") not in names:
            continue
        at = names.index(name)
        sigma = float(np.sqrt(identified.covariance[at, at]))
        # Sigmas by which dry friction below zero is no chance.
        if values[at] < -5.0 * sigma:
            words = (
                f"Joint {joint + 1}: its dry friction is {figure(float(values[at]))} N m (sigma "
                f"{figure(sigma)}), and friction drives no joint: its torque, or its angle, has "
                "the other sign."
            )
            column = f"tau{joint + 1}_nm"
            yield "bad", Finding("sign", words, Remedy(f"Change the sign of {column} or its gain."))


def _of_differences(identified: Identified) -> Iterator[_Judged]:
    step = Remedy(
        "Fit streams that were recorded alike: warmed up, with the same on the flange, and with "
        "the gains of all drives (--gains; visioncal dynamics gains finds them)."
    )
    for words in identified.differences:
        yield _check("differs", words, step)


def _of_lag(identified: Identified) -> Iterator[_Judged]:
    lag = identified.lag
    if lag is None:
        return
    share = figure(100.0 * lag.share)
    words = f"{lag.words} As they stood, that was up to {share} % of a joint's range."
    if lag.share < _LIMITS.lag_share:
        yield "good", Finding(NOTE, words)
        return
    step = Remedy(
        "Record angles and torques by one clock, and filter neither of them, or both alike: a lag "
        "that changes is undone in the mean alone."
    )
    yield _check("lag", words, step)


def _of_prediction(identified: Identified) -> Iterator[_Judged]:
    validation = identified.validation
    if validation is None:
        yield _check(
            "unchecked",
            "Nothing was left to predict: the torques that were fitted are no proof.",
            _plan(identified, "Record a second motion, and name it with --validate-on"),
        )
        return
    shares = validation.shares
    worst = int(np.argmax(shares))
    percents = ", ".join(figure(100.0 * float(share)) for share in shares)
    status: VerdictStatus = "good"
    if shares[worst] > _LIMITS.range_share[0]:
        # A joint whose torque hardly changes in these samples has its range in the fitted ones.
        ranges_nm = np.max([stream.torque_nm for stream in identified.streams], axis=0)
        true = validation.rms_nm / np.maximum(np.maximum(ranges_nm, validation.torque_nm), 1e-12)
        status = "bad" if true.max() > _LIMITS.range_share[1] else "check"
    yield (
        status,
        Finding(
            "prediction",
            f"The torques of {validation.label} are predicted to {percents} % of their "
            f"range (joints 1 to {len(shares)}).",
        ),
    )
    bodies = validation.consistent_rms_nm
    if bodies is not None:
        worse = bodies > _LIMITS.bodies_worse * validation.rms_nm
        if worse.any():
            yield _check(
                "bodies",
                f"{_joints(worse)}: no bodies near the known ones explain the torques as "
                "well; friction may be of another kind.",
                Remedy(
                    "Check whether it is the robot that was recorded, whether it stands upright "
                    "([robot] gravity_m_s2), and what is on its flange."
                ),
            )


def _of_range(identified: Identified) -> Iterator[_Judged]:
    """Checks the predicted uncertainty of the torques of fast motions of all joints."""
    # The uncertainty is that of the motion only where the model explains what was fitted.
    fits = [stream.rms_nm / np.maximum(stream.torque_nm, 1e-12) for stream in identified.streams]
    if identified.differences or np.max(fits) > _LIMITS.range_share[0]:
        return
    base = identified.base
    motion = random_motion(base.model, np.random.default_rng(0))
    x = base.regressor(motion)
    covariance = identified.covariance[: base.rank, : base.rank]
    sigma = np.sqrt(np.mean(np.einsum("mnp,pq,mnq->mn", x, covariance, x, optimize=True), axis=0))
    share = sigma / np.sqrt(np.mean((x @ identified.values) ** 2, axis=0))
    if share.max() > _LIMITS.range_share[0]:
        yield _check(
            "weak_motion",
            f"{_joints(share > _LIMITS.range_share[0])}: what fast motions take (up to "
            f"{np.abs(motion.dq).max():.0f} rad/s and {np.abs(motion.ddq).max():.0f} rad/s^2) "
            f"is known to {figure(100.0 * float(share.max()))} % only: this motion was too "
            "slow, too small or too short.",
            _plan(identified, _MOTION),
        )


def _joints(which: Mask) -> str:
    places = [str(index + 1) for index in np.flatnonzero(which)]
    return f"Joint{'s' if len(places) > 1 else ''} {', '.join(places)}"


def to_document(identified: Identified) -> dict[str, Any]:
    """Builds the content of dynamics.json; fields that were not computed are absent."""
    base = identified.base
    document: dict[str, Any] = {"schema": SCHEMA, "visioncal": __version__, **identified.facts}
    document |= {
        "robot": dict(identified.robot.document),
        "friction": vars(base.model.terms),
        "base": [
            {"name": name, "value": value, "sigma": sigma, "determined": determined}
            for name, value, sigma, determined in zip(
                base.names,
                identified.values.tolist(),
                identified.sigmas.tolist(),
                identified.determined,
                strict=True,
            )
        ],
        "covariance": identified.covariance.tolist(),
        "stribeck": stribeck_rows(identified),
        "streams": [write(StreamStatistics, stream) for stream in identified.streams],
    }
    if identified.consistent is not None:
        document["standard"] = {
            "parameters": [
                {"name": name, "value": value, "sigma": sigma}
                for name, value, sigma in zip(
                    identified.base.model.names,
                    identified.consistent.values.tolist(),
                    np.sqrt(np.diag(identified.consistent.covariance)).tolist(),
                    strict=True,
                )
            ],
            "covariance": identified.consistent.covariance.tolist(),
            "misfit": identified.consistent.misfit,
        }
    if identified.differences:
        document["differences"] = list(identified.differences)
    if identified.lag is not None:
        document["lag"] = write(Lag, identified.lag)
    if identified.validation is not None:
        shares = {"share": identified.validation.shares.tolist()}
        document["validation"] = write(TorqueValidation, identified.validation) | shares
    verdict = judge(identified)
    return document | {"verdict": {"status": verdict.status, "reasons": list(verdict.reasons)}}


def stribeck_rows(identified: Identified) -> list[dict[str, Any]]:
    """Parameters of each joint with a Stribeck hump."""
    humps, count = identified.stribeck, len(identified.stribeck.joints)
    names = [identified.base.model.names[index] for index in identified.base.independent]
    rows = []
    for at, joint in enumerate(humps.joints.tolist()):
        coulomb_index = names.index(f"Fc{joint + 1}")
        hump_index, log_index = (identified.base.rank + at + part * count for part in (0, 1))
        covariance = identified.covariance[
            np.ix_([coulomb_index, hump_index], [coulomb_index, hump_index])
        ]
        coulomb, extra = float(identified.values[coulomb_index]), float(humps.hump_nm[at])
        gradient = np.array([-extra / coulomb**2, 1.0 / coulomb])
        rows.append(
            {
                "joint": joint + 1,
                "hump_nm": extra,
                "hump_sigma_nm": float(np.sqrt(covariance[1, 1])),
                "static_nm": coulomb + extra,
                "static_sigma_nm": float(np.sqrt(covariance.sum())),
                "static_over_coulomb": 1.0 + extra / coulomb,
                "static_over_coulomb_sigma": float(np.sqrt(gradient @ covariance @ gradient)),
                "speed_rad_s": float(humps.speed_rad_s[at]),
                "speed_sigma_rad_s": float(
                    humps.speed_rad_s[at] * np.sqrt(identified.covariance[log_index, log_index])
                ),
            }
        )
    return rows


_OWN_KEYS = frozenset(
    {"schema", "visioncal", "robot", "friction", "base", "covariance", "stribeck", "streams"}
    | {"standard", "lag", "validation", "verdict", "differences"}
)


def fields_from_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """Reads the fields of `Identified` from a document of `to_document`.

    Raises:
        DataError: It is of another schema.
        LookupError, TypeError, ValueError, AttributeError: It does not match the schema.
    """
    check_schema(document, SCHEMA, "Write one with visioncal dynamics identify.")
    robot = Robot.from_document(document["robot"])
    terms = FrictionTerms(**document["friction"])
    model = DynamicModel(robot, terms)
    # `BaseModel.reduce` may keep other parameters: its choice depends on rounding, and so on the
    # machine.
    kept = [model.names.index(str(row["name"]).split()[0]) for row in document["base"]]
    base = BaseModel.keeping(model, np.array(kept, dtype=np.int64))
    humps, standard, consistent = document["stribeck"], document.get("standard"), None
    size, count = base.rank + 2 * len(humps), len(model.names)
    if standard is not None:
        values = _column(standard["parameters"], "value")
        if values.shape != (count,):
            raise ValueError(f"it has {len(values)} standard parameters instead of {count}")
        covariance = _array(standard["covariance"], (count, count))
        consistent = Consistent(values, covariance, standard["misfit"])
    figures = read(_Figures, document, "")
    for stream in (*figures.streams, figures.validation):
        for name, value in vars(stream).items() if stream else ():
            if isinstance(value, np.ndarray) and len(value) != robot.joint_count:
                raise ValueError(f"{name} has {len(value)} numbers for {robot.joint_count} joints")
    return {
        "robot": robot,
        "base": base,
        "values": _column(document["base"], "value"),
        "covariance": _array(document["covariance"], (size, size)),
        "stribeck": Stribeck(
            np.array([int(row["joint"]) - 1 for row in humps], dtype=np.int64),
            _column(humps, "hump_nm"),
            _column(humps, "speed_rad_s"),
            terms.slow_rad_s,
        ),
        "consistent": consistent,
        **vars(figures),
        "facts": {name: value for name, value in document.items() if name not in _OWN_KEYS},
    }


@dataclass(frozen=True)
class _Figures:
    """The fields that the codec reads."""

    streams: tuple[StreamStatistics, ...]
    validation: TorqueValidation | None = None
    lag: Lag | None = None
    differences: tuple[str, ...] = ()


def _column(rows: Sequence[Mapping[str, Any]], name: str) -> FloatArray:
    return np.array([float(row[name]) for row in rows])


def _array(values: object, shape: tuple[int, ...]) -> FloatArray:
    array = np.asarray(values, dtype=float)
    if array.shape != shape:
        raise ValueError(f"an array has the shape {array.shape}, but must have {shape}")
    return array
