"""What identified dynamics are good for: payloads, drive gains, collisions, torques fed forward.

PYTHONPATH=tests python tests/benchmarks/dynamics_use.py [WORLDS]
"""

from multiprocessing import Pool

import numpy as np
from results import wished, write_section

from visioncal.dynamics import (
    ArmDynamics,
    BaseModel,
    DynamicModel,
    FrictionTerms,
    Identified,
    JointMotion,
    Measured,
    drive_gains,
    estimate_payload,
    external_torques,
)
from visioncal.dynamics.conditioning import condition
from visioncal.dynamics.identify import SLOW_RAD_S, Options, identify
from visioncal.dynamics.reading import read_recorded
from visioncal.robot import Inertias, load_robot
from visioncal.simulation.dynamics import DynamicArm, LinkBody, drive_torques, real_dynamics
from visioncal.simulation.exercise import Exercise, Senses, multi_sine, record

WORLDS, ROBOT = 20, "ur10e"
TERMS = FrictionTerms(motor_inertia=True, slow_rad_s=SLOW_RAD_S)
PAYLOADS_KG = (0.5, 2.8, 8.0)
CENTRE_M, INERTIA = np.array([0.02, -0.03, 0.08]), np.diag([0.004, 0.0035, 0.003])
GAINS = (20.0, 21.0, 16.0, 9.0, 9.5, 8.7)
# A push of so much on the flange [N], and how fast residuals follow [1/s].
PUSH_N, GAIN_PER_S = 10.0, 25.0


def body(kg: float) -> LinkBody:
    """A payload of a density."""
    return LinkBody(kg, CENTRE_M, kg * INERTIA)


def conditioned(built: DynamicArm, done: Exercise, rng, gains=()):
    """What a controller records of a motion, filtered."""
    stream = record(built, done, rng, Senses(gains_nm_a=gains))
    return condition(read_recorded(stream, "run", 6, np.ones(6) if gains else ()))


def figures(seed: int) -> dict[str, np.ndarray]:
    """What one simulated arm gives."""
    rng, robot = np.random.default_rng(seed), load_robot(ROBOT)
    built = real_dynamics(ROBOT, rng)
    done, other = multi_sine(6, rng), multi_sine(6, rng, seconds=10.0)
    options = Options(TERMS, stribeck=False, checked=False)
    found = identify(robot, [conditioned(built, done, rng)], options).identified
    return {
        "payload": np.array([weighed(found, built, done, kg, rng) for kg in PAYLOADS_KG]),
        "gains": gains_off(built, done, rng),
        "collision": felt(found, built, other, rng),
        "fed": fed_forward(found, built, other),
    }


def weighed(found: Identified, built: DynamicArm, done: Exercise, kg: float, rng) -> list[float]:
    """Errors of mass [g] and centre [mm], and squares of both in units of their sigmas."""
    load = estimate_payload(found, [conditioned(built.carrying(body(kg)), done, rng)])
    off, away = load.mass_kg - kg, load.centre_m - CENTRE_M
    squares = [(off / load.mass_sigma_kg) ** 2, np.mean((away / load.centre_sigma_m) ** 2)]
    return [1e3 * abs(off), 1e3 * float(np.linalg.norm(away)), *squares]


def gains_off(built: DynamicArm, done: Exercise, rng) -> np.ndarray:
    """Errors of the drives' gains by the largest payload [%]."""
    load = body(PAYLOADS_KG[-1])
    known = Inertias.of_bodies(np.array([load.kg]), CENTRE_M[None], load.inertia_kg_m2[None])
    runs = [
        [conditioned(dynamic_arm, done, rng, GAINS)]
        for dynamic_arm in (built, built.carrying(load))
    ]
    base = BaseModel.reduce(DynamicModel(load_robot(ROBOT), TERMS))
    told = drive_gains(base, *runs, known.values[0])
    return 100.0 * np.abs(told.nm_per_a / np.array(GAINS) - 1.0)


