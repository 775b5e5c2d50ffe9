"""Exciting motions that the planner finds, from several seeds.

PYTHONPATH=tests python tests/benchmarks/excitation.py [SEEDS]
"""

from dataclasses import replace
from multiprocessing import Pool

import numpy as np
from results import few, first, wished, write_section

from visioncal.dynamics.base import BaseModel, condition_of
from visioncal.dynamics.excitation import Excitation, ExcitationRequest, excite
from visioncal.dynamics.limits import MotionLimits, MotionMargins, motion_limits
from visioncal.dynamics.model import DynamicModel, FrictionTerms
from visioncal.robot import load_robot

SEEDS = 10
SEARCH = few(ExcitationRequest(), ExcitationRequest(starts=1, steps=3))
ROBOTS = ("ur5e", "ur10e", "panda")
NO_FRICTION = FrictionTerms(coulomb=False, viscous=False, offset=False)


def figures(job: tuple[str, int]) -> tuple[float, ...]:
    """What one search finds: conditions, shares of the limits, distance [mm], starts, seconds."""
    name, seed = job
    allowed = motion_limits(load_robot(name), MotionMargins())
    found = excite(allowed, replace(SEARCH, seed=seed))
    condition, kept = found.condition, found.extremes
    return (
        condition.weighted,
        condition.scaled,
        condition.raw,
        links_alone(found),
        found.random.scaled,
        *(max(kept.shares[name]) for name in ("range", "speed", "acceleration", "torque")),
        broken(allowed, found),
        1e3 * kept.clearance_m,
        found.starts,
        found.seconds,
        found.base.rank,
    )


def links_alone(found: Excitation) -> float:
    """Condition of the same motion's regressor without friction, columns of unit length."""
    base = BaseModel.reduce(DynamicModel(found.base.model.robot, NO_FRICTION))
    return condition_of(base, found.series.sampled(100.0), np.ones(len(found.weights))).scaled


def broken(allowed: MotionLimits, found: Excitation) -> int:
    """Samples at 1 kHz whose positions, or differences of them, are beyond the data sheet."""
    q, robot = found.series.sampled(1000.0).q, allowed.robot
    beyond = [
        np.any((q < robot.lower_rad) | (q > robot.upper_rad), axis=1),
        np.any(np.abs(np.diff(q, axis=0)) * 1e3 > robot.velocity_rad_s, axis=1),
        np.any(np.abs(np.diff(q, 2, axis=0)) * 1e6 > robot.acceleration_rad_s2, axis=1),
    ]
    return int(sum(value.sum() for value in beyond))


def row(name: str, found: np.ndarray) -> str:
    """One line of the table: the median and the worst of each condition."""
    middle, worst = np.median(found, axis=0), found.max(axis=0)
    cells = [
        name,
        f"{middle[13]:.0f}",
        *(f"{middle[value]:.1f} / {worst[value]:.1f}" for value in (0, 1, 3)),
        f"{middle[2]:.0f} / {worst[2]:.0f}",
        f"{middle[4]:.0f}",
        *(f"{100 * worst[value]:.0f}" for value in (5, 6, 7, 8)),
        f"{worst[9]:.0f}",
        f"{found[:, 10].min():.0f}",
        f"{middle[11]:.0f}",
        f"{worst[12]:.0f}",
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    seeds = wished(SEEDS)
    robots = first(ROBOTS)
    jobs = [(name, seed) for name in robots for seed in range(seeds)]
    with Pool(2) as pool:
        found = np.array(pool.map(figures, jobs, chunksize=1)).reshape(len(robots), seeds, -1)
    lines = [
        f"{SEARCH.starts} starts from each of {seeds} seeds; motions of 20 s with 5 "
        "harmonics, for inertias and three terms of friction a joint. Conditions: median / worst "
        "of the seeds. Weighted: rows divided by the joints' greatest torques, columns of unit "
        "length; plain: rows as they are, columns of unit length; links alone: plain, without the "
        "columns of friction; raw: rows and columns as they are. Random motions stay within the "
        "limits of joints and drives (plain, median of 20). Shares of the limits: 90 % of the "
        "greatest speeds and accelerations, and torques with a margin of 1.2, at 1 kHz; "
        "beyond: samples at 1 kHz whose differences exceed the data sheet.",
        "",
        "| robot | base | weighted | plain | links alone | raw | random | range % | speed % | "
        "acceleration % | torque % | beyond | nearest mm | starts | s |",
        "| --- |" + " ---: |" * 14,
        *(row(name, array) for name, array in zip(robots, found, strict=True)),
    ]
    text = "\n".join(lines)
    print(text)
    write_section(
        "Exciting motions", "PYTHONPATH=tests python tests/benchmarks/excitation.py", text
    )


if __name__ == "__main__":
    main()
