"""Tables of measured points, written as metrology programs do: each gives the same session."""

import json
from functools import lru_cache

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from support.commands import visioncal

from visioncal.calibration.run import calibrate
from visioncal.core.transforms import invert
from visioncal.interchange.formats.reading import read_fields
from visioncal.session import Session
from visioncal.simulation.arms import forward
from visioncal.simulation.instrument_session import THREE, InstrumentOptions, tracked

STOPS = 10


@lru_cache
def shop(count=1, *, poses=False):
    options = InstrumentOptions(robot="ur10e", points=THREE[:count], poses=poses, stops=STOPS)
    return tracked(options)


def reads(name, *more, comma=False, unit=1e3):
    """A row: names, the place [1/unit m] of each reading, and what stands behind it."""

    def row(stop, point, pose):
        cells = [word.format(stop=stop + 1, point=point + 1) for word in name]
        cells += [f"{value:.7f}" for value in unit * pose[:3, 3]]
        cells += [each if isinstance(each, str) else f"{each:.7f}" for each in more]
        return [cell.replace(".", ",") for cell in cells] if comma else cells

    return row


def angles(stop, count=1):
    return [f"{angle:.9f}" for angle in np.rad2deg(shop(count).joints[stop])]


def joined(rows, mark=","):
    return "\n".join(row if isinstance(row, str) else mark.join(row) for row in rows) + "\n"


def joints_table(names, count=1, order=range(STOPS), head="Name"):
    rows = [[names.format(stop=stop + 1), *angles(stop, count)] for stop in order]
    return joined([[head, *(f"J{at} [deg]" for at in range(1, 7))], *rows])


def spatial_analyzer(folder):
    """Targets in groups of a collection, in inches, uncertainties behind; the robot's by name."""
    row = reads(["Cell 4::Pose_{stop:02d}::SMR{point}"], 0.0008, 0.0008, 0.0007, unit=1 / 0.0254)
    lines = [row(*each) for each in shop(3).rows]
    title = "// SpatialAnalyzer 2023.2\n// Units: Inches\n// Instrument: Leica AT960\n"
    (folder / "points.txt").write_text(title + joined(lines, ", "))
    order = np.random.default_rng(1).permutation(STOPS)
    (folder / "arm.csv").write_text(joints_table("Pose_{stop:02d}", 3, order))
    return 3, "equal names", ("leica-at960", 25.4 * np.sqrt((2 * 0.8**2 + 0.7**2) / 3)), ()


def spatial_analyzer_by_points(folder):
    """A group a target on the flange, names with blanks between, no headings."""
    row = reads(["A", "SMR{point}", "P{stop}"])
    lines = [row(*each) for each in sorted(shop(3).rows, key=lambda each: each[1])]
    (folder / "points.txt").write_text("// units mm\n" + joined(lines, " "))
    (folder / "arm.csv").write_text(joints_table("P{stop}", 3))
    return 3, "equal names", ("leica-at960", None), ("--instrument", "leica-at960")


def polyworks(folder):
    """Measured, nominal and deviation beside each other; decimal commas; joints in German."""
    heads = [f"{axis} {word}" for word in ("Measured", "Nominal", "Dev") for axis in "XYZ"]
    heads = ["Name", *heads, *(f"Gelenk {at} [°]" for at in range(1, 7))]
    more = ("1.5", "2.5", "3.5", "-0.3", "-0.3", "-0.3")
    rows = [
        reads(["point {stop}"], *more, *angles(n), comma=True)(n, p, t) for n, p, t in shop().rows
    ]
    (folder / "in.csv").write_text(
        "PolyWorks|Inspector;;\nUnit;mm\n\n" + joined([heads, *rows], ";")
    )
    return 1, "", ("faro-vantage", None), ("--instrument", "faro-vantage")


def cam2(folder):
    """Sigmas by axis, tabs, and fewer poses of the robot than points."""
    heads = ["Label", *(f"Actual {a} (mm)" for a in "XYZ"), *(f"U95 {a} (mm)" for a in "XYZ")]
    row = reads(["M{stop:03d}"], "0.036", "0.036", "0.024")
    title = "CAM2 Measure 10\tFARO Vantage S6\n"
    rows = [heads, *(row(*each) for each in shop().rows)]
    (folder / "points.txt").write_text(title + joined(rows, "\t"))
    (folder / "arm.csv").write_text(joints_table("M{stop:03d}", order=range(STOPS - 1)))
    sigma_um = np.sqrt((2 * 18**2 + 12**2) / 3)
    return 1, "left out: points.txt", ("faro-vantage", sigma_um), ()


