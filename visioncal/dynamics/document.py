"""dynamics.json."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.core.version import __version__
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.consistent import Consistent
from visioncal.dynamics.identified import Identified, Lag, StreamFacts, Validation
from visioncal.dynamics.judge import judge
from visioncal.dynamics.model import DynamicModel, FrictionTerms
from visioncal.dynamics.stribeck import Stribeck
from visioncal.robot import Robot

SCHEMA = 1
# What a validation has of each joint, always and where it is known.
_ALWAYS = ("rms_nm", "torque_nm", "noise_nm")
_MAYBE = ("consistent_rms_nm", "known_rms_nm")


def to_document(identified: Identified) -> dict[str, Any]:
    """Builds the content of dynamics.json; what was not computed is absent."""
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
        "streams": [_stream_document(it) for it in identified.streams],
    }
    if identified.consistent is not None:
        document["standard"] = _standard_document(identified, identified.consistent)
    if identified.lag is not None:
        document["lag"] = vars(identified.lag)
    if identified.validation is not None:
        document["validation"] = _validation_document(identified.validation)
    verdict = judge(identified)
    return document | {"verdict": {"status": verdict.status, "reasons": list(verdict.reasons)}}


def stribeck_rows(identified: Identified) -> list[dict[str, Any]]:
    """The parameters of each joint whose friction has a hump at low speed."""
    humps, count = identified.stribeck, len(identified.stribeck.joints)
    names = [identified.base.model.names[it] for it in identified.base.independent]
    rows = []
    for at, joint in enumerate(humps.joints.tolist()):
        sliding = names.index(f"Fc{joint + 1}")
        hump, log = (identified.base.rank + at + part * count for part in (0, 1))
        covariance = identified.covariance[np.ix_([sliding, hump], [sliding, hump])]
        coulomb, extra = float(identified.values[sliding]), float(humps.hump_nm[at])
        slope = np.array([-extra / coulomb**2, 1.0 / coulomb])
        rows.append(
            {
                "joint": joint + 1,
                "hump_nm": extra,
                "hump_sigma_nm": float(np.sqrt(covariance[1, 1])),
                "static_nm": coulomb + extra,
                "static_sigma_nm": float(np.sqrt(covariance.sum())),
                "static_over_coulomb": 1.0 + extra / coulomb,
                "static_over_coulomb_sigma": float(np.sqrt(slope @ covariance @ slope)),
                "speed_rad_s": float(humps.speed_rad_s[at]),
                "speed_sigma_rad_s": float(
                    humps.speed_rad_s[at] * np.sqrt(identified.covariance[log, log])
                ),
            }
        )
    return rows


def _stream_document(facts: StreamFacts) -> dict[str, Any]:
    return {
        "stream": facts.label,
        "samples": facts.samples,
        "left_out": facts.left_out,
        "band_hz": facts.band_hz,
        "cutoff_hz": facts.cutoff_hz,
        "rate_hz": facts.rate_hz,
        "noise_nm": facts.noise_nm.tolist(),
        "rms_nm": facts.rms_nm.tolist(),
        "torque_nm": facts.torque_nm.tolist(),
        "notes": list(facts.notes),
    }


def _standard_document(identified: Identified, consistent: Consistent) -> dict[str, Any]:
    return {
        "parameters": [
            {"name": name, "value": value, "sigma": sigma}
            for name, value, sigma in zip(
                identified.base.model.names,
                consistent.values.tolist(),
                np.sqrt(np.diag(consistent.covariance)).tolist(),
                strict=True,
            )
        ],
        "covariance": consistent.covariance.tolist(),
        "misfit": consistent.misfit,
    }


def _validation_document(validation: Validation) -> dict[str, Any]:
    arrays = {name: getattr(validation, name) for name in (*_ALWAYS, *_MAYBE)}
    present = {name: it.tolist() for name, it in arrays.items() if it is not None}
    return {"samples": validation.label, **present, "share": validation.shares.tolist()}


_OWN_KEYS = frozenset(
    {"schema", "visioncal", "robot", "friction", "base", "covariance", "stribeck", "streams"}
    | {"standard", "lag", "validation", "verdict"}
)


def fields_from_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """Reads the fields of a result from what `to_document` built.

    Raises:
        LookupError, TypeError, ValueError, AttributeError: It is none of this schema.
    """
    if document.get("schema") != SCHEMA:
        raise ValueError(f"schema is {document.get('schema')!r}, this version reads {SCHEMA}")
    robot = Robot.from_document(document["robot"])
    terms = FrictionTerms(**document["friction"])
    base = _base(DynamicModel(robot, terms), [str(row["name"]) for row in document["base"]])
    size = base.rank + 2 * len(document["stribeck"])
    standard = document.get("standard")
    validation, lag = document.get("validation"), document.get("lag")
    return {
        "robot": robot,
        "base": base,
        "values": _column(document["base"], "value"),
        "covariance": _array(document["covariance"], (size, size)),
        "stribeck": _stribeck(document["stribeck"], terms),
        "consistent": None if standard is None else _consistent(standard, len(base.model.names)),
        "streams": tuple(_stream_facts(it, robot.joint_count) for it in document["streams"]),
        "validation": None if validation is None else _validation(validation, robot.joint_count),
        "lag": None if lag is None else Lag(**{name: float(it) for name, it in lag.items()}),
        "facts": {name: value for name, value in document.items() if name not in _OWN_KEYS},
    }


def _base(model: DynamicModel, names: Sequence[str]) -> BaseModel:
    """The base parameters that begin as those that were written.

    Which ones are kept may hang on rounding, and so on the machine.
    """
    kept = [model.names.index(it.split()[0]) for it in names]
    return BaseModel.keeping(model, np.array(kept, dtype=np.int64))


def _stribeck(rows: Sequence[Mapping[str, Any]], terms: FrictionTerms) -> Stribeck:
    return Stribeck(
        np.array([int(row["joint"]) - 1 for row in rows], dtype=np.int64),
        _column(rows, "hump_nm"),
        _column(rows, "speed_rad_s"),
        terms.slow_rad_s,
    )


def _consistent(document: Mapping[str, Any], count: int) -> Consistent:
    values = _column(document["parameters"], "value")
    if values.shape != (count,):
        raise ValueError(f"it has {len(values)} standard parameters instead of {count}")
    return Consistent(values, _array(document["covariance"], (count, count)), document["misfit"])


def _stream_facts(document: Mapping[str, Any], joints: int) -> StreamFacts:
    def of_joints(name: str) -> FloatArray:
        return _array(document[name], (joints,))

    return StreamFacts(
        label=document["stream"],
        samples=int(document["samples"]),
        left_out=int(document["left_out"]),
        band_hz=float(document["band_hz"]),
        cutoff_hz=float(document["cutoff_hz"]),
        rate_hz=float(document["rate_hz"]),
        noise_nm=of_joints("noise_nm"),
        rms_nm=of_joints("rms_nm"),
        torque_nm=of_joints("torque_nm"),
        notes=tuple(document["notes"]),
    )


def _validation(document: Mapping[str, Any], joints: int) -> Validation:
    arrays = {name: _array(document[name], (joints,)) for name in _ALWAYS}
    more = {name: _array(document[name], (joints,)) for name in _MAYBE if name in document}
    return Validation(document["samples"], **arrays, **more)


def _column(rows: Sequence[Mapping[str, Any]], name: str) -> FloatArray:
    return np.array([float(row[name]) for row in rows])


def _array(values: object, shape: tuple[int, ...]) -> FloatArray:
    array = np.asarray(values, dtype=float)
    if array.shape != shape:
        raise ValueError(f"an array of shape {array.shape} stands where {shape} is needed")
    return array
