"""Arms calibrated by a measuring instrument: simulated ones, a worked example, and real ones.

PYTHONPATH=tests python tests/benchmarks/instruments.py [WORLDS]
"""

import textwrap
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from results import first, wished, write_section
from support import thirdparty
from support.tracked import errors_of, information, known_of, mounting_bound, reads, solved_of

from visioncal.calibration.pipeline.run_state import RunState
from visioncal.core.transforms import invert
from visioncal.core.types import FloatArray
from visioncal.estimation.positions import fit_mounting
from visioncal.estimation.problem_parts import State
from visioncal.estimation.solve import fit_problem
from visioncal.estimation.workspace import postures
from visioncal.session import Session
from visioncal.simulation.arms import forward
from visioncal.simulation.instrument_session import (
    THREE,
    InstrumentOptions,
    InstrumentRecord,
    session_of,
    tracked,
)

WORLDS = 20
DATA = Path(__file__).parents[3] / "shared" / "data"
KINDS = {
    "a probe": InstrumentOptions(poses=True),
    "one point": InstrumentOptions(),
    "three points": InstrumentOptions(points=THREE),
}
WRONG = {"dh_sigma_m": 5e-4, "dh_sigma_rad": 1e-3, "offset_sigma_rad": 1e-3}
# Example A: errors of lengths and angles in this ratio, as large as its arm's.
EXAMPLE = InstrumentOptions(
    robot="generic-6r-1800", stops=30, robot_sigma_m=0.0, robot_sigma_rad=0.0
)
BEFORE_MM = 1.6


def rms(values: FloatArray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def prose(text: str) -> str:
    """Breaks a paragraph's lines."""
    return textwrap.fill(" ".join(text.split()), 100, break_on_hyphens=False)


def places(known: RunState, q: FloatArray) -> FloatArray:
    """(k, 3) where a calibration has the first point, in the instrument's frame."""
    x, z = known.assessment.state.edges
    robot = known.robot if known.robot_arm.model is None else known.robot_arm.model.robot
    return (invert(x) @ robot.base_from_flange(q) @ z)[:, :3, 3]


def true_places(shop: InstrumentRecord, q: FloatArray) -> FloatArray:
    """(k, 3) where it is."""
    flange = forward(shop.true_arm, q)
    return (invert(shop.base_from_instrument) @ flange @ shop.flange_from_probe)[:, :3, 3]


def workspace_bound(shop: InstrumentRecord, q: FloatArray) -> float:
    """Least root mean square error of the first point's place at some postures [m]."""
    whole = information(shop, arm_columns=True)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole), 1e-30))
    values, vectors = np.linalg.eigh(whole * np.outer(scale, scale))
    told = values > 1e-10 * values[-1]
    root = (vectors[:, told] / np.sqrt(values[told])) * scale[:, None]
    first = slice(3, 6) if shop.options.poses else slice(0, 3)
    steps = 1e-5 * np.eye(len(whole))
    jacobian = np.stack(
        [(reads(shop, step, q=q) - reads(shop, -step, q=q))[:, first] / 2e-5 for step in steps],
        axis=-1,
    )
    return float(np.sqrt(np.mean(np.sum((jacobian @ root) ** 2, axis=(1, 2)))))


def frames_row(options: InstrumentOptions, worlds: int) -> str:
    """The arm is right: both frames against their bound."""
    kept = np.arange(12) if options.poses else np.r_[:6, 9:12]
    by_bound, by_sigma = [], []
    for seed in range(worlds):
        shop = tracked(replace(options, seed=seed))
        known = solved_of(session_of(shop))
        error, covariance = (
            errors_of(shop, known)[kept],
            known.assessment.covariance[np.ix_(kept, kept)],
        )
        by_bound.append(error @ np.linalg.solve(mounting_bound(shop), error) / len(kept))
        by_sigma.append(error @ np.linalg.solve(covariance, error) / len(kept))
    return f"{np.sqrt(np.mean(by_bound)):.2f} | {np.mean(by_sigma):.2f}"