def leica(folder):
    """Rows without names, and uncertainties of 95 %, as Leica's software exports them."""
    heads = [f"{word}{axis}  [mm]" for word in ("", "U(95) ") for axis in "XYZ"]
    row = reads([], "0.036", "0.036", "0.024")
    (folder / "Leica.csv").write_text(joined([heads, *(row(*each) for each in shop().rows)]))
    (folder / "arm.csv").write_text(joints_table("P{stop}"))
    sigma_um = np.sqrt((2 * 18**2 + 12**2) / 3)
    return 1, "k = 2: 0.018, 0.018, 0.012 mm", ("instrument", sigma_um), ("--mount", "instrument")


def side_by_side(folder):
    """Three targets in one row, sigma by the user."""
    heads = ["No", *(f"T{point} {axis} [mm]" for point in (1, 2, 3) for axis in "XYZ")]
    rows = [[*heads, *(f"A{at} [deg]" for at in range(1, 7))]]
    for stop in range(STOPS):
        places = [reads([])(*each) for each in shop(3).rows[3 * stop : 3 * stop + 3]]
        rows.append([str(stop), *(cell for place in places for cell in place), *angles(stop, 3)])
    (folder / "in.csv").write_text(joined(rows, ";"))
    return 3, "", ("instrument", 20.0), ("--mount", "instrument", "--instrument", "0.02")


def report(folder):
    """A row an axis, as reports have them."""
    rows = [["Object", "Control", "Nominal", "Measured [mm]", "Deviation"]]
    for stop, _, pose in shop().rows:
        for axis, value in zip("XYZ", 1e3 * pose[:3, 3], strict=True):
            rows.append([f"pt {stop + 1}", axis, "1.5", f"{value:.7f}", "0.2"])
    (folder / "report.csv").write_text("PolyWorks|Inspector\n" + joined(rows))
    (folder / "arm.csv").write_text(joints_table("pt {stop}", order=range(STOPS)[::-1]))
    return 1, "equal names", ("instrument", 20.0), ("--instrument", "0.02")


@pytest.mark.parametrize(
    "layout",
    [report, spatial_analyzer, spatial_analyzer_by_points, polyworks, cam2, leica, side_by_side],
)
def test_points_of_metrology_programs_are_a_session_of_an_instrument(tmp_path, layout):
    (tmp_path / "in").mkdir()
    count, words, (name, sigma_um), said = layout(tmp_path / "in")
    made = visioncal("convert", tmp_path / "in", tmp_path / "out", "--robot-model", "ur10e", *said)
    assert words in made.good().err
    session, world = Session.load(tmp_path / "out"), shop(count)
    table = session.instruments[""]
    assert table.name == name
    assert (table.sigma_m or 0.0) == pytest.approx(1e-6 * (sigma_um or 0.0))
    true = {(stop, point): pose for stop, point, pose in world.rows}
    assert len(session.views) >= len(true) - 1
    points = sorted({view.point for view in session.views})
    for view in session.views:
        stop = np.abs(world.joints - view.joints_rad).max(axis=1).argmin()
        place = true[stop, points.index(view.point)][:3, 3]
        # The tables have seven decimals of inches or millimetres.
        np.testing.assert_allclose(view.reading_m, place, rtol=0, atol=2e-9)
        np.testing.assert_allclose(view.joints_rad, world.joints[stop], rtol=0, atol=1e-9)
    stops = [tuple(view.joints_rad) for view in session.views]
    assert len({*zip(stops, (view.stop for view in session.views), strict=True)}) == len({*stops})


def test_frames_of_a_probe_beside_a_table_of_joints_are_readings(tmp_path):
    (tmp_path / "in").mkdir()
    rows = [["Frame", *"XYZ", "Rx", "Ry", "Rz"]]
    for stop, _, pose in shop(poses=True).rows:
        turns = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz", degrees=True)
        rows.append(reads(["F{stop}"], *turns)(stop, 0, pose))
    (tmp_path / "in/frames.csv").write_text("// SpatialAnalyzer\n" + joined(rows))
    order = np.random.default_rng(2).permutation(STOPS)
    table = joints_table("F{stop}", order=order)
    (tmp_path / "in/arm.csv").write_text(table)
    said = ("--robot-model", "ur10e", "--instrument", "leica-at960")
    visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    views = Session.load(tmp_path / "out").views
    for view, (stop, _, pose) in zip(views, shop(poses=True).rows, strict=True):
        np.testing.assert_allclose(view.instrument_from_probe(), pose, rtol=0, atol=2e-9)
        np.testing.assert_allclose(view.joints_rad, shop(poses=True).joints[stop], atol=1e-9)
    other = visioncal("convert", tmp_path / "in", tmp_path / "again", "--instrument", "my tracker")
    other.refused("There is no instrument named 'my tracker'", "--instrument 0.02")


