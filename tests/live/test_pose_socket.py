"""The robot's own program over TCP: what it says, what breaks, and that each view has its pose."""

import contextlib
import random
import re
import select
import socket
import struct
import threading
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.commands import visioncal
from support.live_cell import fake_devices, fake_plan
from support.marks import slow
from support.refusals import raised

from visioncal.cli import live_cell
from visioncal.core.errors import DataError, DriverError
from visioncal.core.transforms import pose_difference
from visioncal.live.capture import devices
from visioncal.live.capture.devices import open_arm
from visioncal.live.capture.recording import ask_and_take, take_requested
from visioncal.live.capture.take import Missed
from visioncal.live.drivers import pose_socket
from visioncal.live.drivers.pose_socket import CLIENTS, SocketArm
from visioncal.live.drivers.protocols import RequestingArm
from visioncal.session import Session, View
from visioncal.session.columns import pose_row

COUNT = 4


def line_of(stop, more="\n"):
    """What a program says at a stop: no other stop is within 100 mm."""
    return f"{stop} | X {100 * stop}.25 Y -12.5 Z 800 A 10 B {stop} C 180{more}".encode()


def client_of(arm):
    return socket.create_connection(("127.0.0.1", arm.port))


class FakeCapture:
    """Keeps what would be recorded; `meanwhile` happens during the exposures of a view."""

    def __init__(self, meanwhile):
        self.journal = SimpleNamespace(views=[])
        self.coach = SimpleNamespace(advice=lambda: "")
        self.steps, self.meanwhile = [], meanwhile
        self.halting, self.until = contextlib.nullcontext, contextlib.suppress

    def next_numbers(self):
        """Numbers of the next view."""
        return len(self.journal.views) + 1, len(self.journal.views) + 1

    def view_at(self, state, number, *_):
        """Keeps a pose, as if an image were there."""
        if self.meanwhile(number):
            return SimpleNamespace(found=Missed("no board in the image"))
        numbers = pose_row(state.base_from_flange)
        self.journal.views.append(View(number, numbers=numbers))
        return SimpleNamespace(found=None)


class Robot:
    """A client, and what it does in the same thread as the server that is asked step by step."""

    def __init__(self, rng):
        self.rng, self.sent, self.link = rng, set(), None
        self.capture, self.arm = FakeCapture(self.meanwhile), SocketArm("127.0.0.1", 0)

    def meanwhile(self, stop):
        """What happens during a view; whether there is none."""
        chance = self.rng.random()
        if chance < 0.05:
            self.hang_up(hard=chance < 0.02)
        elif chance < 0.1 and self.link is not None:
            # A program that does not wait for its answer.
            with contextlib.suppress(OSError):
                self.link.sendall(line_of(stop + 1))
        return chance > 0.8

    def connect(self):
        """Opens a new link."""
        self.hang_up()
        self.link = client_of(self.arm)
        # Otherwise a second piece waits for the first one's receipt.
        self.link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def hang_up(self, *, hard=False):
        """Closes the link."""
        if self.link is not None:
            if hard:
                # A reset, as of a controller that lost its power.
                option = struct.pack("ii", 1, 0)
                self.link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, option)
            self.link.close()
        self.link = None

    def step(self):
        """The server looks once; its errors would be the test's."""
        take_requested(self.capture, self.arm, 0, 0.0)

    def say(self, data, *stops):
        """Sends, in pieces or at once; the server may close the link in between."""
        self.sent.update(stops)
        cut = self.rng.randrange(len(data))
        with contextlib.suppress(OSError):
            for piece in (data[:cut], data[cut:]) if self.rng.random() < 0.5 else (data,):
                if self.link is not None:
                    self.link.sendall(piece)
                self.step()

    def answer(self):
        """What came back; empty where the link was closed."""
        came = b""
        for _ in range(3):
            self.step()
        self.link.setblocking(False)
        with contextlib.suppress(OSError):
            while data := self.link.recv(1000):
                came += data
        self.link.setblocking(True)
        return came.decode("ascii")

    def say_stop(self, stop):
        """Sends a whole line, as a robot ends it."""
        self.say(line_of(stop, self.rng.choice(["\n", "\r\n", "\r", "\0\n"])), stop)

    def is_acknowledged(self, stop):
        """Whether a stop is, once it was tried, with mishaps before."""
        if self.rng.random() < 0.6:
            self.connect()
            self.rng.choice(MISHAPS)(self, stop)
            if self.rng.random() < 0.3:
                self.hang_up(hard=True)
            self.step()
        if self.link is None or self.rng.random() < 0.5:
            self.connect()
        self.say_stop(stop)
        answer = (self.answer() if self.link is not None else "").partition("\n")[0]
        assert answer.split(" ")[0] in ("next", "again", "error", "busy", "")
        if answer != "next":
            self.hang_up()
            self.step()
        return answer == "next"