def arm_row(options: InstrumentOptions, worlds: int) -> str:
    """The arm is wrong: its point all over the workspace."""
    found, levels = [], []
    for seed in range(worlds):
        shop = tracked(replace(options, seed=seed, **WRONG))
        begun = time.process_time()
        known = known_of(session_of(shop))
        seconds = time.process_time() - begun
        q = postures(known.robot)
        error = rms(np.linalg.norm(places(known, q) - true_places(shop, q), axis=1))
        level = known.robot_arm.kinematics.result.levels[0]
        predicted = known.findings.arms[0].workspace_mm or float("nan")
        found.append(
            (level.rms_mm, 1e3 * error, 1e3 * workspace_bound(shop, q), predicted, seconds)
        )
        levels.append(known.robot_arm.kinematics.level)
    before, after, bound, predicted, seconds = np.array(found).T
    return (
        f"{np.median(before):.2f} | {np.median(after):.3f} | {rms(after) / rms(bound):.2f} | "
        f"{np.median(predicted):.3f} | {levels.count('geometry')} | {np.median(seconds):.1f}"
    )


def simulated(worlds: int) -> str:
    """The table of simulated arms."""
    rows = [
        f"| {name} | {frames_row(item, worlds)} | {arm_row(item, worlds)} |"
        for name, item in first(tuple(KINDS.items()))
    ]
    text = f"""30 stops of a UR10e are read by an instrument of 20 um (50 urad for a probe's
    rotation); the arm repeats to 0.03 mm and 0.03 mrad. {worlds} worlds a row.
    Exact arm: both frames against the Cramer-Rao bound at the true noise, and their squared
    errors over the stated covariance (1 is right). Inexact arm (0.5 mm and 1 mrad in every
    parameter): error of the first point's position at postures all over the workspace, root mean
    square; the bound has all link errors as unknowns, without a prior."""
    head = (
        "| read | frames: error / bound | squared error / covariance "
        "| wrong arm, frames alone [mm] | calibrated, all over [mm] | error / bound "
        "| predicted sigma [mm] | geometry taken | CPU seconds |"
    )
    return "\n".join((prose(text), "", head, "| --- " * 9 + "|", *rows))


def example_a(worlds: int) -> str:
    """The worked example: 30 stops of a 1.8 m arm, one reflector, 20 um."""
    size = BEFORE_MM / np.median([before_mm(1.0, seed) for seed in range(worlds)])
    taken, held, before, conditions = [], [], [], []
    for seed in range(worlds):
        shop = tracked(example(size, seed))
        known = known_of(session_of(shop))
        q = postures(known.robot)
        held.append(1e3 * rms(np.linalg.norm(places(known, q) - true_places(shop, q), axis=1)))
        before.append(known.robot_arm.kinematics.result.nominal.rms_mm)
        conditions.append(parameter_conditions(shop))
        taken.append(known.robot_arm.kinematics.level)
    stated, metres, millimetres, scaled = np.median(conditions, axis=0)
    text = f"""A 6R arm of 1.8 m (generic-6r-1800), one reflector on its flange, 30 random stops
    read by a laser tracker of 20 um, no other noise; {worlds} worlds. The poses of tracker and
    reflector are unknown, too. Errors of {size * 0.5:.2f} mm and {size:.2f} mrad in every
    parameter give the nominal arm errors of {np.median(before):.2f} mm at its stops (rms, frames
    fitted). After calibration, new postures all over the workspace are predicted to
    {np.median(held):.3f} mm (rms, median of the worlds; the worst {np.max(held):.3f} mm);
    {taken.count("geometry")} of {worlds} choose the level geometry. If such a fit ends at 0.31 mm,
    fifteen times the noise of the tracker, the arm has errors that are not in the model."""
    parameters = """Condition numbers of the identification by 28 parameters (24 of the table, 4 of
    Hayati's), tracker and reflector known, over the 23 identifiable combinations:"""
    explained = """The five unidentifiable combinations have no finite condition number in any
    units: a finite number for all 28, like the 8e5 quoted for this example, comes from rounding or
    from a solver's damping. The others depend on the units: in millimetres and radians an angle has
    a thousand times the weight of a length, and its square a million times. The result does not
    depend on them, since the fit scales its columns; only the last row describes the stops."""
    rows = (
        ("mm, mrad, places in mm (as m, rad, m)", metres),
        ("mm, rad, places in mm", millimetres),
        ("typical errors, 0.5 mm and 1 mrad", stated),
        ("each column of length one", scaled),
    )
    table = [f"| {name} | {value:.1e} | {np.sqrt(value):.0f} |" for name, value in rows]
    head = ("| units | of Phi^T Phi | of Phi |", "| --- | --- | --- |")
    return "\n".join((prose(text), "", prose(parameters), "", *head, *table, "", prose(explained)))