def test_a_probe_s_turns_are_read_and_the_robot_s_own_poses_beside_them(tmp_path):
    world = shop(poses=True)
    nominal = forward(world.arm, world.joints)
    kuka = [
        f"Robot {word} [{unit}]"
        for word, unit in zip("XYZABC", ["mm"] * 3 + ["deg"] * 3, strict=True)
    ]
    rows = [["Target", *(f"Meas {a} [mm]" for a in "XYZ"), *(f"R{a} (deg)" for a in "xyz"), *kuka]]
    for stop, _, pose in world.rows:
        turns = [
            [f"{v:.9f}" for v in Rotation.from_matrix(at[:3, :3]).as_euler(order, degrees=True)]
            for at, order in ((pose, "xyz"), (nominal[stop], "ZYX"))
        ]
        rows.append([*reads(["T{stop}"])(stop, 0, pose), *turns[0]])
        rows[-1] += [*(f"{v:.7f}" for v in 1e3 * nominal[stop][:3, 3]), *turns[1]]
    (tmp_path / "in.csv").write_text(joined(rows))
    said = ("--robot-form", "kuka", "--instrument", "leica-at960")
    made = visioncal("convert", tmp_path / "in.csv", tmp_path / "out", *said).good()
    assert "Rx (deg), Ry (deg), Rz (deg) are taken for turns about the fixed axes" in made.err
    session = Session.load(tmp_path / "out")
    for view, (stop, _, pose) in zip(session.views, world.rows, strict=True):
        np.testing.assert_allclose(view.instrument_from_probe(), pose, rtol=0, atol=1e-9)
        np.testing.assert_allclose(view.base_from_flange().as_matrix(), nominal[stop], atol=1e-9)
    found = calibrate(session).edges["base_from_instrument"]
    off = (invert(world.base_from_instrument) @ found.matrix)[:3, 3]
    assert np.linalg.norm(off) < 3e-3 * found.sigma_mm


LOAD = {"payload_kg": 2.5, "payload_z_m": 0.08}


@pytest.mark.parametrize(
    ("heads", "cells", "load"),
    [
        ("Target,Load [kg],CoG Z [mm]", ["P{stop}", "{kg}", "80"], LOAD),
        ("Group,Target", ["{kg}kg", "P{stop}"], {"payload_kg": 2.5}),
        ("Target,Force [N]", ["P{stop}", "{kg}"], {"force_z_n": -2.5, "force_x_n": 0.0}),
    ],
)  # fmt: skip
def test_loads_stand_in_columns_or_in_the_names_of_groups(tmp_path, heads, cells, load):
    """Each stop is read unloaded and loaded; the robot's table names it once."""
    (tmp_path / "in").mkdir()
    rows = [[*heads.split(","), "X", "Y", "Z"]]
    for kg in ("0", "2.5"):
        names = [cell.replace("{kg}", kg) for cell in cells]
        rows += [reads(names)(*each) for each in shop().rows]
    (tmp_path / "in/points.csv").write_text(joined(rows))
    (tmp_path / "in/arm.csv").write_text(joints_table("P{stop}"))
    said = ("--robot-model", "ur10e", "--instrument", "leica-at960")
    visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    views = Session.load(tmp_path / "out").views
    assert len({view.stop for view in views}) == len(views) == 2 * STOPS
    for name, value in load.items():
        assert [view.numbers[name] for view in views[STOPS:]] == [pytest.approx(value)] * STOPS
    np.testing.assert_allclose(views[0].joints_rad, views[STOPS].joints_rad)


