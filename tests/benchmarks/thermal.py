"""An arm whose drift was learnt in 100 minutes of warm-up, hours later.

A simulated UR10e warms up by 10 to 35 K; its links grow as steel to aluminium does, and its joints'
zeros drift. A camera of 5 MP looks at a board from 24 postures while the arm is cold, and then at
six of them again every five minutes. From what it saw until 100 minutes, the drift all over the
workspace is predicted up to the fifth hour: by temperatures of the joints, which are not those of
the links, or by the motors' currents alone.

    PYTHONPATH=tests python tests/benchmarks/thermal.py [WORLDS]
"""

import time
from dataclasses import replace

import numpy as np
from results import first, wished, write_section
from support.warmed import CELL, drift_of, warmed

WORLDS = 8
ARMS = {
    "as stated": CELL,
    "off by 0.3 mm, 0.5 mrad": replace(CELL, dh_sigma_m=3e-4, dh_sigma_rad=5e-4),
}


def main() -> None:
    worlds = wished(WORLDS)
    rows = []
    for arm, cell in first(tuple(ARMS.items())):
        for temperatures in (True, False):
            found, seconds = [], []
            for seed in range(worlds):
                world = replace(cell, seed=seed)
                begun = time.perf_counter()
                known = warmed(world, temperatures=temperatures)
                seconds.append(time.perf_counter() - begun)
                found.append(drift_of(known))
            shares = np.array([drift.share for drift in found])
            drifts = [1e3 * np.sqrt(np.mean(drift.true**2)) for drift in found]
            left = [1e3 * np.sqrt(np.mean(drift.left**2)) for drift in found]
            rows.append(
                f"| {arm} | {'temperatures' if temperatures else 'currents'} | "
                f"{np.median(drifts):.2f} | {np.median(left):.3f} | {np.median(shares):.2f} | "
                f"{shares.max():.2f} | "
                f"{np.median([drift.error_over_sigma for drift in found]):.2f} | "
                f"{np.median(seconds):.1f} |"
            )
            print(rows[-1], flush=True)
    text = "\n".join(
        [
            f"{worlds} worlds: root mean squares over 60 postures of the workspace, from minute "
            "100 to the fifth hour. *Share* is the remaining error over the drift, *surprise* "
            "the remaining error over its predicted sigma.",
            "",
            "| arm | measured | drift [mm] | left [mm] | share | worst | surprise | s |",
            "| --- | --- | --- | --- | --- | --- | --- | --- |",
            *rows,
        ]
    )
    write_section(
        "Drift with temperature", "PYTHONPATH=tests python tests/benchmarks/thermal.py", text
    )


if __name__ == "__main__":
    main()