def example(size: float, seed: int) -> InstrumentOptions:
    """Example A with errors of this size, in half millimetres and milliradians."""
    errors = {name: size * sigma for name, sigma in WRONG.items()}
    return replace(EXAMPLE, **errors, seed=seed)


def before_mm(size: float, seed: int) -> float:
    """How far the nominal arm is off at its stops, frames fitted [mm]."""
    known = solved_of(session_of(tracked(example(size, seed))), level="hand-eye")
    nominal = known.assessment.problem.with_effects([])
    fit = fit_problem(nominal, State(known.assessment.state.edges, np.zeros(0)))
    place = nominal.change_of(nominal.observations.observed[0], fit.state)[:, :3, 3]
    return 1e3 * rms(np.linalg.norm(place, axis=1))


def parameter_conditions(shop: InstrumentRecord) -> tuple[float, float, float, float]:
    """Conditions of Phi^T Phi over the 23 told combinations: own errors, SI, mm and rad, scaled."""
    jacobian = parameter_jacobian(shop)
    lengths = np.repeat([1.0, 1.0, 0.0, 0.0, 0.0], [6, 6, 6, 6, 4]) > 0.0
    found = []
    for scale in (
        np.where(lengths, 5e-4, 1e-3),
        np.ones(28),
        np.where(lengths, 1e-3, 1.0),
        1.0 / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-12),
    ):
        values = np.linalg.svd(jacobian * scale, compute_uv=False)
        told = values[values > 1e-7 * values[0]]
        if len(told) != 23:
            raise AssertionError(f"{len(told)} combinations are told, not 23")
        found.append((told[0] / told[-1]) ** 2)
    return tuple(found)


def parameter_jacobian(shop: InstrumentRecord) -> FloatArray:
    """(3 s, 28) derivatives of the reflector's place by a, d, alpha, offset and four betas."""
    arm, step = shop.arm, 1e-6

    def place(change: FloatArray) -> FloatArray:
        beta = np.zeros(6)
        beta[:4] = change[24:]
        moved = replace(
            arm,
            a=arm.a + change[:6],
            d=arm.d + change[6:12],
            alpha=arm.alpha + change[12:18],
            beta=beta,
            offset=arm.offset + change[18:24],
        )
        return (forward(moved, shop.joints) @ shop.flange_from_probe)[:, :3, 3].ravel()

    steps = step * np.eye(28)
    return np.stack([(place(value) - place(-value)) / (2 * step) for value in steps], axis=1)


def real() -> str:
    """The tables of real data; a line that says so where these are not here."""
    if not DATA.is_dir():
        return "The folder of real measurements is not here (../shared/data)."
    return "\n\n".join(item() for item in first((irb120, rokae, talos)))


def irb120() -> str:
    """Wu et al. (2015): a measuring arm, three points, and two sets with another tool."""
    known = known_of(thirdparty.irb120(DATA))
    nominal = nominal_fit(known)
    lines = []
    for name, joints, read in (
        ("first", "TestJointAngles", "TestPosition"),
        ("second", "TestJointAngles2", "TestPosition2"),
    ):
        q, places_m = thirdparty.irb120_set(DATA, joints, read)
        rest, everything = tool_errors_mm(
            known.robot_arm.model.robot.base_from_flange(q),
            known.assessment.state.edges[0],
            places_m,
        )
        before = tool_errors_mm(known.robot.base_from_flange(q), nominal, places_m)[1]
        lines.append(
            f"| {name} test set, {len(q)} stops | {before.mean():.2f} | {rest.mean():.3f} "
            f"| {everything.mean():.3f} |"
        )
    text = f"""**ABB IRB 120** (Wu et al. 2015): three points at 36 stops, by a measuring arm with
    an assumed sigma of 0.06 mm. {told(known)} The test sets have another tool: its point is the
    mean of the estimates from their first five configurations, and nothing else is fitted to them.
    Mean distances [mm]:"""
    head = "| | nominal arm, all | calibrated, the other configurations | calibrated, all |"
    return "\n".join((prose(text), "", head, "| --- | --- | --- | --- |", *lines))


