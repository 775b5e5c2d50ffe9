"""Reads what `visioncal export` writes, as others would: without visioncal and without ROS.

Rotations are built from elementary matrices by hand, so that a wrong order of angles cannot hide
by being wrong twice. Every reader takes a document and returns a (4, 4) transform in metres.
"""

import ast
import json
import re
import xml.etree.ElementTree as ET

import cv2
import numpy as np
import yaml

NUMBER = r"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?"


def rx(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def ry(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def rz(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def of_quaternion(x, y, z, w):
    """The rotation v -> q v q* of a unit quaternion."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def of_rotation_vector(x, y, z):
    """Rodrigues' formula."""
    angle = np.sqrt(x * x + y * y + z * z)
    if angle == 0.0:
        return np.eye(3)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) / angle
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def transform(rotation, position):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return matrix


def code(text, mark):
    """The lines that are no comments."""
    return "\n".join(line for line in text.splitlines() if not mark or not line.startswith(mark))


def message(fields):
    t, q = fields["translation"], fields["rotation"]
    assert all(isinstance(value, float) for value in (*t.values(), *q.values()))
    return transform(
        of_quaternion(q["x"], q["y"], q["z"], q["w"]), np.array([t["x"], t["y"], t["z"]])
    )


def ros(text):
    return message(yaml.safe_load(text)["transform"])


def easy_handeye(text):
    found = yaml.safe_load(text)["transformation"]
    place = {name: found[name] for name in "xyz"}
    turn = {name: found[f"q{name}"] for name in "xyzw"}
    return message({"translation": place, "rotation": turn})


def launch_arguments(text):
    """The options that a launch file passes on, from its syntax tree."""
    compile(text, "calibration.launch.py", "exec")
    tree = ast.parse(text)
    calls = [
        item
        for item in ast.walk(tree)
        if isinstance(item, ast.Call) and isinstance(item.func, ast.Name) and item.func.id == "Node"
    ]
    assert len(calls) == 1
    fields = {keyword.arg: ast.literal_eval(keyword.value) for keyword in calls[0].keywords}
    assert fields["package"] == "tf2_ros"
    assert fields["executable"] == "static_transform_publisher"
    words = fields["arguments"]
    return dict(zip(words[::2], words[1::2], strict=True))


def launch(text):
    options = launch_arguments(text)
    x, y, z, *q = (float(options[f"--{name}"]) for name in ("x", "y", "z", "qx", "qy", "qz", "qw"))
    return transform(of_quaternion(*q), [x, y, z])


def urdf(text):
    origin = ET.fromstring(text).find("joint/origin")
    roll, pitch, yaw = map(float, origin.get("rpy").split())
    return transform(
        rz(yaw) @ ry(pitch) @ rx(roll), [float(part) for part in origin.get("xyz").split()]
    )


def opencv(text):
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    matrix = storage.getNode("transform").mat()
    assert np.array_equal(
        matrix[:3], np.hstack([storage.getNode("R").mat(), storage.getNode("t").mat()])
    )
    return matrix


def zivid(text):
    document = yaml.safe_load(text)
    assert document["__version__"] == {"serializer": 1, "data": 1}
    matrix_mm = np.array(document["FloatMatrix"]["Data"])
    return transform(matrix_mm[:3, :3], matrix_mm[:3, 3] / 1000)


def halcon(text):
    """A pose of write_pose with code 0: R = Rx Ry Rz of angles in degrees, metres."""
    lines = (line.split() for line in code(text, "#").splitlines() if line.strip())
    words = {name: [float(word) for word in rest] for name, *rest in lines}
    assert words.keys() == {*"frt"}
    assert words["f"] == [0]
    x, y, z = np.radians(words["r"])
    return transform(rx(x) @ ry(y) @ rz(z), words["t"])


def halcon_camera(text):
    """Numbers of a file of write_cam_par by name: an entry is `Name:short: value;` and its type."""
    assert 'ParGroup: Camera: Parameter;\n  "' in text
    found = re.findall(r"^(\w+):\w+: *(\S+);\n +(?:DOUBLE|INT):", code(text, "#"), re.MULTILINE)
    return {name: float(value) for name, value in found}


def plain(text):
    return np.loadtxt(text.splitlines())


def _numbers(text, pattern):
    """The numbers of a document, which must have the shape of `pattern`; # stands for a number."""
    wanted = re.escape(pattern).replace(r"\#", f"({NUMBER})")
    found = re.fullmatch(wanted, text.strip())
    assert found, text
    assert "e" not in "".join(found.groups())
    return [float(group) for group in found.groups()]


def ur(text):
    numbers = _numbers(code(text, "#"), "p[#, #, #, #, #, #]")
    return transform(of_rotation_vector(*numbers[3:]), numbers[:3])


def _angled(text, mark, pattern, rotation):
    numbers = _numbers(code(text, mark), pattern)
    return transform(rotation(*np.radians(numbers[3:])), np.array(numbers[:3]) / 1000)


def kuka(text):
    pattern = "{X #,Y #,Z #,A #,B #,C #}"
    return _angled(text, ";", pattern, lambda a, b, c: rz(a) @ ry(b) @ rx(c))


def fanuc(text):
    pattern = "X = # mm, Y = # mm, Z = # mm,\nW = # deg, P = # deg, R = # deg"
    return _angled(text, "", pattern, lambda w, p, r: rz(r) @ ry(p) @ rx(w))


def yaskawa(text):
    return _angled(text, "", "#,#,#,#,#,#", lambda x, y, z: rz(z) @ ry(y) @ rx(x))


def staubli(text):
    pattern = "{#, #, #, #, #, #}"
    return _angled(text, "//", pattern, lambda x, y, z: rx(x) @ ry(y) @ rz(z))


def doosan(text):
    pattern = "posx(#, #, #, #, #, #)"
    return _angled(text, "#", pattern, lambda a, b, c: rz(a) @ ry(b) @ rz(c))


def numbers_of(rotation, scale=1000, degrees=True):
    """Reads x, y, z and three angles with commas between."""

    def read(text):
        x, y, z, *angles = _numbers(text.strip(), "#,#,#,#,#,#")
        turn = rotation(*(np.radians(angles) if degrees else angles))
        return transform(turn, np.array([x, y, z]) / scale)

    return read


def abb(text):
    x, y, z, q1, q2, q3, q4 = _numbers(code(text, "!"), "[[#,#,#],[#,#,#,#]]")
    return transform(of_quaternion(q2, q3, q4, q1), np.array([x, y, z]) / 1000)


def urscript_pose(text):
    """A pose of URScript, whose numbers may be without their zero, as .2 and 0. are."""
    found = re.fullmatch(r"\s*p\[([-\d.,\s]*)\]\s*", text)
    assert found, text
    x, y, z, *rotation = (float(part) for part in found[1].split(","))
    return transform(of_rotation_vector(*rotation), [x, y, z])


def ur_tcp(text):
    found = re.fullmatch(r"set_tcp\((.*)\)", code(text, "#").strip())
    assert found, text
    return urscript_pose(found[1])


def ur_feature(text):
    found = re.fullmatch(r"global ([A-Za-z_]\w*) = (.*)", code(text, "#").strip(), re.ASCII)
    assert found, text
    return urscript_pose(found[2])


def rapid(text):
    """The first declaration of persistent data in a module: its type, its name and its value.

    RAPID's aggregates are JSON's lists but for TRUE and FALSE and a number's missing zero.
    """
    found = re.search(r"^\s*(?:TASK )?PERS (\w+) (\w+)\s*:=(.*?);", code(text, "!"), re.M | re.S)
    assert found, text
    kind, name, value = found.groups()
    return kind, name, json.loads(value.replace("TRUE", "true").replace("FALSE", "false"))


def rapid_pose(value):
    position, (q1, q2, q3, q4) = value
    return transform(of_quaternion(q2, q3, q4, q1), np.array(position) / 1000)


def abb_tooldata(text):
    kind, _, (held, pose, load) = rapid(text)
    mass, centre, axes, *inertia = load
    assert (kind, held, len(centre), axes, inertia) == ("tooldata", True, 3, [1, 0, 0, 0], [0] * 3)
    assert mass == -1 or mass > 0
    return rapid_pose(pose)


def abb_wobjdata(text):
    """Where the object's frame is in the world: both frames of a work object one after another."""
    kind, _, (held, fixed, unit, user, object_) = rapid(text)
    assert (kind, held, fixed, unit) == ("wobjdata", False, True, "")
    return rapid_pose(user) @ rapid_pose(object_)


def kuka_named(text):
    """What is set, and the pose it is set to."""
    name, _, value = code(text, ";").strip().partition("=")
    x, y, z, a, b, c = (float(part[1:]) for part in value.strip().strip("{}").split(","))
    assert re.sub(rf"{NUMBER}", "", value).replace(" ", "") == "{X,Y,Z,A,B,C}"
    angles = np.radians([a, b, c])
    rotation = rz(angles[0]) @ ry(angles[1]) @ rx(angles[2])
    return name.strip(), transform(rotation, np.array([x, y, z]) / 1000)


def kuka_frame(kind):
    """Reads the active tool or base, or one of their numbered data."""

    def read(text):
        name, pose = kuka_named(text)
        assert re.fullmatch(rf"\${kind}|{kind}_DATA\[\d+\]", name)
        return pose

    return read


def mujoco(text):
    """The camera's or the second site's place on the body; a camera of MuJoCo looks along -z."""
    *_, element = ET.fromstring(text).find("worldbody/body")
    w, *vector = map(float, element.get("quat").split())
    turned = np.diag([1.0, -1.0, -1.0]) if element.tag == "camera" else np.eye(3)
    position = [float(word) for word in element.get("pos").split()]
    return transform(of_quaternion(*vector, w) @ turned, position)


def fanuc_program(text):
    """Frames that a program of a teach pendant sets: from a position to a register to a frame."""
    body, _, rest = text.replace("\r\n", "\n").partition("/POS\n")
    listing = body.partition("/MN\n")[2]
    lines = re.findall(r"^ *\d+:  (.*?) *;$", listing, re.M)
    assert len(lines) == len(listing.splitlines()) == int(re.search(r"COUNT\s*= (\d+)", body)[1])
    positions, registers, frames = {}, {}, {}
    for number, fields in re.findall(r"^P\[(\d+)\]\{\n(.*?)^\};", rest, re.M | re.S):
        found = re.findall(r"([XYZWPR]) = *([-.\d]+) +(mm|deg)", fields)
        assert "".join(name + unit for name, _, unit in found) == "XmmYmmZmmWdegPdegRdeg"
        values = [float(value) for _, value, _ in found]
        w, p, r = np.radians(values[3:])
        turn = rz(r) @ ry(p) @ rx(w)
        positions[f"P[{number}]"] = transform(turn, np.array(values[:3]) / 1000)
    for to, _, value in (line.partition("=") for line in lines if not line.startswith("!")):
        if to.startswith("PR["):
            registers[to] = positions[value]
        else:
            frames[to] = registers[value]
    assert rest.splitlines()[-1] == "/END"
    return frames


def fanuc_frame(kind):
    """Reads the only frame that a program sets."""

    def read(text):
        ((name, pose),) = fanuc_program(text).items()
        assert re.fullmatch(rf"{kind}\[\d+\]", name)
        return pose

    return read


# By the format's name: every format that holds a tool, and every one that holds a fixture.
TOOL_READERS = {"ur-tcp": ur_tcp, "abb-tooldata": abb_tooldata, "kuka-tool": kuka_frame("TOOL")}
TOOL_READERS |= {"fanuc-utool": fanuc_frame("UTOOL")}
FIXTURE_READERS = {
    "ur-feature": ur_feature,
    "abb-wobjdata": abb_wobjdata,
    "kuka-base": kuka_frame("BASE"),
    "fanuc-uframe": fanuc_frame("UFRAME"),
}

# Those of an arm, which test_cell_exports.py reads.
ARM_FORMATS = ("robot-urdf", "robot-dh", "ur-kinematics", "robot-json")

# By the format's name: every format that holds any transform.
READERS = {
    "ros": ros,
    "ros-launch": launch,
    "moveit": launch,
    "easy-handeye": easy_handeye,
    "easy-handeye2": ros,
    "urdf": urdf,
    "opencv": opencv,
    "zivid": zivid,
    "halcon": halcon,
    "text": plain,
    "mujoco": mujoco,
    "ur": ur,
    "kuka": kuka,
    "fanuc": fanuc,
    "abb": abb,
    "staubli": staubli,
    "yaskawa": yaskawa,
    "doosan": doosan,
    "xarm": numbers_of(lambda r, p, y: rz(y) @ ry(p) @ rx(r)),
    "mecademic": numbers_of(lambda a, b, c: rx(a) @ ry(b) @ rz(c)),
    "kawasaki": numbers_of(lambda o, a, t: rz(o) @ ry(a) @ rz(t)),
    "comau": numbers_of(lambda a, e, r: rz(a) @ ry(e) @ rz(r)),
    "realman": numbers_of(lambda x, y, z: rz(z) @ ry(y) @ rx(x), 1, degrees=False),
    "techman": numbers_of(lambda x, y, z: rz(z) @ ry(y) @ rx(x)),
    "epson": numbers_of(lambda u, v, w: rz(u) @ ry(v) @ rx(w)),
}