def felt(found: Identified, built: DynamicArm, done: Exercise, rng) -> np.ndarray:
    """Residuals without a push at 99.9 % [N m], and how soon one is above these [ms]."""
    robot, arm, half = found.robot, ArmDynamics.of(found), 0.5 * done.times_s[-1]
    direction = rng.standard_normal(3)
    force = PUSH_N * direction / np.linalg.norm(direction)
    turned = np.einsum("mji,j->mi", robot.base_from_flange(done.q)[:, :3, :3], force)
    levers = robot.axis_jacobian(done.q)[:, 3:]
    external = np.einsum("mij,mi->mj", levers, turned) * (done.times_s >= half)[:, None]
    torques = drive_torques(built, done.q, done.dq, done.ddq)
    noise = 0.03 * np.sqrt(np.mean(torques**2, axis=0)) * rng.standard_normal(torques.shape)
    given = torques + noise - external
    measured = Measured(JointMotion(done.times_s, done.q, done.dq, done.ddq), given)
    residual = np.abs(external_torques(arm, measured, GAIN_PER_S))
    quiet = done.times_s < half
    limits = np.quantile(residual[quiet], 0.999, axis=0)
    above = np.flatnonzero((residual[~quiet] > 1.2 * limits).any(axis=1))
    soon = 1e3 * (done.times_s[~quiet][above[0]] - half) if len(above) else np.inf
    return np.array([*limits, soon])


def fed_forward(found: Identified, built: DynamicArm, done: Exercise) -> np.ndarray:
    """Shares of the torques' range that the identified arm leaves, and the maker's [%]."""
    arm, wanted = ArmDynamics.of(found), drive_torques(built, done.q, done.dq, done.ddq)
    known = ArmDynamics(arm.robot, arm.robot.inertias, arm.friction)
    off = [
        arm_dynamics.torques(done.q, done.dq, done.ddq) - wanted for arm_dynamics in (arm, known)
    ]
    return np.array(
        [100.0 * np.sqrt(np.mean(array**2, axis=0) / np.var(wanted, axis=0)) for array in off]
    )


def text(found: list[dict[str, np.ndarray]]) -> str:
    """The section."""
    payload, gains, collision, fed = (
        np.array([mapping[name] for mapping in found])
        for name in ("payload", "gains", "collision", "fed")
    )
    lines = [
        f"{len(found)} simulated UR10e whose masses and inertias differ by 20 % from the "
        "maker's, 3 % of noise in the torques, 20 s of a random multi-sine to identify the "
        "arm, and the same with a payload 88 mm from the flange's origin. Squares: squared "
        "errors over their stated variance, which should be 1.",
        "",
        "| payload [kg] | mass off by [g], median / worst | centre off by [mm] | squares, mass | "
        "centre |",
        "| --- | --- | --- | --- | --- |",
    ]
    for at, kg in enumerate(PAYLOADS_KG):
        grams, mm, mass, centre = payload[:, at].T
        lines.append(
            f"| {kg} | {np.median(grams):.1f} / {grams.max():.1f} | {np.median(mm):.2f} / "
            f"{mm.max():.2f} | {mass.mean():.2f} | {centre.mean():.2f} |"
        )
    limits, soon = collision[:, :6], collision[:, 6]
    lines += [
        "",
        f"- Drive gains from a known {PAYLOADS_KG[-1]:g} kg, currents recorded: errors of "
        f"{np.median(gains):.2f} % in the median, {gains.max():.2f} % at worst.",
        f"- Feed-forward torques of another motion, links as bodies: errors of "
        f"{np.median(fed[:, 0]):.2f} % of their range in the median of joints "
        f"({fed[:, 0].max():.2f} % at worst); with the maker's inertias and the same friction "
        f"{np.median(fed[:, 1]):.1f} % "
        f"({fed[:, 1].max():.0f} %).",
        f"- Collisions, an observer of {GAIN_PER_S:g}/s while all joints move: without one the "
        f"residuals stay under "
        f"{', '.join(f'{value:.1f}' for value in np.median(limits, axis=0))} N m "
        f"(99.9 %, joints 1 to 6); {PUSH_N:g} N on the flange are above 1.2 times that after "
        f"{np.median(soon):.0f} ms in the median, {soon.max():.0f} ms at worst.",
    ]
    return "\n".join(lines)


def main(worlds: int) -> None:
    """Runs the worlds and writes the section."""
    with Pool() as pool:
        found = pool.map(figures, range(worlds))
    command = "PYTHONPATH=tests python tests/benchmarks/dynamics_use.py"
    write_section("What identified dynamics are good for", command, text(found))


if __name__ == "__main__":
    main(wished(WORLDS))
