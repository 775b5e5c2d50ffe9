"""Facts and tables about an arm: model level, parameters, joint springs and thermal drift."""

from collections.abc import Iterator

import numpy as np

from visioncal.core.number_format import decimals_for, fixed, signed, significant
from visioncal.present.facts import PLUS_MINUS
from visioncal.present.tables import Fact, Table, TableRow
from visioncal.results.arm import (
    LEVEL_WORDS,
    NOMINAL,
    ArmErrorsResult,
    ArmResult,
    ElasticResult,
    ThermalResult,
)

_SYMBOLS = {
    "theta": "\N{GREEK SMALL LETTER THETA}",
    "alpha": "\N{GREEK SMALL LETTER ALPHA}",
    "beta": "\N{GREEK SMALL LETTER BETA}",
    "sine": "eccentricity, sine",
    "cosine": "eccentricity, cosine",
    "ratio": "gear ratio",
}
# Suffixes of units on disk: the unit shown, and the factor to it.
_UNITS = {"_m": ("mm", 1e3), "_rad": ("\N{DEGREE SIGN}", float(np.rad2deg(1.0)))}
# Decimals without a sigma: about a hundredth of an arm's repeatability.
_DECIMALS = {"mm": 3, "\N{DEGREE SIGN}": 4}


def joint_words(name: str) -> str:
    """A joint's name for display."""
    return name.replace("_", " ")


def level_words(name: str) -> str:
    """The parameters that a level of the arm's model estimates."""
    return LEVEL_WORDS.get(name, name.replace("_", " "))


def error_facts(errors: ArmErrorsResult) -> tuple[Fact, ...]:
    """Size of the posture-dependent errors of an arm."""
    treatment = (
        ("estimated along with the result", "what looks the same in all views is left, see above")
        if errors.estimated
        else ("not taken out", "no joint angles with a known robot model: only their size is known")
    )
    off_by = Fact(
        f"{'the flange' if errors.of else 'a link'} is typically off by",
        f"{significant(errors.sigma_mm)} mm, {significant(errors.sigma_deg)} deg",
    )
    ratio = Fact("likelihood ratio", f"{errors.likelihood_ratio:.0f}", "noise alone stays under 15")
    return (off_by, ratio, Fact("its errors were", *treatment))


def level_table(arm: ArmResult) -> Table | None:
    """The model levels tried, with their residuals; None if there is only one."""
    if len(arm.levels) < 2:
        return None
    titles = ("what is free", "values", "fit, mm", "fit, deg", "left out, mm", "left out, deg",
              "likelihood ratio")  # fmt: skip
    rows = []
    for level in arm.levels:
        is_taken, is_nominal = level.level == arm.level, level.level == NOMINAL
        residuals = (level.rms_mm, level.rms_deg, level.held_out_mm, level.held_out_deg)
        cells = (
            level_words(level.level) + (" (taken)" if is_taken else ""),
            str(level.unknowns),
            *map(significant, residuals),
            significant(None) if is_nominal else f"{level.likelihood_ratio:.0f}",
        )
        rows.append(TableRow(cells, "taken" if is_taken else ""))
    return Table.of(titles, rows)


