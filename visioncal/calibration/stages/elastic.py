"""Joint stiffness and backlash by the stops, and the check of stated loads against deflections."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from visioncal.core.limits import CONTRADICTION, DETERMINED
from visioncal.core.number_format import figure
from visioncal.core.types import FloatArray
from visioncal.core.verdict import NOTE, Finding, Remedy
from visioncal.estimation.armpair import ArmData
from visioncal.estimation.mixed import PriorInformation
from visioncal.estimation.problem_parts import Effect
from visioncal.results.arm import ElasticResult, Factor, JointBacklash, JointSpring, Sag, TwoSlopes
from visioncal.robot.arm_model import BACKLASH, COMPLIANCE, WEIGHT, ArmModel
from visioncal.robot.elasticity import BENDS, BY_CONTROLLER, OF_MASSES, SOFT, weight_words
from visioncal.robot.loads import STANDARD_GRAVITY_M_S2, load_ranges


def elastic_of(arm: ArmData) -> ElasticResult | None:
    """Estimated springs of an arm, with its loads and deflections; None for a rigid one."""
    if not arm.model.weights.keys() & {COMPLIANCE, WEIGHT}:
        return None
    model, loads, names = arm.model, arm.loads, arm.model.nominal.joint_names
    torques = model.robot.load_torques(model.bent(arm.q, loads), loads)
    sigmas, prior = np.zeros(len(names)), 0.0
    if COMPLIANCE in model.weights:
        unit = model.weights[COMPLIANCE] / model.torque_nm
        prior = unit * model.error_rad
        variances = np.diag(arm.arm_covariance)[model.columns_of(COMPLIANCE)]
        sigmas = np.minimum(unit * np.sqrt(variances), prior)
    determined = sigmas < DETERMINED * prior
    is_stiff = determined & (model.compliance > CONTRADICTION * sigmas)
    springs, slopes = [], slopes_of(arm)
    for at, (name, compliance, sigma) in enumerate(
        zip(names, model.compliance.tolist(), sigmas.tolist(), strict=True)
    ):
        stiff = 1.0 / compliance if is_stiff[at] else None
        spring = JointSpring(
            joint=name,
            compliance_rad_per_nm=compliance,
            sigma_rad_per_nm=sigma,
            determined=bool(determined[at]),
            torque_nm=(float(torques[:, at].min()), float(torques[:, at].max())),
            stiffness_nm_per_rad=stiff,
            stiffness_sigma_nm_per_rad=None if stiff is None else sigma * stiff**2,
            slopes=slopes.get(at),
        )
        springs.append(spring)
    rigid = model.robot.base_from_flange(arm.q)[:, :3, 3]
    deflection = model.base_from_flange(arm.q, loads)[:, :3, 3] - rigid
    sag_mm = 1e3 * np.linalg.norm(deflection, axis=1)
    return ElasticResult(
        joints=tuple(springs),
        not_determined=tuple(spring.joint for spring in springs if not spring.determined),
        weight=weight_words(model.nominal),
        **load_ranges(loads),
        sag_mm=Sag(float(np.median(sag_mm)), float(sag_mm.max())),
        weight_moments=model.moments,
        payload_factor=_payload_factor(arm),
    )


# Loads from which on gears are tried for two slopes [N], torques among which their knees are, as
# quantiles, and the least square of a second slope's change over its variance: chance leaves 10 in
# one of a hundred arms, whose six joints each have seven knees.
_HEAVY_N, _KNEES, _SHOWN = 490.0, np.arange(0.2, 0.81, 0.1), 25.0


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Second slopes of an arm's gears, tested beside all other unknowns (Rao's score test)."""

    arm: ArmData
    torques: FloatArray  # (m, n) at the stops [N m].
    axes: FloatArray  # (m, 6, n) motion of the flange by each joint.

    @classmethod
    def of(cls, arm: ArmData) -> "_Slopes":
        bent, robot = arm.model.bent(arm.q, arm.loads), arm.model.robot
        return cls(arm, robot.load_torques(bent, arm.loads), robot.axis_jacobian(bent))

    def solved(
        self, knees: Mapping[int, float], *, moves: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Step and covariance of all unknowns, with a second slope of joints and its knee."""
        turns = []
        for joint, knee in knees.items():
            sign, over = np.sign(self.torques[:, joint]), np.abs(self.torques[:, joint]) - knee
            shares = [np.maximum(over, 0.0), *([-(over > 0.0).astype(float)] if moves else [])]
            turns += [self.axes[:, :, joint] * (sign * share)[:, None] for share in shares]
        fit, robot = self.arm.fit, self.arm.robot
        jacobian = np.zeros((len(fit.problem.poses[robot]), 6, len(turns)))
        jacobian[self.arm.stops] = np.stack(turns, axis=2)
        widened = fit.with_columns(Effect.free("slopes", flange_jacobian={robot: jacobian}))
        return -widened.absorbed @ widened.equations[1], widened.absorbed

    def next(self, knees: Mapping[int, float]) -> tuple[int, float] | None:
        """The joint and knee that explain most beside those found; None where chance may."""
        best, chosen = _SHOWN, None
        for joint in sorted({*range(self.torques.shape[1])} - knees.keys()):
            for knee in np.quantile(np.abs(self.torques[:, joint]), _KNEES).tolist():
                step, covariance = self.solved({**knees, joint: knee})
                if knee > 0.0 and (square := step[-1] ** 2 / covariance[-1, -1]) > best:
                    best, chosen = square, (joint, knee)
        return chosen

    def moved(self, knees: dict[int, float]) -> dict[int, float]:
        """Knees after some steps by their own columns (Golub and Pereyra 1973)."""
        for _ in range(8):
            step, _ = self.solved(knees, moves=True)
            pairs = step[-2 * len(knees) :].reshape(-1, 2)
            for (joint, knee), (change, moved) in zip([*knees.items()], pairs, strict=True):
                most = float(np.abs(self.torques[:, joint]).max())
                by = float(np.clip(moved / change, -0.1 * most, 0.1 * most))
                knees[joint] = float(np.clip(knee + by, 0.05 * most, 0.95 * most))
        return knees


def slopes_of(arm: ArmData) -> dict[int, TwoSlopes]:
    """Joints that yield by another slope beyond a torque, by number; only heavy loads show it."""
    model, loads = arm.model, arm.loads
    pull = loads.payload_kg * STANDARD_GRAVITY_M_S2 + np.linalg.norm(loads.force_n, axis=1)
    if COMPLIANCE not in model.weights or pull.max(initial=0.0) < _HEAVY_N or len({*pull}) < 2:
        return {}
    tested, knees = _Slopes.of(arm), dict[int, float]()
    while (chosen := tested.next(knees)) is not None:
        knees = tested.moved({**knees, chosen[0]: chosen[1]})
    if not knees:
        return {}
    found, (step, covariance) = dict[int, TwoSlopes](), tested.solved(knees, moves=True)
    columns = arm.columns[model.columns_of(COMPLIANCE)]
    for at, (joint, knee) in enumerate(knees.items()):
        by = np.zeros((2, len(step)))
        by[:, columns[joint]] = model.weights[COMPLIANCE] / model.torque_nm
        by[1, len(step) - 2 * len(knees) + 2 * at] = 1.0
        slopes = (model.compliance[joint] + by @ step).tolist()
        found[joint] = TwoSlopes(knee, *slopes, *np.sqrt(np.diag(by @ covariance @ by.T)).tolist())
    return found


def _payload_factor(arm: ArmData) -> Factor | None:
    """Ratio of the actual to the predicted bending under the stated payload and force.

    The bending is bilinear in factor and compliances, which a wrong load falsifies: beside all
    unknowns, each joint has its bend by the load alone, linear as its compliance is; both are then
    fitted by compliances and one factor, with their joint covariance (Gauss-Newton). None where
    there were no loads, or these bend nothing, or the arm's own weight does not separate load from
    compliance.
    """
    model, loads, reported = arm.model, arm.loads, arm.fit.problem.poses[arm.robot]
    if not loads.any or not model.compliance.any():
        return None
    bent, robot, count = model.bent(arm.q, loads), model.robot, len(model.compliance)
    load_torques = robot.load_torques(bent, loads) - robot.load_torques(bent)
    flange_jacobian = np.zeros((len(reported), 6, count))
    flange_jacobian[arm.stops] = SOFT * robot.axis_jacobian(bent) * load_torques[:, None]
    flanges, prior = {arm.robot: flange_jacobian}, PriorInformation(np.eye(count), np.zeros(count))
    widened = arm.fit.with_columns(Effect.free("payload", prior, flange_jacobian=flanges))
    covariance, (_, gradient) = widened.absorbed, widened.equations
    columns = np.append(arm.columns[model.columns_of(COMPLIANCE)], np.arange(-count, 0))
    units = np.repeat([model.weights[COMPLIANCE] / model.torque_nm / SOFT, 1.0], count)
    found = -units * (covariance @ gradient)[columns]
    found[:count] += model.compliance / SOFT
    information = np.linalg.inv(np.outer(units, units) * covariance[np.ix_(columns, columns)])
    compliance, by_load = np.split(found, 2)
    values = np.append(compliance, compliance @ by_load / (compliance @ compliance))
    # Rounds in factor and compliances, which are near.
    for _ in range(20):
        compliance, over = values[:-1], values[-1]
        predicted = np.append(compliance, over * compliance)
        jacobian = np.eye(2 * count, count + 1)
        jacobian[count:, :count] = over * np.eye(count)
        jacobian[count:, count] = compliance
        normal = jacobian.T @ information @ jacobian
        values = values + np.linalg.solve(normal, jacobian.T @ information @ (found - predicted))
    sigma = float(np.sqrt(np.linalg.inv(normal)[-1, -1]))
    return Factor(1.0 + float(values[-1]), sigma) if sigma < 1.0 else None


def remarks(elastic: ElasticResult) -> Iterator[str]:
    """Remarks on the springs, for the verdict."""
    words = ", ".join(
        f"{spring.joint} {1e-3 * spring.stiffness_nm_per_rad:.4g} +- "
        f"{figure(1e-3 * spring.stiffness_sigma_nm_per_rad)} kN m/rad"
        for spring in elastic.joints
        if spring.stiffness_nm_per_rad is not None and spring.stiffness_sigma_nm_per_rad is not None
    )
    if words:
        is_off = any(doubts(elastic))
        by = ", by the load as stated, which does not fit," * is_off
        yield (
            f"{BENDS}: their stiffness is{by} {words}. At these stops that moves "
            f"the flange by up to {figure(elastic.sag_mm.most)} mm."
        )
    for spring in elastic.joints:
        if (slopes := spring.slopes) is not None:
            first, beyond = (
                f"{1e6 * value:.3g} +- {1e6 * sigma:.2g}"
                for value, sigma in (
                    (slopes.compliance_rad_per_nm, slopes.sigma_rad_per_nm),
                    (slopes.beyond_rad_per_nm, slopes.sigma_beyond_rad_per_nm),
                )
            )
            yield (
                f"{spring.joint} yields by two slopes: {first} urad/(N m) up to "
                f"{slopes.knee_nm:.0f} N m, and {beyond} beyond. Targets are corrected by the one "
                "slope that fits best: calibrate under the load of the work."
            )
    if elastic.weight == BY_CONTROLLER:
        yield (
            "Loads bend the arm, and its own weight does not: its controller compensates that, as "
            "those of KUKA and ABB do."
        )
    if elastic.weight_moments is not None:
        yield (
            "The arm yields to its own weight, of which its model states nothing: how far is "
            "estimated at every posture, and counted. A payload_kg that changes, or mass_kg and "
            "com_m in the joints' table, determine the stiffness."
        )


def doubts(elastic: ElasticResult) -> Iterator[Finding]:
    """Findings where the stated load contradicts the deflection."""
    factor = elastic.payload_factor
    if factor is not None and elastic.weight == OF_MASSES and factor.is_off:
        more = "heavier or hangs farther out" if factor.value > 1.0 else "lighter or hangs nearer"
        yield Finding(
            "load",
            f"Load and bend do not fit: the stops with a load bend {factor.value:.2f} +- "
            f"{figure(factor.sigma)} times as far as the load times its reach asks of joints that "
            f"yield to the arm's own weight as they do. The load is {more} than stated "
            "(payload_kg, payload_x_m ...), or the masses of the arm's links are off.",
            Remedy("Weigh the load, and correct payload_kg and its centre in views.csv."),
        )


def plays_of(model: ArmModel, covariance: FloatArray) -> tuple[JointBacklash, ...]:
    """Backlash of each joint; empty where stops were not approached from both sides.

    Joints lag behind their motion. Where they seem to lead as a whole, the column approach holds
    the opposite direction, and the sign is turned.

    Args:
        model: The arm.
        covariance: (p, p) covariance of its errors.
    """
    if BACKLASH not in model.weights:
        return ()
    variances = np.diag(covariance)[model.columns_of(BACKLASH)]
    sigmas = model.weights[BACKLASH] * np.sqrt(variances)
    bands = np.copysign(1.0, np.sum(model.backlash / sigmas**2)) * model.backlash
    columns = (model.nominal.joint_names, bands.tolist(), sigmas.tolist())
    return tuple(JointBacklash(*row) for row in zip(*columns, strict=True))


def play_findings(plays: Sequence[JointBacklash]) -> Iterator[Finding]:
    """Finding of joints with significant backlash: a note where that is little."""
    sure = [play for play in plays if play.is_sure]
    if not sure:
        return
    words = ", ".join(
        f"{play.joint} {figure(1e3 * abs(play.deadband_rad))} +- "
        f"{figure(1e3 * play.sigma_rad)} mrad"
        for play in sure
    )
    largest_rad = max(abs(play.deadband_rad) for play in sure)
    # Play of which half turns the flange by thrice an industrial arm's repeatability [rad].
    yield Finding(
        "joint_play" if largest_rad > 1e-3 else NOTE,
        f"Joints have play: {words}. The calibrated arm stands in the middle of it; of the first "
        "stop, no motion shows the side.",
        Remedy(
            "Approach every stop and every pick from the same side where half of that matters, or "
            "have the gear adjusted."
        ),
    )
