# ruff: noqa: E501
"""Figures of planning, loads and ISO 9283: 12 seeds of the brief's examples, 100 cells.

`instruments.py planning`, `loads` or `iso`, with the number of seeds behind it.
"""

from dataclasses import replace

import numpy as np
from results import WORDS, few, write_section

from visioncal.calibration.run import calibrate
from visioncal.core.transforms import compose, invert
from visioncal.planning.cell import TYPICAL_NOISE, InstrumentCell
from visioncal.planning.instrument import plan_for_instrument
from visioncal.planning.purposes import purpose_of
from visioncal.robot import load_robot
from visioncal.session.kinds import Instrument
from visioncal.simulation import CellOptions, cell_session, simulate
from visioncal.simulation.arms import Payload, arm_named, forward
from visioncal.simulation.instrument_session import (
    InstrumentOptions,
    random_postures,
    session_of,
    tracked,
)
from visioncal.verification.iso9283 import performance
from visioncal.verification.loaded import calibrate_loaded

ARM = "generic-6r-1800"
STIFF = np.array([3e6, 1.4e6, 9e5, 3e5, 3e5, 2e5])
SHOP = InstrumentOptions(robot=ARM, dh_sigma_m=5e-4, dh_sigma_rad=1e-3)
# RP of an isotropic normal distribution over its sigma per axis (Maxwell's mean and deviation).
RP = 1.5957691 + 3.0 * 0.6734396


def planning(seeds):
    """Example A: 30 planned stops against 30 random ones, judged at 200 others."""
    x, z = (
        compose(np.eye(3), np.array([2.5, -1, 0.4])),
        compose(np.eye(3), np.array([0.03, -0.02, 0.12])),
    )
    cell = InstrumentCell(load_robot(ARM), Instrument(2e-5), x, z, False, TYPICAL_NOISE)
    plan = plan_for_instrument(cell, purpose_of("kinematics"), 30)
    rows = []
    for seed in range(seeds):
        rng = np.random.default_rng([1, seed])
        unseen = plan.candidates[rng.choice(len(plan.candidates), 200, replace=False)]
        drawn = plan.candidates[rng.choice(len(plan.candidates), 30, replace=False)]
        row = []
        for q in (plan.q, drawn):
            shop = tracked(replace(SHOP, seed=seed), q)
            found = calibrate(session_of(shop))
            edges = [
                found.edges[name].matrix for name in ("base_from_instrument", "flange_from_probe")
            ]
            true = (
                invert(shop.base_from_instrument)
                @ forward(shop.true_arm, unseen)
                @ shop.flange_from_probe
            )
            predicted = (
                invert(edges[0]) @ found.calibrated_robot.base_from_flange(unseen) @ edges[1]
            )
            off = 1e3 * np.linalg.norm((true - predicted)[:, :3, 3], axis=1)
            row += [found.arm.levels[0].rms_mm, found.rms.mm, float(np.sqrt(np.mean(off**2)))]
        rows.append(row)
    of = np.sqrt(np.mean(np.square(rows), axis=0))
    return (
        f"Example A over {seeds} seeds, a point read to 20 um: kappa of Phi^T Phi {plan.condition():.2g} over "
        f"{plan.parameters} parameters (brief: 8e5 over 28), random stops "
        f"{np.median([plan.condition(plan.candidates[np.random.default_rng(i).choice(1500, 30)]) for i in range(20)]):.2g}. "
        f"Residual {of[0]:.2f} mm before and {of[1]:.3f} mm after the fit (brief: 1.6 and 0.31). Error at 200 postures "
        f"left out: planned {of[2]:.4f} mm, random {of[5]:.4f} mm, {100 * (1 - of[2] / of[5]):.0f} % less."
    )  # fmt: skip