def parameter_tables(arm: ArmResult, count: int = 1) -> list[Table]:
    """The parameters of the arm's model, joint by joint, in `count` tables."""
    joints: dict[str, list[TableRow]] = {}
    for parameter in arm.parameters:
        suffix = next((end for end in _UNITS if parameter.name.endswith(end)), "")
        unit, scale = _UNITS.get(suffix, ("", 1.0))
        stem = parameter.name.removesuffix(suffix)
        sigma = None if parameter.sigma is None else scale * parameter.sigma
        decimals = decimals_for(sigma) if sigma else _DECIMALS.get(unit, 5)
        cells = (
            _SYMBOLS.get(stem, stem.replace("_", " ")),
            # All digits of the nominal value, whatever the sigma.
            f"{scale * parameter.nominal + 0.0:.7g}",
            fixed(scale * parameter.identified, decimals),
            signed(scale * parameter.change, decimals),
            f"{PLUS_MINUS} {significant(sigma)}" if sigma else "",
            unit,
        )
        joints.setdefault(parameter.joint, [TableRow((joint_words(parameter.joint),))]).append(
            TableRow(cells, "sure" if parameter.is_sure else "")
        )
    titles, rows = ("parameter", "nominal", "identified", "change", "sigma", "unit"), [*joints]
    size = max(-(-len(rows) // count), 1)
    groups = [rows[start : start + size] for start in range(0, len(rows), size)]
    return [Table(titles, tuple(joint for name in names for joint in joints[name]), (0, 4, 5))
            for names in groups]  # fmt: skip


def identifiability_facts(arm: ArmResult) -> Iterator[Fact]:
    """Number of directions that the stops determine, and their condition."""
    observability = arm.observability
    if observability is not None:
        count = f"{observability.determined} of {observability.identifiable}"
        yield Fact("directions determined", count, "that any stops could determine")
        if observability.condition is not None:
            note = "best over worst determined, scaled"
            yield Fact("condition", significant(observability.condition), note)


def spring_facts(elastic: ElasticResult) -> Iterator[Fact]:
    """Deflection of the flange under the stops' loads, and the payload."""
    median, most = significant(elastic.sag_mm.median), significant(elastic.sag_mm.most)
    yield Fact("the flange gives way by", f"{median} mm", f"median; at most {most} mm")
    if elastic.payload_kg[1] > 0.0 or elastic.force_n is not None:
        yield Fact("load", elastic.loads_words)
    if elastic.payload_factor is not None:
        factor = elastic.payload_factor
        note = f"\N{PLUS-MINUS SIGN} {significant(factor.sigma)}; 1 where load and bend fit"
        yield Fact("load as stated, times", f"{factor.value:.2f}", note)


def spring_table(elastic: ElasticResult) -> Table:
    """Stiffness of each joint, and the range of torques on it."""
    rows = []
    for joint in elastic.joints:
        stiffness, sigma = joint.stiffness_nm_per_rad, joint.stiffness_sigma_nm_per_rad
        low, high = (f"{round(end, 1) + 0.0:g}" for end in joint.torque_nm)
        stiffness_words = "taken for rigid" if stiffness is None else f"{1e-3 * stiffness:.4g}"
        sigma_words = "" if sigma is None else f"{PLUS_MINUS} {significant(1e-3 * sigma)}"
        rows.append((joint_words(joint.joint), stiffness_words, sigma_words, f"{low} to {high}"))
    return Table.of(("joint", "stiffness [kN m/rad]", "sigma", "torque [N m]"), rows, (0, 2))


def hours(thermal: ThermalResult, stamp_s: float) -> float:
    """Hours since the start of the course."""
    return (stamp_s - thermal.course[0].stamp_s) / 3600.0


def drift_table(thermal: ThermalResult) -> Table:
    """Thermal growth and zero drift of each joint and its link."""
    titles = (
        "joint and its link",
        "growth [\N{MICRO SIGN}m/(m K)]",
        "drift of the zero [\N{MICRO SIGN}rad/K]",
        "time constant [min]",
        "",
    )
    rows = [
        (
            joint.joint,
            f"{1e6 * joint.growth_per_k:.1f} {PLUS_MINUS} {1e6 * joint.growth_sigma_per_k:.1f}",
            f"{1e6 * joint.drift_rad_per_k:.1f} {PLUS_MINUS} "
            f"{1e6 * joint.drift_sigma_rad_per_k:.1f}",
            significant(joint.tau_s / 60.0),
            "growth as known before" * (f"growth of {joint.joint}" in thermal.not_determined),
        )
        for joint in thermal.joints
    ]
    return Table.of(titles, rows, (0, 4))
