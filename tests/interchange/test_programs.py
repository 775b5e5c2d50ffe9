"""Programs of KUKA, ABB and UR: only literal targets differ, and the real arm reaches them.

The programs in `programs/` were written after the makers' manuals, before their reader was.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from support.commands import visioncal as command

from visioncal.calibration.run import calibrate
from visioncal.core.conventions import PoseNumbers, Reading
from visioncal.core.transforms import compose, invert
from visioncal.core.types import FloatArray
from visioncal.interchange.programs import correct_program, dialect_of
from visioncal.results.compensation.correction import CalibratedArm
from visioncal.robot import Robot
from visioncal.robot.inverse import Inverse

PROGRAMS = Path(__file__).with_name("programs")
# The postures of T 'B01010', and of the scripts' joints.
SIGNS = (1.57, -1.57, 1.57, -1.57, 1.57, 1.57)
NEAR = ((-0.4, -1.5, 1.6, -1.7, -1.6, 0.3), (-0.5, -1.4, 1.5, -1.6, -1.5, 0.2))
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
# A model of each maker's shape, and one that is off by what arms are.
ARMS = {"KRL": "generic-6r-1800", "RAPID": "generic-6r-1800", "URScript": "ur10e"}


def arm_of(dialect: str) -> CalibratedArm:
    from visioncal.robot import load_robot

    nominal = load_robot(ARMS[dialect])
    rng = np.random.default_rng(3)
    twists = rng.normal(size=(7, 6)) * np.repeat([1e-3, 5e-4], 3)
    real = nominal.corrected(twists)
    return CalibratedArm(nominal, real, Inverse(real), np.zeros(6), None)


def texts_of(name: str) -> dict[str, str]:
    path = PROGRAMS / name
    files = [path, *([path.with_suffix(".dat")] if path.with_suffix(".dat").exists() else [])]
    return {file.name: file.read_bytes().decode("latin-1") for file in files}


def corrected(name: str, **options):
    dialect = dialect_of(Path(name).suffix)
    texts = texts_of(name)
    return texts, correct_program(dialect, texts, arm_of(dialect.name), lambda _: None, **options)


def without_numbers(text: str) -> str:
    return NUMBER.sub("#", text)


# Program, targets that are replaced, and what stays with its reason.
CASES = [
    ("weld.src", ["XP1", "XP2"], ["tool TOOL_DATA[7]", "LIN_REL is relative", "XHOME"]),
    (
        "expert.src",
        ["line 8 (PTP)", "line 9 (LIN)", "line 10 (lin)"],
        ["line 11", "LIN_REL is relative", "P[i]", "CIRC is neither", "XBASE:", "BASE_DATA[4]"],
    ),
    ("spline.src", ["line 4 (SPTP)", "line 5 (SLIN)"], []),
    (
        "pick.mod",
        ["jRest", "pHome", "pPick", "line 16 (MoveL)"],
        ["Offs is relative to pPick, and moves along", "RelTool is relative to pHere"],
    ),
    ("weld.modx", ["p10"], ["MoveC is neither", "tool tTorch"]),
    ("two.prg", ["pB"], ["tool tOther", "pA: it is used with several", "pCounted is calculated"]),
    ("poly.script", ["Waypoint_1_p", "Waypoint_2_p"], ["pose_trans(Waypoint_2_p", "relative"]),
    (
        "hand.script",
        ["line 4 (movej)", "line 5 (movel)", "line 8 (movep)"],
        ["pose_add(here", "movec is neither"],
    ),
    ("bare.script", [], ["set_tcp is not in the program", "target is calculated"]),
]


@pytest.mark.parametrize(("name", "changed", "left"), CASES, ids=[case[0] for case in CASES])
def test_only_literal_targets_differ_and_what_stays_is_named(name, changed, left):
    texts, done = corrected(name)
    assert [label.split(", ")[-1] for label in done.changed] == changed, done
    for words in left:
        assert any(words in line for line in done.left), (words, done.left)
    if not left:
        assert done.left == ()
    for file, text in texts.items():
        assert without_numbers(done.texts[file]) == without_numbers(text)
        before, after = text.splitlines(), done.texts[file].splitlines()
        differing = [
            row for row, pair in enumerate(zip(before, after, strict=True)) if len({*pair}) > 1
        ]
        assert len(differing) <= len(changed)
    count = sum(done.texts[file] != text for file, text in texts.items())
    assert bool(count) == bool(changed)


def posed(values: list[float], rotation: str, unit: str) -> FloatArray:
    numbers = np.array(values)[None]
    return PoseNumbers(numbers[:, :3], numbers[:, 3:], Reading(rotation, unit), ("",)).poses()[0]


@pytest.mark.parametrize(
    ("name", "label", "rotation", "unit", "tool_m", "near"),
    [
        ("spline.src", "SPTP {", "euler-ZYX-deg", "mm", 0.0, SIGNS),
        ("pick.mod", "pHome:=", "quaternion-wxyz", "mm", 0.0, (0.8, 0, 0, 0.8, 0, 0.8)),
        ("two.prg", "pB :=", "quaternion-wxyz", "mm", 0.0, (-0.8, 0, 0, 0.8, 0, -0.8)),
        ("poly.script", "Waypoint_1_p=", "rotation-vector", "m", 0.12, NEAR[0]),
        ("hand.script", "  movel(p[-0.42", "rotation-vector", "m", 0.0, NEAR[1]),
    ],
)  # fmt: skip
def test_the_real_arm_reaches_the_programs_targets(name, label, rotation, unit, tool_m, near):
    """By the controller's inverse of the corrected command, and the real arm's forward."""
    texts, done = corrected(name)
    arm, count = arm_of(dialect_of(Path(name).suffix).name), 7 if "quaternion" in rotation else 6
    wanted, sent = (
        posed([float(word) for word in NUMBER.findall(written)][:count], rotation, unit)
        for text in (texts, done.texts)
        for line in text[name].splitlines()
        if label in line
        for written in [line.split(re.sub(r"p\[.*", "", label))[-1]]
    )
    tool = compose(np.eye(3), np.array([0.0, 0.0, tool_m]))
    # The controller takes the posture that the program states, or is in already.
    posture = Inverse(arm.nominal).solve(sent @ invert(tool), np.array(near), widest_rad=1e-3)
    assert posture.reached
    reached = arm.real.base_from_flange(arm.nominal.chain.encoded(posture.positions[None]))[0]
    place = (reached @ tool)[:3, 3]
    # What is written to 1 um and 1e-4 deg, and twice the tolerance of an inverse.
    assert np.linalg.norm(place - wanted[:3, 3]) < 1e-5
    # Uncorrected, it is off by as much as this arm is.
    assert np.linalg.norm(place - sent[:3, 3]) > 3e-4


def test_the_command_lists_a_diff_and_never_writes_over_the_program(tmp_path):
    from visioncal.simulation.instrument_session import InstrumentOptions, session_of, tracked

    shop = tracked(InstrumentOptions(robot="ur10e", dh_sigma_m=5e-4, dh_sigma_rad=1e-3, stops=25))
    (tmp_path / "out").mkdir()
    calibrate(session_of(shop)).save(tmp_path / "out" / "calibration.json")
    source = tmp_path / "hand.script"
    source.write_bytes((PROGRAMS / "hand.script").read_bytes().replace(b"\n", b"\r\n"))
    words = ("correct", source, "--against", tmp_path / "out")
    command(*words).refused("-o FOLDER is missing")
    done = command(*words, "-o", tmp_path / "sent").good()
    assert "3 targets corrected" in done.said
    assert "left as it is: hand.script, line 7: pose_add(here" in done.err
    assert len(re.findall(r"^\+ ", done.out, re.MULTILINE)) == 3
    written = (tmp_path / "sent" / "hand.script").read_bytes()
    assert written.count(b"\r\n") == source.read_bytes().count(b"\n")
    command(*words, "-o", tmp_path / "sent").refused("hand.script")
    command(*words, "-o", tmp_path).refused("hand.script")
    assert isinstance(arm_of("URScript").real, Robot)