def garbage(robot, _):
    robot.say(robot.rng.randbytes(robot.rng.randrange(1, 400)) + b"\n")
    assert not robot.answer().startswith(("next", "done"))


def another_client(robot, _):
    with client_of(robot.arm) as other:
        robot.step()
        robot.step()
        # The new one is refused, unless neither has said where it stands.
        assert robot.arm._link is None or select.select([other, robot.link], [], [], 0)[0]


def the_same_stop_elsewhere(robot, _):
    if robot.capture.journal.views:
        done = robot.capture.journal.views[-1].number
        robot.say(line_of(done).replace(b".25", b".95"))
        assert robot.answer().startswith("error stop")


def no_wait_for_the_answer(robot, stop):
    robot.sent.add(stop)
    robot.link.sendall(line_of(stop))
    robot.hang_up(hard=True)


def a_lost_answer(robot, stop):
    robot.say_stop(stop)
    robot.hang_up(hard=robot.rng.random() < 0.5)


def a_killed_server(robot, stop):
    robot.say_stop(stop)
    robot.arm.close()
    robot.arm = SocketArm("127.0.0.1", 0)


MISHAPS = (
    *(garbage, another_client, the_same_stop_elsewhere),
    *(no_wait_for_the_answer, a_lost_answer, a_killed_server),
    # Half a line (its digit alone would begin another number), one that does not end, one in
    # another encoding, and two stops at once, of which the arm waits at none unless in pieces.
    lambda robot, stop: robot.say(line_of(stop)[: robot.rng.randrange(2, len(line_of(stop)) - 1)]),
    lambda robot, _: robot.say(b"7" * robot.rng.randrange(600, 3000)),
    lambda robot, stop: robot.say(line_of(stop).replace(b"X", b"\xc4")),
    lambda robot, stop: robot.say(line_of(stop) + line_of(stop + 1), stop, stop + 1),
)


@pytest.mark.parametrize("first_seed", [0, *map(slow, range(100, 500, 100))])
def test_after_500_broken_conversations_each_view_has_its_pose(first_seed, monkeypatch):
    monkeypatch.setattr(pose_socket, "_SLICE_S", 0.0)
    for seed in range(first_seed, first_seed + 100):
        robot = Robot(random.Random(seed))
        views = robot.capture.journal.views
        # By a program that repeats what is not acknowledged.
        for stop in range(1, COUNT + 1):
            assert any(robot.is_acknowledged(stop) for _ in range(40)), seed
            # Acknowledged only once it is on the disk.
            assert stop in [view.number for view in views], seed
        robot.hang_up()
        robot.arm.close()
        numbers = [view.number for view in views]
        assert len(numbers) == len(set(numbers)), seed
        assert set(numbers) <= robot.sent, seed
        for view in views:
            x = view.base_from_flange().translation[0]
            assert abs(x - (0.1 * view.number + 0.25e-3)) < 1e-9, seed


@pytest.fixture
def arm():
    opened = open_arm("socket:0", None, moves=False)
    assert isinstance(opened, RequestingArm)
    yield opened
    opened.close()


def answer_to(arm, words):
    """The answer to one line of a new client."""
    with client_of(arm) as link:
        link.sendall(words)
        state = arm.request(0.0)
        if state is not None:
            arm.reply("next")
        return link.recv(300).decode("ascii"), state


