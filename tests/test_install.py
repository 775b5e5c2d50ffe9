"""What a wheel carries: boards, robots and the report's template, found from any folder.

And the checks' options: a test that hangs is ended, and named.
"""

import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_a_wheel_carries_its_data_and_finds_it(tmp_path):
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*build, "--wheel-dir", str(tmp_path), str(ROOT)], check=True)
    (wheel,) = tmp_path.glob("visioncal-*.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
        names = archive.namelist()
    assert not [name for name in names if name.startswith(("tests/", "targets/"))]
    assert not [name for name in names if name.endswith(".md")]
    code = (
        "import visioncal.vision.targets as t, visioncal.robot as r, visioncal.present.report;"
        "target = t.load_target('charuco_9x6_30mm');"
        "print(t.__file__, target.square_m, r.load_robot('ur10e').joint_count)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
        env={"PYTHONPATH": str(site), "PATH": ""},
    )
    assert done.stdout.split() == [str(site / "visioncal/vision/targets.py"), "0.03", "6"]
    for data in (
        "present/report/report.html.j2",
        "present/report/report.css",
        "robot/models/ur10e.toml",
        "py.typed",
        *(f"live/clients/visioncal.{end}" for end in ("src", "dat", "xml", "mod", "kl", "script")),
    ):
        assert f"visioncal/{data}" in names


@pytest.mark.slow
def test_a_test_that_hangs_is_ended_and_named(tmp_path):
    """With the options of `.ci/run`, but for their time; the hang keeps Python's lock."""
    (options,) = re.findall(r"PYTEST_ADDOPTS='(.*)'", (ROOT / ".ci" / "run").read_text("utf-8"))
    hanging = tmp_path / "test_hanging.py"
    hanging.write_text("def test_it():\n    import ctypes; ctypes.PyDLL(None).sleep(10**6)\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "1", "--rootdir", tmp_path, hanging],
        check=False,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTEST_ADDOPTS": re.sub("=6[0-9]+", "=2", options)},
    )
    assert done.returncode == 1
    assert "crashed while running 'test_hanging.py::test_it'" in done.stdout
    assert f'"{hanging}", line 2 in test_it' in done.stderr
