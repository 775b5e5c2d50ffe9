"""The springs of a calibrated arm as calibration.json has them, read for people."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.present.recording.findings import read_stage
from visioncal.results import Calibration


@dataclass(frozen=True, eq=False)
class Spring:
    """A joint that bends.

    Attributes:
        joint: Its name.
        told: Whether the stops tell it; others are taken for rigid.
        compliance: What it yields to a torque [rad/(N m)].
        stiffness: [N m/rad]; None where it is not told.
        stiffness_sigma: Its standard deviation [N m/rad].
        torque_nm: (2,) least and greatest torque on it [N m].
        torques_nm: (k,) torques at the stops that see it bend [N m].
        bends_mrad: (k,) how far each of these alone sees it bend [mrad].
    """

    joint: str
    told: bool
    compliance: float
    stiffness: float | None
    stiffness_sigma: float | None
    torque_nm: tuple[float, float]
    torques_nm: FloatArray
    bends_mrad: FloatArray


@dataclass(frozen=True, eq=False)
class Elastic:
    """What was found of an arm's springs.

    Attributes:
        springs: Joint by joint.
        sag_mm: How far the loads of the stops move the flange, in the median and at most [mm].
        payload_kg: Least and greatest payload [kg].
        payload_factor: By which factor payload and force bend the arm beyond what is stated, with
            its sigma; None where there were none.
    """

    springs: tuple[Spring, ...]
    sag_mm: tuple[float, float]
    payload_kg: tuple[float, float]
    payload_factor: tuple[float, float] | None

    @classmethod
    def of(cls, calibration: Calibration) -> "Elastic | None":
        """Reads it from a calibration; None for a rigid arm.

        Raises:
            DataError: It is not what this version writes.
        """
        return read_stage(calibration, "elastic", _elastic)


def _elastic(document: Mapping[str, Any]) -> Elastic:
    rows, factor = document["stops"], document.get("payload_factor")
    low, high = document["payload_kg"]
    return Elastic(
        tuple(
            _spring(joint, [(it["torque_nm"][at], it["bend_mrad"]) for it in rows])
            for at, joint in enumerate(document["joints"])
        ),
        (float(document["sag_mm"]["median"]), float(document["sag_mm"]["most"])),
        (float(low), float(high)),
        None if factor is None else (float(factor["value"]), float(factor["sigma"])),
    )


def _spring(document: Mapping[str, Any], stops: list[tuple[float, dict[str, float]]]) -> Spring:
    name = str(document["joint"])
    seen = [(float(torque), float(bends[name])) for torque, bends in stops if name in bends]
    torques, bends = np.array(seen).reshape(-1, 2).T
    low, high = document["torque_nm"]
    stiffness, sigma = (
        None if key not in document else float(document[key])
        for key in ("stiffness_nm_per_rad", "stiffness_sigma_nm_per_rad")
    )
    return Spring(
        name,
        bool(document["told"]),
        float(document["compliance_rad_per_nm"]),
        stiffness,
        sigma,
        (float(low), float(high)),
        torques,
        bends,
    )