def loads(seeds):
    """Example C at one pose, and 20 postures where the own weight is compensated."""
    lines = []
    options = replace(SHOP, dh_sigma_rad=5e-4, compliance_rad_per_nm=tuple(1 / STIFF), stops=40)
    flat = np.repeat([[0.3, 1.2, -1.0, 0.2, 0.4, 0.1]], 3, axis=0)
    forces = tuple(Payload(force_n=(0, 0, -newtons)) for newtons in (10.0, 20.0, 50.0))
    for name, changes in (
        ("bends by its weight", {}),
        ("weight compensated", {"weight_compensated": True}),
    ):
        off, wide = [], []
        for seed in range(seeds):
            drawn = replace(options, seed=seed, **changes)
            unloaded = calibrate(session_of(tracked(drawn)))
            result = calibrate_loaded(
                session_of(tracked(replace(drawn, payloads=forces), flat)), unloaded
            )
            springs = result.elastic.joints[1:3]
            sigmas = np.array([spring.sigma_rad_per_nm for spring in springs])
            found = np.array([spring.compliance_rad_per_nm for spring in springs])
            off.append((found - 1 / STIFF[1:3]) / sigmas)
            wide.append(sigmas * STIFF[1:3])
        inside = np.sum(np.abs(off) < 2.0, axis=0)
        lines.append(
            f"Example C, one pose under 10, 20 and 50 N, {name}: K2 within 2 sigma in {inside[0]}, K3 in {inside[1]} of "
            f"{seeds}; median sigma {100 * np.median(wide, axis=0)[0]:.0f} and {100 * np.median(wide, axis=0)[1]:.0f} %."
        )  # fmt: skip
    off, chosen = [], 0
    for seed in range(few(10, 1)):
        q = np.repeat(
            random_postures(arm_named(ARM), 20, np.random.default_rng(100 + seed)), 2, axis=0
        )
        drawn = replace(
            options, seed=seed, weight_compensated=True, payloads=(Payload(), forces[2])
        )
        result = calibrate(session_of(tracked(drawn, q)))
        chosen += result.elastic is not None and result.elastic.weight.startswith("compensated")
        spring = result.elastic.joints[1]
        off.append(abs(spring.compliance_rad_per_nm - 1 / STIFF[1]) / spring.sigma_rad_per_nm)
    lines.append(
        f"20 postures under 0 and 50 N, weight compensated: so chosen in {chosen} of {len(off)}, K2 within 2 sigma in "
        f"{int(np.sum(np.array(off) < 2))}."
    )  # fmt: skip
    return "\n\n".join(lines)


def _covered(poses, rp, accuracy):
    inside = [low <= rp <= high for pose in poses for _, low, high in [pose.repeatability_mm]]
    right = [low <= true <= high for pose, true in zip(poses, accuracy, strict=True) for _, low, high in [pose.accuracy_mm]]  # fmt: skip
    return np.array([inside, right, [pose.is_bound for pose in poses]])


def iso(cells):
    """Coverage of RP and AP by a tracker and by a camera."""
    lines = [
        "| device | RP [mm] | RP inside | AP inside | said at most |",
        "| --- | --- | --- | --- | --- |",
    ]
    for device in ("tracker", "camera"):
        for rp in (0.03, 0.1):
            found = [_one(device, rp, seed) for seed in range(cells)]
            share = 100 * np.concatenate(found, axis=1).mean(axis=1)
            lines.append(
                f"| {device} | {rp} | {share[0]:.1f} % | {share[1]:.1f} % | {share[2]:.0f} % |"
            )
            print(lines[-1], flush=True)
    return f"{cells} cells a row, five poses in 30 cycles each.\n\n" + "\n".join(lines)


def _one(device, rp, seed):
    sigma_m = 1e-3 * rp / RP
    if device == "tracker":
        options = InstrumentOptions(
            robot="ur10e", seed=seed, dh_sigma_m=3e-4, dh_sigma_rad=3e-4, robot_sigma_m=sigma_m,
            robot_sigma_rad=0.0, stops=25,
        )  # fmt: skip
        found = calibrate(session_of(tracked(options)))
        five = random_postures(arm_named("ur10e"), 5, np.random.default_rng([9, seed]))
        shop = tracked(options, np.tile(five, (30, 1)))
        gaps = [
            (forward(arm, five) @ shop.flange_from_probe)[:, :3, 3]
            for arm in (shop.arm, shop.true_arm)
        ]
        true = 1e3 * np.linalg.norm(gaps[1] - gaps[0], axis=1)
        return _covered(performance(session_of(shop), found).poses, rp, true)
    options = CellOptions(seed=seed, views=20, robot_sigma_m=sigma_m, robot_sigma_rad=0.0)
    cell = simulate(options)
    found = calibrate(cell_session(cell, "cell", seen="corners"))
    again = simulate(replace(options, recording=1), np.tile(cell.robot.joints[:5], (30, 1)))
    # The arm is exact: its accuracy is zero.
    return _covered(
        performance(cell_session(again, "cycles", seen="corners"), found).poses, rp, [0.0] * 5
    )


if __name__ == "__main__":
    parts = {"planning": (planning, 12), "loads": (loads, 12), "iso": (iso, 100)}
    for name in WORDS[:1] or parts:
        make, usual = parts[name]
        text = make(int(WORDS[1]) if len(WORDS) > 1 else few(usual, 1))
        print(text, flush=True)
        write_section(
            f"Instruments: {name}",
            f"PYTHONPATH=tests python tests/benchmarks/instruments.py {name}",
            text,
        )