POSE, JOINTS = b"p[0.4, 0, 0.3, 0, 3.1, 0]", b"0 -90 90 0 45 10,5"


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"1 | %s\n" % POSE, "next\n"),
        (b"20000 | [[400,-100,300],[0.5,-0.5,0.5,0.5]] | %s deg\r" % JOINTS, "next\n"),
        (b"1 | 400 0 300 0 180 0\n", "error the pose may be of ur, kuka, fanuc"),
        (b"1 | 512,34,-12,5,800,0\n", "error the pose: the commas of"),
        (b"1 | X 400 Y 0 Z 300\n", "error the pose: 'X 400 Y 0 Z 300' must be a pose"),
        (b"0 | %s\n" % POSE, "error '0 | p[0.4, 0, 0.3, 0' must be a stop"),
        (b"20001 | %s\n" % POSE, "error '20001 | p[0.4, 0, 0.' must be a stop"),
        (POSE + b"\n", "error 'p[0.4, 0, 0.3, 0, 3.' must be a stop"),
        (b"1\n", "error '1' must be a stop"),
        (b"1 | %s | %s\n" % (POSE, JOINTS), "error '0 -90 90 0 45 10,5' are no joint"),
        (b"1 | %s | %s rad\n" % (POSE, JOINTS), "error a joint angle of 90 rad"),
        (b"1 | \xc4 400 Y 0 Z 300\n", "error the line must be text in ASCII or UTF-8"),
        (b"1 | %s\n2 | %s\n" % (POSE, POSE), "error more than one line before its answer"),
        (b"7" * 501, "error a line of more than 500 bytes"),
    ],
)
def test_a_line_is_understood_or_its_programmer_learns_why(arm, line, answer):
    got, state = answer_to(arm, line)
    assert got.startswith(answer), got
    assert got.endswith("\n")
    assert (state is not None) == (answer == "next\n")


def test_joints_are_sent_at_all_stops_or_at_none(arm):
    _, state = answer_to(arm, line_of(1, " | 0 -90 90 0 45 10.5 deg\n"))
    assert np.allclose(np.rad2deg(state.q), [0, -90, 90, 0, 45, 10.5])
    assert state.stop == 1
    assert answer_to(arm, line_of(2))[0].startswith("error 0 joints, and 6")


def test_the_last_view_is_answered_done_even_where_that_answer_is_lost(arm):
    first, answers = client_of(arm), []
    first.sendall(line_of(1))

    def again():
        with client_of(arm) as link:
            link.sendall(line_of(1))
            answers.append(link.recv(100))

    robot = threading.Thread(target=again)
    capture = FakeCapture(lambda _: first.close() or robot.start())
    ask_and_take(capture, arm, 1)
    robot.join(5.0)
    assert answers == [b"done\n"]
    assert len(capture.journal.views) == 1


def test_a_program_ends_the_recording_and_learns_that_it_ended(arm):
    link = client_of(arm)
    link.sendall(b"end\n")
    # It hangs up once it has its answer.
    threading.Thread(target=lambda: (link.recv(100), link.close())).start()
    with pytest.raises(EOFError):
        arm.request(5.0)
    idle = open_arm("socket:0", None, moves=False)
    with client_of(idle) as link:
        idle.request(0.0)
        idle.close()
        assert link.recv(10) == b""


def test_a_robot_that_does_not_come_back_ends_the_recording():
    arm = SocketArm("127.0.0.1", 0, patience_s=0.05)
    answer_to(arm, b"hello\n")
    raised(DriverError, "no stop .* was last refused: 'hello' must be a stop", arm.request, 5.0)
    raised(DriverError, "cannot be opened for", SocketArm, "127.0.0.1", arm.port)
    arm.close()
    for words in ("socket:", "socket:127.0.0.1", "socket:70000"):
        raised(DataError, "needs a port", open_arm, words, None, form=None, moves=False)


