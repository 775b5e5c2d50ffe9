"""The calibrated arm as calibration.json has it, read for people."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.present.recording.findings import read_stage
from visioncal.results import Calibration

NOMINAL = "nominal"
# What each level frees, for people.
LEVELS = {
    NOMINAL: "the arm as stated",
    "backlash": "play of the joints",
    "offsets": "offsets of the joints",
    "geometry": "geometry of the links",
    "eccentricity": "geometry and eccentric gears",
    "elastic": "geometry, gears, and joints that bend",
}
_SYMBOLS = {
    "theta": "\N{GREEK SMALL LETTER THETA}",
    "alpha": "\N{GREEK SMALL LETTER ALPHA}",
    "beta": "\N{GREEK SMALL LETTER BETA}",
    "sine": "eccentricity, sine",
    "cosine": "eccentricity, cosine",
    "ratio": "gear ratio",
}
# Units on disk with those for people, and how many of these one of them is.
_UNITS = {"_m": ("mm", 1e3), "_rad": ("\N{DEGREE SIGN}", float(np.rad2deg(1.0)))}
# A change of so many standard deviations is no chance.
_SURE = 3.0


@dataclass(frozen=True)
class Level:
    """A level of the arm's model that was tried.

    Attributes:
        name: As on disk.
        unknowns: How many values it frees.
        rms_mm: Residual of the target's place in the fit [mm].
        rms_deg: And of its orientation [deg]; None where places alone were read.
        held_out_mm: The same of stops that were left out [mm].
        held_out_deg: And of their orientation [deg]; None likewise.
        likelihood_ratio: Twice the gain in log-likelihood over the arm as stated.
    """

    name: str
    unknowns: int
    rms_mm: float
    rms_deg: float | None
    held_out_mm: float
    held_out_deg: float | None
    likelihood_ratio: float

    @property
    def held_out(self) -> str:
        """How well stops that were left out are predicted."""
        turned = "" if self.held_out_deg is None else f" and {self.held_out_deg:.2g} deg"
        return f"{self.held_out_mm:.2g} mm{turned}"

    @property
    def words(self) -> str:
        """What it frees."""
        return LEVELS.get(self.name, self.name.replace("_", " "))


@dataclass(frozen=True)
class Parameter:
    """A number of the arm's model, in units for people.

    Attributes:
        joint: The joint that it belongs to.
        symbol: What it is.
        unit: Of all of its figures; empty for a ratio.
        nominal: As stated.
        identified: As found.
        change: The latter less the former.
        sigma: Standard deviation of the change; None where that is not known.
    """

    joint: str
    symbol: str
    unit: str
    nominal: float
    identified: float
    change: float
    sigma: float | None

    @property
    def is_sure(self) -> bool:
        """Whether its change is beyond chance."""
        return self.sigma is not None and abs(self.change) > _SURE * self.sigma > 0.0


@dataclass(frozen=True)
class Unseen:
    """How far a view that the fit had not seen is off, by the arm as stated and as calibrated.

    Degrees are None where places alone were read.
    """

    view: int
    nominal_mm: float
    nominal_deg: float | None
    mm: float
    deg: float | None


@dataclass(frozen=True, eq=False)
class WorkspaceMap:
    """Where a tool's place is predicted how well.

    Attributes:
        places_m: (k, 3) in the base frame [m].
        sigma_mm: (k,) predicted standard deviations [mm].
    """

    places_m: FloatArray
    sigma_mm: FloatArray


@dataclass(frozen=True, eq=False)
class Kinematics:
    """What was found of the arm. Where no level was taken, it has its levels alone.

    Attributes:
        level: The one that was taken; `nominal` where none was.
        levels: All that were tried, the arm as stated first.
        parameters: Of the calibrated arm.
        convention: In which the parameters are; empty where that is not said.
        workspace_mm: Median and 95 % quantile of the sigma over the workspace; None without.
        workspace: The map of the same; None where there is none.
        observability: Figures of what the stops tell, as on disk.
        not_told: What they cannot tell, in words.
        worth: Views with the share by which the mean variance would grow without them, most first.
        left_out: Views that were left out in turn.
        holdout: Views that the session keeps from every fit.
    """

    level: str
    levels: tuple[Level, ...]
    parameters: tuple[Parameter, ...]
    convention: str
    workspace_mm: tuple[float, float] | None
    workspace: WorkspaceMap | None
    observability: Mapping[str, float]
    not_told: tuple[str, ...]
    worth: tuple[tuple[int, float], ...]
    left_out: tuple[Unseen, ...]
    holdout: tuple[Unseen, ...]

    @classmethod
    def of(cls, calibration: Calibration) -> "Kinematics | None":
        """Reads it from a calibration; None where no level was tried.

        Raises:
            DataError: It is not what this version writes.
        """
        return read_stage(calibration, "kinematics", _kinematics)

    @property
    def nominal(self) -> Level:
        """The arm as stated, as a level."""
        return self.levels[0]

    @property
    def chosen(self) -> Level:
        """The level that was taken."""
        return next(it for it in self.levels if it.name == self.level)

    @property
    def is_calibrated(self) -> bool:
        """Whether a level was taken."""
        return self.level != NOMINAL

    @property
    def reason(self) -> str:
        """Why this level was taken, or none, in one sentence."""
        before, now = self.nominal, self.chosen
        if not self.is_calibrated:
            return (
                "No level was taken: none predicts stops that are left out of the fit better than "
                "the arm as stated does, beyond chance."
            )
        return (
            f"Taken: {now.words}. It predicts stops that are left out of the fit to "
            f"{now.held_out}, the arm as stated to {before.held_out}."
        )

    def grouped(self) -> dict[str, list[Parameter]]:
        """The parameters by their joint."""
        groups: dict[str, list[Parameter]] = {}
        for it in self.parameters:
            groups.setdefault(it.joint, []).append(it)
        return groups


def joint_words(name: str) -> str:
    """A joint's name for people."""
    return name.replace("_", " ")


