"""Arms of ordinary cells: their documents, and kinematics that share nothing with visioncal."""

import tomllib
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tomli_w
from scipy.spatial.transform import Rotation

BUILT_IN = Path(__file__).parents[3] / "visioncal" / "robot" / "models"
ROUNDS, SETTLED = 40, 1e-10


@dataclass(frozen=True, eq=False)
class Arm:
    """A serial arm as it is declared."""

    model: str  # What session.toml says: a built-in name, or the name of the file beside it.
    text: str  # The content of that file; empty for a built-in arm.
    before: np.ndarray  # (n, 4, 4) the constant before each joint, about whose z it turns.
    last: np.ndarray  # (4, 4) the constant behind the last joint.
    lower: np.ndarray  # (n,) limits [rad].
    upper: np.ndarray  # (n,) limits [rad].
    tip: str  # The frame at its end.

    def frames(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(m, n, 4, 4) the joints' frames after their motion, and (m, 4, 4) the tips, at (m, n)."""
        at, frames = np.eye(4), []
        for place, angle in zip(self.before, q.T, strict=True):
            turn = np.tile(np.eye(4), (len(q), 1, 1))
            turn[:, :3, :3] = Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).as_matrix()
            at = at @ place @ turn
            frames.append(at)
        return np.stack(frames, axis=1), at @ self.last

    def reach(self, wanted: np.ndarray, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Joints (m, n) that bring the tip to (m, 4, 4), from one start, and which of them do."""
        q = np.tile(start, (len(wanted), 1))
        for _ in range(ROUNDS):
            frames, tips = self.frames(q)
            turn = Rotation.from_matrix(wanted[:, :3, :3] @ tips[:, :3, :3].swapaxes(1, 2))
            miss = np.concatenate([wanted[:, :3, 3] - tips[:, :3, 3], turn.as_rotvec()], axis=1)
            axes = frames[..., :3, 2]
            arms = tips[:, None, :3, 3] - frames[..., :3, 3]
            jacobian = np.concatenate([np.cross(axes, arms), axes], axis=2).swapaxes(1, 2)
            damped = jacobian @ jacobian.swapaxes(1, 2) + 1e-6 * np.eye(6)
            step = (jacobian.swapaxes(1, 2) @ np.linalg.solve(damped, miss[..., None]))[..., 0]
            q += np.clip(step, -0.3, 0.3)
            if np.abs(miss).max() < SETTLED:
                break
        within = ((q > self.lower) & (q < self.upper)).all(axis=1)
        near = np.abs(q - start).max(axis=1) < 2.5
        return q, within & near & (np.abs(miss).max(axis=1) < 1e-8)


def placed(xyz_m: object, turn: Rotation) -> np.ndarray:
    """(4, 4) of a place and a turn."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), xyz_m
    return matrix


def _row(joint: dict, *, modified: bool) -> tuple[np.ndarray, np.ndarray]:
    """What a row of a joint table has before and behind its joint, by its definition."""
    across = placed([joint["a_m"], 0.0, 0.0], Rotation.from_rotvec([joint["alpha_rad"], 0.0, 0.0]))
    theta = joint.get("theta_offset_rad", 0.0)
    along = placed([0.0, 0.0, joint["d_m"]], Rotation.from_rotvec([0.0, 0.0, theta]))
    # The joint's own turn and a constant along or about the same axis commute.
    return (across @ along, np.eye(4)) if modified else (along, across)


def arm_of_table(table: dict, model: str, text: str = "") -> Arm:
    rows = [_row(value, modified=table["convention"] == "modified") for value in table["joint"]]
    ends = []
    for name in ("base", "flange"):
        end = table.get(name, {})
        if "a_m" in end:
            row = {**end, "theta_offset_rad": end["theta_rad"]}
            ends.append(np.matmul(*_row(row, modified=table["convention"] == "modified")))
        else:
            turn = Rotation.from_euler("xyz", end.get("rpy_rad", [0.0] * 3))
            ends.append(placed(end.get("xyz_m", [0.0] * 3), turn))
    behind = [ends[0], *(row[1] for row in rows)]
    before = [first @ row[0] for first, row in zip(behind, rows, strict=False)]
    lower = np.deg2rad([value.get("lower_deg", -360.0) for value in table["joint"]])
    upper = np.deg2rad([value.get("upper_deg", 360.0) for value in table["joint"]])
    tip = table.get("tip", "flange")
    return Arm(model, text, np.array(before), behind[-1] @ ends[1], lower, upper, tip)


def built_in(name: str) -> Arm:
    return arm_of_table(tomllib.loads((BUILT_IN / f"{name}.toml").read_text()), name)


def built_in_names() -> list[str]:
    return sorted(path.stem for path in BUILT_IN.glob("*.toml"))


def table_arm(rng: np.random.Generator, file: str, name: str) -> Arm:
    """An arm like a built-in one, of another size, written as a joint table."""
    like = tomllib.loads((BUILT_IN / f"{rng.choice(['ur5e', 'irb120', 'panda'])}.toml").read_text())
    size = float(rng.uniform(0.7, 1.8))
    table = {"schema": 1, "name": name, "tip": "hand", "convention": like["convention"]}
    kept = ("alpha_rad", "theta_offset_rad", "lower_deg", "upper_deg")
    table["joint"] = [
        {"name": f"j{at}", "a_m": size * value["a_m"], "d_m": size * value["d_m"]}
        | {key: value[key] for key in kept if key in value}
        for at, value in enumerate(like["joint"], 1)
    ]
    if rng.random() < 0.5:
        height_m, yaw_rad = rng.uniform([0.0, -3.0], [0.8, 3.0]).tolist()
        table["base"] = {"xyz_m": [0.0, 0.1, height_m], "rpy_rad": [0.0, 0.0, yaw_rad]}
    if "flange" in like:
        table["flange"] = like["flange"]
    return arm_of_table(table, file, tomli_w.dumps(table))


def urdf_arm(rng: np.random.Generator, file: str, name: str) -> Arm:
    """An arm like a built-in one, of another size, as a URDF whose axes are not all along z."""
    like = built_in(str(rng.choice(["ur10e", "irb120", "panda", "generic-6r-1800"])))
    size = float(rng.uniform(0.7, 1.6))
    before, last = like.before.copy(), like.last.copy()
    before[:, :3, 3] *= size
    last[:3, 3] *= size
    links = [f"{index}link" for index in range(len(before) + 1)] + ["tcp é"]
    tags = [f'<link name="{link}"/>' for link in links]
    turn = np.eye(4)
    for at, place in enumerate(before):
        # The same axis, said in a frame that is turned.
        other = placed([0.0] * 3, Rotation.random(random_state=int(rng.integers(1 << 31))))
        if rng.random() < 0.5:
            other = np.eye(4)
        origin = turn @ place @ other
        axis = other[:3, :3].T[:, 2]
        limits = f'lower="{like.lower[at]:.6f}" upper="{like.upper[at]:.6f}"'
        tags.append(
            f'<joint name="j {at}" type="revolute">{_origin(origin)}'
            f'<parent link="{links[at]}"/><child link="{links[at + 1]}"/>'
            f'<axis xyz="{" ".join(map(repr, axis.tolist()))}"/>'
            f'<limit {limits} effort="100" velocity="2"/></joint>'
        )
        turn = np.linalg.inv(other)
    tags.append(
        f'<joint name="end" type="fixed">{_origin(turn @ last)}'
        f'<parent link="{links[-2]}"/><child link="{links[-1]}"/></joint>'
    )
    body = "\n".join(tags)
    text = f'<?xml version="1.0"?>\n<robot name="{name}">\n{body}\n</robot>\n'
    return replace(like, model=file, text=text, before=before, last=last, tip=links[-1])


def _origin(place: np.ndarray) -> str:
    # Turns of 90 degrees about y leave the split between the others open, of which scipy warns.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        rpy = Rotation.from_matrix(place[:3, :3]).as_euler("xyz").tolist()
    xyz, turn = (" ".join(map(repr, value)) for value in (place[:3, 3].tolist(), rpy))
    return f'<origin xyz="{xyz}" rpy="{turn}"/>'
