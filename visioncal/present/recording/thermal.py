"""How the arm drifts with its temperature, as calibration.json has it, read for people."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr

from visioncal.core.types import FloatArray
from visioncal.present.recording import paths
from visioncal.present.recording.findings import read_stage
from visioncal.results import Calibration


@dataclass(frozen=True)
class Joint:
    """What was found of a joint and the link behind it.

    Attributes:
        name: The joint's.
        growth_um: By how much a metre of the link grows [um/K], with its sigma.
        drift_urad: By how much the zero drifts [urad/K], with its sigma.
        tau_min: Time constant [min].
        not_told: Whether the link's growth is what was known before.
    """

    name: str
    growth_um: tuple[float, float]
    drift_urad: tuple[float, float]
    tau_min: float
    not_told: bool


@dataclass(frozen=True, eq=False)
class Drift:
    """What was found of the arm's drift.

    Attributes:
        heated_by: `temperatures` or `currents`.
        joints: One a joint.
        before_mm: Residual of the views without drift [mm].
        after_mm: The same with it [mm].
        hours: (k,) times since the first sample [h].
        drift_mm: (k,) how far the flange had moved then, at a posture of the views [mm].
        sigma_mm: (k,) how surely that is known [mm].
        seen: (s, 2) when stops in that posture were looked at [h], and how far the flange was seen
            to have moved [mm].
        by_view: Drift [mm] and the largest rise [K] by view.
    """

    heated_by: str
    joints: tuple[Joint, ...]
    before_mm: float
    after_mm: float
    hours: FloatArray
    drift_mm: FloatArray
    sigma_mm: FloatArray
    seen: FloatArray
    by_view: Mapping[int, tuple[float, float]]

    @classmethod
    def of(cls, calibration: Calibration) -> "Drift | None":
        """Reads it from a calibration; None where no drift was found.

        Raises:
            DataError: It is not what this version writes.
        """
        return read_stage(calibration, "thermal", _drift)

    def log_view(self, stream: rr.RecordingStream, view: int) -> None:
        """Logs how far the arm had drifted at a view."""
        if view in self.by_view:
            drift_mm, rise_k = self.by_view[view]
            stream.log(paths.DRIFT_MM, rr.Scalars(drift_mm))
            stream.log(paths.RISE_K, rr.Scalars(rise_k))


def _drift(document: Mapping[str, Any]) -> Drift:
    course, residual = document["course"], document["residual_mm"]

    def column(name: str) -> FloatArray:
        return np.array([float(row[name]) for row in course])

    stamps_s = column("stamp_s")
    # Results of earlier versions tell of no stops.
    seen = [(float(it["stamp_s"]), float(it["drift_mm"])) for it in document.get("seen", ())]
    return Drift(
        str(document["heated_by"]),
        tuple(_joint(row, document["not_told"]) for row in document["joints"]),
        float(residual["without"]),
        float(residual["with"]),
        (stamps_s - stamps_s[0]) / 3600.0,
        column("drift_mm"),
        column("sigma_mm"),
        (np.reshape(seen, (-1, 2)) - [stamps_s[0], 0.0]) / [3600.0, 1.0],
        {int(it["view"]): (float(it["drift_mm"]), float(it["rise_k"])) for it in document["views"]},
    )


def _joint(row: Mapping[str, Any], not_told: list[str]) -> Joint:
    def millionths(value: str, sigma: str) -> tuple[float, float]:
        return 1e6 * float(row[value]), 1e6 * float(row[sigma])

    return Joint(
        str(row["joint"]),
        millionths("growth_per_k", "growth_sigma_per_k"),
        millionths("drift_rad_per_k", "drift_sigma_rad_per_k"),
        float(row["tau_s"]) / 60.0,
        f"growth of {row['joint']}" in not_told,
    )