def _kinematics(document: Mapping[str, Any]) -> Kinematics:
    robot, sigmas = document.get("robot", {}), document.get("workspace_sigma_mm")
    found = Kinematics(
        str(document["level"]),
        tuple(_level(it) for it in document["levels"]),
        tuple(_parameter(it) for it in document.get("parameters", ())),
        str(document.get("convention", robot.get("convention", ""))),
        None if sigmas is None else (float(sigmas["median"]), float(sigmas["p95"])),
        _workspace(document.get("workspace_map", ())),
        {str(name): float(it) for name, it in document.get("observability", {}).items()},
        tuple(str(it) for it in document.get("not_told", ())),
        tuple((int(it["view"]), float(it["worth"])) for it in document.get("stops", ())),
        _unseen(document.get("left_out", ())),
        _unseen(document.get("holdout", ())),
    )
    if found.level not in [it.name for it in found.levels]:
        raise ValueError(f"level {found.level!r} is not among the levels")
    return found


def _level(document: Mapping[str, Any]) -> Level:
    return Level(
        str(document["level"]),
        int(document["unknowns"]),
        float(document["rms_mm"]),
        _known(document, "rms_deg"),
        float(document["held_out_mm"]),
        _known(document, "held_out_deg"),
        float(document["likelihood_ratio"]),
    )


def _known(document: Mapping[str, Any], name: str) -> float | None:
    return float(document[name]) if name in document else None


def _parameter(document: Mapping[str, Any]) -> Parameter:
    name = str(document["name"])
    suffix = next((it for it in _UNITS if name.endswith(it)), "")
    unit, scale = _UNITS.get(suffix, ("", 1.0))
    stem = name.removesuffix(suffix)
    sigma = document.get("sigma")
    return Parameter(
        str(document["joint"]),
        _SYMBOLS.get(stem, stem.replace("_", " ")),
        unit,
        scale * float(document["nominal"]),
        scale * float(document["identified"]),
        scale * float(document["change"]),
        None if sigma is None else scale * float(sigma),
    )


def _workspace(documents: Sequence[Mapping[str, float]]) -> WorkspaceMap | None:
    if not documents:
        return None
    rows = np.array([[it[name] for name in ("x_m", "y_m", "z_m", "sigma_mm")] for it in documents])
    return WorkspaceMap(rows[:, :3], rows[:, 3])


def _unseen(documents: Sequence[Mapping[str, Any]]) -> tuple[Unseen, ...]:
    return tuple(
        Unseen(
            int(it["view"]),
            float(it["nominal_mm"]),
            _known(it, "nominal_deg"),
            float(it["mm"]),
            _known(it, "deg"),
        )
        for it in documents
    )
