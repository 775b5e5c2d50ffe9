"""Reading and writing of dynamics.json."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from visioncal.core.codec import read, write
from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray
from visioncal.core.version import __version__
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.consistent import Consistent
from visioncal.dynamics.identified import Identified, Lag, StreamStatistics, TorqueValidation
from visioncal.dynamics.judge import judge
from visioncal.dynamics.model import DynamicModel, FrictionTerms
from visioncal.dynamics.stribeck import Stribeck
from visioncal.robot import Robot

SCHEMA = 1


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
        document["standard"] = _standard_document(identified, identified.consistent)
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


_OWN_KEYS = frozenset(
    {"schema", "visioncal", "robot", "friction", "base", "covariance", "stribeck", "streams"}
    | {"standard", "lag", "validation", "verdict"}
)


def fields_from_document(document: Mapping[str, Any]) -> dict[str, Any]:
    """Reads the fields of `Identified` from a document of `to_document`.

    Raises:
        DataError: It is of another schema.
        LookupError, TypeError, ValueError, AttributeError: It does not match the schema.
    """
    if document.get("schema") != SCHEMA:
        raise DataError(
            f"schema is {document.get('schema')!r}, this version reads {SCHEMA}.",
            culprits=["schema"],
            next_step="Write one with visioncal dynamics identify.",
        )
    robot = Robot.from_document(document["robot"])
    terms = FrictionTerms(**document["friction"])
    model = DynamicModel(robot, terms)
    # `BaseModel.reduce` may keep other parameters: its choice depends on rounding, and so on the
    # machine.
    kept = [model.names.index(str(row["name"]).split()[0]) for row in document["base"]]
    base = BaseModel.keeping(model, np.array(kept, dtype=np.int64))
    size = base.rank + 2 * len(document["stribeck"])
    standard = document.get("standard")
    return {
        "robot": robot,
        "base": base,
        "values": _column(document["base"], "value"),
        "covariance": _array(document["covariance"], (size, size)),
        "stribeck": _stribeck(document["stribeck"], terms),
        "consistent": None if standard is None else _consistent(standard, len(base.model.names)),
        **_checked_fields(read(_Figures, document, ""), robot.joint_count),
        "facts": {name: value for name, value in document.items() if name not in _OWN_KEYS},
    }


@dataclass(frozen=True)
class _Figures:
    """The fields that the codec reads."""

    streams: tuple[StreamStatistics, ...]
    validation: TorqueValidation | None = None
    lag: Lag | None = None


def _checked_fields(figures: _Figures, joints: int) -> dict[str, Any]:
    """Fields by name, after checking that all arrays are of that number of joints."""
    for stream in (*figures.streams, figures.validation):
        for name, value in vars(stream).items() if stream else ():
            if isinstance(value, np.ndarray) and len(value) != joints:
                raise ValueError(f"{name} has {len(value)} numbers for {joints} joints")
    return vars(figures)


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


def _column(rows: Sequence[Mapping[str, Any]], name: str) -> FloatArray:
    return np.array([float(row[name]) for row in rows])


def _array(values: object, shape: tuple[int, ...]) -> FloatArray:
    array = np.asarray(values, dtype=float)
    if array.shape != shape:
        raise ValueError(f"an array of shape {array.shape} stands where {shape} is needed")
    return array
