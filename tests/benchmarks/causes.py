"""First causes of faults in cells that visioncal has not made: a table of confusions.

Each world of `elsewhere` has one fault, seen by camera in hand and to hand; a row says how often
each kind of finding was the first cause.

    PYTHONPATH=tests python tests/benchmarks/causes.py [--quick] [SEEDS] [WORLDS, a part of a name]
"""

import os
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import elsewhere
import numpy as np
from elsewhere import World
from results import WORDS, wished, write_section
from scipy.spatial.transform import Rotation
from support.edited import Rows, edit_rows

import visioncal
from visioncal.core.transforms import compose
from visioncal.session.columns import POSE

MOUNTS = ("eye-in-hand", "eye-to-hand")
_COMMAND = "PYTHONPATH=tests python tests/benchmarks/causes.py"


@dataclass(frozen=True)
class Fault:
    """A world with a fault, and the kinds of findings that name it."""

    world: World
    kinds: str
    change: Callable[[Path, np.random.Generator], None] | None = None  # Of the session's folder.
    is_given: bool | None = None  # Whether the lens is given; by turns if None.


def exchanged(folder: Path, rng: np.random.Generator) -> None:
    """Exchanges the poses of two rows."""

    def change(rows: Rows) -> Rows:
        first, second = rng.choice(len(rows), 2, replace=False)
        for name in POSE:
            rows[first][name], rows[second][name] = rows[second][name], rows[first][name]
        return rows

    edit_rows(folder, change)


def with_joints(folder: Path, _: np.random.Generator) -> None:
    """Adds the joint angles of the reported poses, and the arm's model."""

    def change(rows: Rows) -> Rows:
        numbers = np.array([[float(row[name]) for name in POSE] for row in rows])
        poses = compose(Rotation.from_quat(numbers[:, 3:]).as_matrix(), numbers[:, :3])
        for row, angles in zip(rows, elsewhere.joints_at(poses), strict=True):
            row |= {f"q{at + 1}_rad": repr(float(angle)) for at, angle in enumerate(angles)}
        return rows

    edit_rows(folder, change)
    joints = "".join(
        f'[[joint]]\nname = "j{at}"\na_m = {a}\nalpha_rad = {alpha}\nd_m = {d}\n'
        f"theta_offset_rad = {theta}\n"
        for at, (theta, d, a, alpha) in enumerate(elsewhere.ARM.tolist())
    )
    text = 'schema = 1\nname = "arm"\ntip = "flange"\nconvention = "standard"\n' + joints
    (folder / "arm.toml").write_text(text)
    with (folder / "session.toml").open("a") as file:
        file.write('[robot]\nmodel = "arm.toml"\n')


def slipping(size_rad: float) -> Callable[[np.ndarray, np.random.Generator], np.ndarray]:
    """The elbow's encoder slips midway, and the controller computes its poses by it."""

    def reported(poses: np.ndarray, _: np.random.Generator) -> np.ndarray:
        q = elsewhere.joints_at(poses)
        q[len(q) // 2 :, 2] += size_rad
        return elsewhere.links(q)[:, -1]

    return reported


FAULTS: Mapping[str, Fault] = {
    "lens grows by 0.15 %": Fault(World(focus=elsewhere.growing(0.0015), views=30), "lens_grows"),
    "base creeps by 0.5 mm": Fault(
        World(lift=lambda share: 5e-4 * share, views=30), "base_creeps|moved_slowly"
    ),
    "base tilts by 1.5 mrad/m": Fault(
        World(robot=elsewhere.tilting(1.5e-3), views=30), "base_tilts"
    ),
    "bracket bends by 0.3 mm": Fault(
        World(robot=elsewhere.bending(3e-4), views=30), "bracket_bends"
    ),
    "camera slips by 1 mm": Fault(
        World(lift=lambda share: 1e-3 * ((share > 0) - 0.5), views=30),
        "moved_at_once|something_moved",
    ),
    "joint slips by 2 mrad": Fault(
        World(robot=slipping(2e-3), views=30), "joint_slipped", with_joints
    ),
    "two rows exchanged": Fault(World(), "exchanged_views", exchanged),
    "board 0.5 % larger": Fault(World(board=elsewhere.stretched(1.005, 1.005)), "board_size"),
    "given lens off by 5 px": Fault(World(off_px=5.0), "lens", is_given=True),
}


def first_cause(name: str, mount: str, seed: int) -> str:
    """The kind of the first cause; the verdict without one."""
    fault = FAULTS[name]
    given = seed % 2 == 0 if fault.is_given is None else fault.is_given
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "session"
        elsewhere.cell(fault.world, mount, given, seed, folder)
        if fault.change is not None:
            fault.change(folder, np.random.default_rng([seed, 3]))
        try:
            verdict = visioncal.calibrate(folder).verdict
        except visioncal.VisioncalError as error:
            return type(error).__name__
    return verdict.causes[0].kind if verdict.causes else verdict.status


def main() -> None:
    """Writes the table."""
    seeds, part = wished(12), WORDS[1] if len(WORDS) > 1 else ""
    names = [name for name in FAULTS if part in name]
    jobs = [(name, mount, seed) for name in names for mount in MOUNTS for seed in range(seeds)]
    with ProcessPoolExecutor(int(os.environ.get("PROCESSES", "2"))) as pool:
        kinds = [*pool.map(first_cause, *zip(*jobs, strict=True))]
    rows, right = ["| fault | true | first causes |", "| --- | ---: | --- |"], 0
    for name in names:
        counts = Counter(kind for job, kind in zip(jobs, kinds, strict=True) if job[0] == name)
        true = sum(n for kind, n in counts.items() if re.fullmatch(FAULTS[name].kinds, kind))
        right += true
        listed = ", ".join(f"{kind} {n}" for kind, n in counts.most_common())
        rows.append(f"| {name} | {true} of {2 * seeds} | {listed} |")
        print(rows[-1])
    share = (
        f"Of {len(jobs)} cells {right} ({100 * right / len(jobs):.0f} %) name their fault first."
    )
    print(share)
    if not part:
        write_section("First causes of faults", _COMMAND, "\n".join([*rows, "", share]))


if __name__ == "__main__":
    main()