def test_silent_and_garbled_clients_take_no_robots_place(arm):
    with contextlib.ExitStack() as stack:
        silent, half, garbage, robot = (stack.enter_context(client_of(arm)) for _ in range(4))
        half.sendall(b"1 | X 4")
        garbage.sendall(b"GET / HTTP/1.1\r\n")
        while arm._link is None or len(arm._waiting) < 2:
            assert arm.request(0.0) is None
            if select.select([garbage], [], [], 0)[0]:
                break
        assert garbage.recv(300).startswith(b"error 'GET / HTTP/1.1'")
        assert garbage.recv(300) == b""
        robot.sendall(line_of(1))
        state = None
        while state is None:
            state = arm.request(0.0)
        arm.reply("next")
        assert (state.stop, robot.recv(99)) == (1, b"next\n")
        # In its session it is protected from all others.
        for other in (silent, half):
            assert other.recv(99).startswith(b"busy ")
        with client_of(arm) as second:
            second.sendall(line_of(2))
            assert arm.request(0.0) is None
            assert second.recv(99).startswith(b"busy ")
        robot.sendall(line_of(2))
        assert arm.request(1.0).stop == 2


def test_a_flood_of_silent_clients_leaves_the_robot_its_place(arm):
    with contextlib.ExitStack() as stack:
        for _ in range(40):
            stack.enter_context(client_of(arm))
            arm.request(0.0)
        assert len(arm._waiting) <= pose_socket._MOST_WAITING
        got, state = answer_to(arm, line_of(1))
        assert (got, state.stop) == ("next\n", 1)


def test_the_terminal_says_who_can_send_poses(arm):
    assert arm.host == "127.0.0.1"
    assert "Programs of this computer alone can send poses" in arm.invitation
    shared = SocketArm("0.0.0.0", 0)
    assert "All computers that reach this one can send poses" in shared.invitation
    shared.close()


def test_a_peer_that_is_dead_or_reads_nothing_is_given_up_within_seconds(arm):
    with socket.socket() as link:
        link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.connect(("127.0.0.1", arm.port))
        link.sendall(line_of(1))
        assert arm.request(1.0).stop == 1
        served = arm._link.peer
        names = ("TCP_KEEPIDLE", "TCP_KEEPINTVL", "TCP_KEEPCNT", "TCP_USER_TIMEOUT")
        idle_s, interval_s, probes, confirmed_ms = (
            served.getsockopt(socket.IPPROTO_TCP, getattr(socket, name)) for name in names
        )
        assert served.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert idle_s + interval_s * probes <= 5
        assert confirmed_ms <= 5000
        # One that reads nothing is not waited for.
        served.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
        for _ in range(1000):
            if served.fileno() == -1:
                break
            link.sendall(b"x\n")
            arm.request(0.0)
    assert served.fileno() == -1


# Numbers that a client's own expressions mean, by their names without prefixes.
def _named(stop, pose):
    turned = Rotation.from_matrix(pose[:3, :3])
    angles = [turned.as_euler(axes, degrees=True) for axes in ("ZYX", "xyz")]
    numbers = [*1e3 * pose[:3, 3], *angles[0], *angles[1], *turned.as_quat(canonical=True)]
    names = ("x", "y", "z", "a", "b", "c", "w", "p", "r", "q2", "q3", "q4", "q1")
    return {"number": stop, **dict(zip(names, numbers, strict=True))}


def said_by_krl(text, values):
    """The line that SWRITE builds, by its formats."""
    swrites = re.findall(r'SWRITE\(\w+\[\], \w+, \w+, "([^"]*\|?[^"]*%[^"]*)", ([^)]*)\)', text)
    line = "".join(
        form % tuple(values[name.lower().rpartition(".")[2].strip()] for name in names.split(","))
        for form, names in swrites
    )
    root = ElementTree.parse(CLIENTS / "visioncal.xml").getroot()
    (element,) = root.iter("ELEMENT")
    # What the program reads by, and the end of a line.
    assert f'"{element.get("Tag")}"' in text
    assert f"$FLAG[{element.get('Set_Flag')}]" in text
    assert f"$FLAG[{root.find('CONFIGURATION/INTERNAL/ALIVE').get('Set_Flag')}]" in text
    end = int(re.search(r"LINE\[LENGTH \+ 1\] = (\d+)", text)[1])
    assert element.get("EOS") == str(end)
    return [line + chr(end)]


def said_by_rapid(text, values):
    """Strings that SocketSend sends, none of which may be longer than RAPID's."""

    def piece(word):
        number = re.fullmatch(r"NumToStr\(([\w.]+),(\d)\)", word)
        if number is None:
            return word.strip('"').replace("\\0A", "\n")
        return f"{values[number[1].rpartition('.')[2]]:.{number[2]}f}"

    sent = re.findall(r"SocketSend \w+ \\Str:=(NumToStr.*);", text)
    return ["".join(map(piece, words.split(" + "))) for words in sent]