def nominal_fit(known: RunState) -> FloatArray:
    """(4, 4) the instrument's frame as the nominal arm has it."""
    readings = known.readings
    flange = {view: known.base_from_flange[view] for view in known.used}
    stops = np.unique(known.assessment.problem.observations.stops, return_inverse=True)[1]
    seen = readings.places(known.used, flange, stops)
    return fit_mounting(seen, None, len(readings.names)).base_from_instrument


def tool_errors_mm(
    flange: FloatArray, base_from_instrument: FloatArray, read: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Distances [mm] with the tool's point from the first five: of the others, and of all."""
    in_base = read @ base_from_instrument[:3, :3].T + base_from_instrument[:3, 3]
    on_flange = np.einsum("mji,mj->mi", flange[:, :3, :3], in_base - flange[:, :3, 3])
    away = 1e3 * np.linalg.norm(on_flange - on_flange[:5].mean(axis=0), axis=1)
    return away[5:], away


def rokae() -> str:
    """A laser's poses of a six-axis arm."""
    known = known_of(thirdparty.rokae(DATA))
    folds = cross_validated(lambda held: thirdparty.rokae(DATA, held), 30)
    levels = [
        level for level in known.robot_arm.kinematics.result.levels if level.level == "geometry"
    ]
    found = known.findings.rms
    return prose(
        f"""**ROKAE-type arm**: 30 poses by a laser with assumed sigmas of 0.02 mm and 0.1 mrad.
        {told(known)} In sample {found.mm:.3f} mm and {found.deg:.3f} deg rms
        ({levels[0].rms_mm:.3f} mm with the geometry alone); in ten folds, with the level chosen
        in each, {rms(folds[:, 0]):.3f} mm and {rms(folds[:, 1]):.3f} deg rms, in the median
        {np.median(folds[:, 0]):.3f} mm."""
    )


def talos() -> str:
    """Contacts of a humanoid's hand."""
    known = known_of(thirdparty.talos(DATA))
    folds = cross_validated(lambda held: thirdparty.talos(DATA, held), 61)[:, 0]
    return prose(
        f"""**TALOS**: 61 contacts of the left hand, moved by torso and arm (nine joints), with an
        assumed sigma of 0.3 mm. {told(known)} In ten folds, with the level chosen in each,
        {np.median(folds):.2f} mm in the median, {folds.mean():.2f} mm in the mean,
        {folds.max():.2f} mm at most."""
    )


def told(known: RunState) -> str:
    """What the method says of its trust."""
    held, levels = known.findings.held_out, known.robot_arm.kinematics.result.levels
    workspace_mm = known.findings.arms[0].workspace_mm
    return (
        f"Level {known.robot_arm.kinematics.level} ({levels[0].rms_mm:.2f} mm with the nominal "
        f"arm); left out in turn, readings are predicted to {held.mm:.3f} mm rms; all over the "
        f"workspace to {workspace_mm:.2g} mm (sigma, median); verdict {known.verdict.status}."
    )


def cross_validated(of: Callable[[list[int]], Session], stops: int) -> FloatArray:
    """(stops, 2) residuals [mm], [deg] of stops that were held back, in ten folds of strides."""
    away = np.zeros((stops, 2))
    for fold in range(10):
        held = list(range(fold, stops, 10))
        known = known_of(of(held))
        for view in known.findings.pairs[0].views:
            if view.view in held:
                away[view.view] = view.residual_mm, view.residual_deg or 0.0
    return away


def main(worlds: int) -> None:
    """Prints what was measured and keeps it."""
    command = "PYTHONPATH=tests python tests/benchmarks/instruments.py"
    for name, text in (
        ("An arm measured by an instrument", simulated(worlds)),
        ("The worked example of a laser tracker", example_a(worlds)),
        ("Arms that others measured", real()),
    ):
        print(text, flush=True)
        write_section(name, command, text)


if __name__ == "__main__":
    main(wished(WORLDS))