def test_angles_without_headings_stand_beside_points_in_turn(tmp_path):
    """Three points at each stop in one list, and the joints in a file that is called by angles."""
    world = shop(3)
    points = [[f"{1e3 * value:.7f}" for value in pose[:3, 3]] for *_, pose in world.rows]
    (tmp_path / "in").mkdir()
    (tmp_path / "in/POSES.txt").write_text(joined(points, " "))
    states = joined([angles(stop, 3) for stop in range(STOPS)], " ")
    (tmp_path / "in/AnglesInDeg.txt").write_text(states)
    said = ("--mount", "instrument", "--robot-model", "ur10e")
    done = visioncal("convert", tmp_path / "in", tmp_path / "out", *said).good()
    assert "3 points are taken in turn at each stop" in done.err
    views = Session.load(tmp_path / "out").views
    assert len(views) == 3 * STOPS
    for view, (stop, _, pose) in zip(views, world.rows, strict=True):
        np.testing.assert_allclose(view.reading_m, pose[:3, 3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(view.joints_rad, world.joints[stop], rtol=0, atol=1e-9)


def test_a_list_of_joints_stands_beside_each_point(tmp_path):
    rows = [
        dict(zip(("q", *"xyz"), (shop().joints[stop].tolist(), *pose[:3, 3]), strict=True))
        for stop, _, pose in shop().rows
    ]
    (tmp_path / "run.json").write_text(json.dumps(rows))
    said = ("--mount", "instrument", "--robot-model", "ur10e")
    visioncal("convert", tmp_path / "run.json", tmp_path / "out", *said).good()
    for view, (stop, _, pose) in zip(
        Session.load(tmp_path / "out").views, shop().rows, strict=True
    ):
        np.testing.assert_allclose(view.reading_m, pose[:3, 3], rtol=0, atol=1e-9)
        np.testing.assert_allclose(view.joints_rad, shop().joints[stop], rtol=0, atol=1e-9)


def test_arrays_by_columns_are_rows(tmp_path):
    """No row of joints is as long as the columns are many, and three joints are no point."""
    joints = np.random.default_rng(1).uniform(-1, 1, (3, 357))
    savemat(tmp_path / "Q.mat", {"Q": joints})
    np.testing.assert_array_equal(read_fields(tmp_path / "Q.mat").numbers["Q"], joints.T)
    refused = visioncal("convert", tmp_path / "Q.mat", tmp_path / "out", "--mount", "instrument")
    refused.refused("no columns of measured points are known", "it has Q (3)")


def test_joints_in_a_workbook_are_named_beside_points_of_a_probe(tmp_path):
    rows = [["X  [mm]", "Y  [mm]", "Z  [mm]", "U(95)  [mm]", *(f"Q{at} " for at in range(4))]]
    for _, _, pose in shop(poses=True).rows:
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rows.append(reads([], 0.004, w, x, y, z)(0, 0, pose))
    (tmp_path / "in").mkdir()
    (tmp_path / "in/Leica.csv").write_text(joined(rows))
    (tmp_path / "in/theta.xlsx").write_bytes(b"PK")
    refused = visioncal("convert", tmp_path / "in", tmp_path / "out", "--mount", "instrument")
    refused.refused("do not say where the arm stood, and theta.xlsx is a workbook", "as .csv")


def test_missing_columns_are_named_with_the_next_step(tmp_path):
    row = reads(["M{stop}"])
    points = joined([["Name", "Actual X", "Actual Y", "Actual Z"], *(row(*r) for r in shop().rows)])
    (tmp_path / "points.csv").write_text(points)
    refused = visioncal("convert", tmp_path / "points.csv", tmp_path / "out")
    refused.refused(
        "10 measured points, but neither joint angles nor poses", "Add columns J1 [deg]"
    )
    (tmp_path / "in").mkdir()
    (tmp_path / "in/points.csv").write_text(points.replace("M", "Messung "))
    (tmp_path / "in/arm.csv").write_text(joined(joints_table("x").splitlines()[:8]))
    fewer = visioncal("convert", tmp_path / "in", tmp_path / "out")
    fewer.refused("points of 10 stops, but arm.csv has 7 states", "Add a column `stop`")
    (tmp_path / "arm.csv").write_text(joints_table("x"))
    none = visioncal("convert", tmp_path / "arm.csv", tmp_path / "out", "--mount", "instrument")
    none.refused("no columns of measured points are known", "--camera-columns X,Y,Z")
    heads = ["Meas X", "Meas Y", "Meas Z", *(f"J{at}" for at in range(1, 7))]
    (tmp_path / "line.csv").write_text("Renishaw XL-80\n" + joined([heads, *[["1.5"] * 9] * 4]))
    visioncal("convert", tmp_path / "line.csv", tmp_path / "out").refused("XL-80 reads a length")