def said_by_karel(text, values):
    """What WRITE sends, each number in its field."""

    def piece(word):
        if word.startswith("'"):
            return word.strip("'")
        if word == "CHR(10)":
            return "\n"
        name, width, *digits = word.split("::")
        value = values[name.rpartition(".")[2]]
        return f"{value:{width}.{digits[0]}f}" if digits else f"{value:{width}d}"

    sent = re.findall(r"WRITE vc_link\((.*(?:number|here).*)\)", text)
    return ["".join(map(piece, words.split(", "))) for words in sent]


@pytest.fixture
def cell(monkeypatch):
    """A plan, and the arm that stands at its stops before a camera."""
    plan = fake_plan(12)
    body, camera = fake_devices(plan)
    monkeypatch.setattr(devices, "CAMERAS", {"fake": lambda *_: camera})
    monkeypatch.setattr(live_cell, "HostClock", lambda: body.clock)
    return plan, body


def _recorded(cell, pieces, session, count, *options):
    """A recording of a plan's first stops, and the answers that a program got at each."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port, answers = free.getsockname()[1], []
    plan, body = cell

    def drive():
        link = None
        while link is None:
            with contextlib.suppress(ConnectionRefusedError):
                link = socket.create_connection(("127.0.0.1", port))
        with link:
            for stop in plan.stops[:count]:
                # It drives itself, and stands before it says so.
                body.q0, body.motion = stop.q, None
                for piece in pieces(stop.view, body.true_flange(body.clock.now())):
                    link.sendall(piece.encode("ascii"))
                answers.append(link.recv(200).decode("ascii"))

    robot = threading.Thread(target=drive, daemon=True)
    robot.start()
    named = ("--arm", f"socket:{port}", "--camera", "fake", "--target", "charuco_9x6_30mm")
    quick = ("--frames", 1, "--settle-s", 0.03, "--views", count)
    done = visioncal("record", "-o", session, *named, *quick, *options).good()
    robot.join(5.0)
    assert answers == ["next\n"] * (count - 1) + ["done\n"]
    return done


@pytest.mark.parametrize(
    ("program", "say", "longest"),
    [
        ("visioncal.src", said_by_krl, 200),
        ("visioncal.mod", said_by_rapid, 80),
        ("visioncal.kl", said_by_karel, 254),
    ],
)
def test_a_robot_program_of_each_maker_records_a_good_session(
    program, say, longest, cell, tmp_path
):
    text = (CLIENTS / program).read_text(encoding="ascii")

    def pieces(stop, pose):
        sent = say(text, _named(stop, pose))
        assert max(map(len, sent)) <= longest
        return sent

    # The same poses are the same session, whoever sent them: one is calibrated.
    session, plan, count = tmp_path / "live", cell[0], 12 if say is said_by_krl else 3
    assert str(CLIENTS) in _recorded(cell, pieces, session, count).err
    for view, stop in zip(Session.load(session).views, plan.stops[:count], strict=True):
        shift, turn = pose_difference(
            np.asarray(view.base_from_flange().as_matrix()),
            plan.cell.robot.base_from_flange(stop.q[None])[0],
        )
        # Micrometres and ten-thousandths of a degree are what the programs send.
        assert shift < 1e-3
        assert turn < 2e-4
    if say is said_by_krl:
        found = visioncal("calibrate", session, "-o", tmp_path / "out").good()
        assert "good" in found.said.splitlines()[0]


def test_a_resumed_recording_takes_no_stop_twice(cell, tmp_path):
    def pieces(stop, pose):
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_rotvec()]
        return [f"{stop} | p[{', '.join(f'{number:.6f}' for number in numbers)}]\n"]

    session = tmp_path / "live"
    _recorded(cell, pieces, session, 2)
    before = (session / "views.csv").read_bytes()
    # At another port, and from its first stop on.
    _recorded(cell, pieces, session, 3, "--resume")
    assert (session / "views.csv").read_bytes().startswith(before)
    assert [view.number for view in Session.load(session).views] == [1, 2, 3]
