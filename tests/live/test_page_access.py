"""Who may ask the page for what: hostile names, other sites, other machines, broken requests."""

import ast
import json
import re
import shutil
import socket
import struct
import urllib.request
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.browser import CHROMIUM
from support.commands import visioncal as command
from support.page import PATIENT_MS, choose, opened, served

from visioncal import Session

pytest.importorskip("nicegui")
sync_api = pytest.importorskip("playwright.sync_api")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs a browser")
PAGE = Path(__file__).parents[2] / "visioncal" / "live" / "page"
TARGETS = PAGE.parents[2] / "targets"
FIELDS = (
    *("Where the camera is", "Its poses: typed, or by address", "The pendant's form of poses"),
    *("Robot's model, where it is known", "Board (a name, or its .toml)"),
)
# Each would run as an attribute, an element, a template of Vue, a template of JavaScript, a string.
HOSTILE = (
    'x" :label="(()=>{alert(1);return 1})()',
    "x' :hint='(()=>{alert(2);return 1})()",
    "<img src=x onerror=alert(3)>",
    "{{constructor.constructor('alert(4)')()}}",
    "`${alert(5)}`",
    "');alert(6);('",
    "<svg onload=alert(7)>&lt;script&gt;",
    "![x](http://127.0.0.1:9) [y](javascript:alert(8))".replace("/", "\N{FRACTION SLASH}"),
)


@pytest.fixture(scope="module")
def cell(tmp_path_factory) -> Path:
    """A session with pictures, and its result."""
    folder = tmp_path_factory.mktemp("access")
    command("simulate", folder / "seen", "--views", 8, "--with-intrinsics", "--seed", 4)
    command("calibrate", folder / "seen", "-o", folder / "result")
    return folder


@pytest.mark.parametrize("names", [HOSTILE[:1], HOSTILE], ids=["one", "all"])
def test_no_name_of_a_check_runs_in_the_browser(names, cell, tmp_path, browser):
    results, checks = tmp_path / "results", tmp_path / HOSTILE[0]
    for name in names:
        shutil.copytree(cell / "result", results / name)
        verified = checks / f"{name}-verified"
        verified.mkdir(parents=True)
        said = {"passed": False, "sentences": [f"said {name}"]}
        (verified / "verify.json").write_text(json.dumps(said))
    # One of other types is passed over.
    (checks / "other-verified").mkdir()
    (checks / "other-verified/verify.json").write_text('{"passed": true, "sentences": null}')
    with served("verify", checks, "--against", results) as (url, _), opened(browser, url) as page:
        page.get_by_text(f"Check {checks.name}").wait_for()
        for name in names:
            page.get_by_text(f"{name}: said {name}").wait_for()
        hint = page.get_by_text(", ".join(str(results / name) for name in sorted(names)))
        page.get_by_label("Cell", exact=True).focus()
        hint.wait_for()
        page.get_by_role("button", name="Start").click()
        page.get_by_role("alert").get_by_text("camera").first.wait_for()
        for name in names:
            for label in ("Cell", "Camera", "The pendant's form of poses"):
                choose(page, label, name)
            page.get_by_role("button", name="Start").click()
            page.get_by_role("alert").get_by_text(name[:20]).first.wait_for()


def test_no_name_of_a_recording_runs_in_the_browser(cell, tmp_path, browser):
    pictures, views = tmp_path / HOSTILE[2], Session.load(cell / "seen").views
    pictures.mkdir()
    for number, view in enumerate(views):
        shutil.copy(cell / "seen" / view.image, pictures / f"{number}{HOSTILE[number]}.png")
    board = tmp_path / f"{HOSTILE[0]}.toml"
    shutil.copy(TARGETS / "charuco_9x6_30mm.toml", board)
    recording = served("record", "-o", tmp_path / HOSTILE[6])
    with recording as (url, _), opened(browser, url) as page:
        page.get_by_text(f"Record {HOSTILE[6]}").wait_for()
        for name in HOSTILE:
            for label in (*FIELDS, "Camera"):
                choose(page, label, name)
            page.get_by_role("button", name="Start").click()
            page.get_by_role("alert").get_by_text(name[:20]).first.wait_for()
        for label, words in zip(FIELDS, ("eye-in-hand", "manual", "", "", str(board)), strict=True):
            choose(page, label, words)
        choose(page, "Camera", f"folder:{pictures}")
        page.get_by_role("button", name="Start").click()
        field = page.get_by_label("Pose of the flange")
        for name in HOSTILE:
            field.fill(name)
            page.get_by_text(name[:20]).first.wait_for()
        for place, view in enumerate(views, 1):
            matrix = np.asarray(view.base_from_flange().as_matrix())
            angles = Rotation.from_matrix(matrix[:3, :3]).as_euler("ZYX", degrees=True)
            numbers = zip("XYZABC", [*(1e3 * matrix[:3, 3]), *angles], strict=True)
            field.fill(" ".join(f"{name} {value:.5f}" for name, value in numbers))
            page.get_by_text("Read as KUKA").wait_for()
            field.press("Enter")
            page.get_by_role("row", name=f"view {place}", exact=True).wait_for()
            # Its field is cleared for the next pose.
            sync_api.expect(field).to_have_value("", timeout=PATIENT_MS)
        page.get_by_role("button", name="Calibrate").click()
        page.get_by_text(f"{HOSTILE[6]}-result").wait_for()
        with page.expect_popup() as report:
            page.get_by_role("link", name="Open the report").click()
        report.value.get_by_text(HOSTILE[6]).first.wait_for()


def faults_in(code: str):
    """Places of a module of the page where a text could become code."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            words = [*node.args, *(word.value for word in node.keywords)]
            is_constant = all(isinstance(word, ast.Constant) for word in words)
            # What these get is parsed, or run.
            if name in {"props", "add_slot", "run_javascript"} and not is_constant:
                yield ast.unparse(node)
            if name in {"markdown", "add_head_html", "add_body_html", "add_css", "Html"}:
                yield ast.unparse(node)
            given = {word.arg: word.value for word in node.keywords}
            handler = given.get("js_handler", ast.Constant(""))
            if "sanitize" in given or not isinstance(handler, ast.Constant):
                yield ast.unparse(node)
        # A name with a colon in front would have its value run.
        if isinstance(node, ast.Subscript) and ast.unparse(node.value).endswith("props"):
            key = node.slice.value if isinstance(node.slice, ast.Constant) else ":"
            if key.startswith(":"):
                yield ast.unparse(node)
        if isinstance(node, ast.Constant) and "v-html" in str(node.value):
            yield ast.unparse(node)


def test_no_text_becomes_code_of_the_page():
    for path in PAGE.glob("*.py"):
        assert not [*faults_in(path.read_text("utf-8"))], path


@pytest.mark.parametrize(
    "code",
    [
        "field.props(f'hint={words}')",
        "field.props('hint=' + words)",
        "field.props(add=words)",
        "ui.html(words, sanitize=False)",
        "ui.markdown(words)",
        "table.add_slot('body', words)",
        "ui.run_javascript(words)",
        "field.on('click', js_handler=words)",
        "field.props[words] = 1",
        "field._props[':label'] = words",
        "table.add_slot('body', '<td v-html=props.value>')",
    ],
)
def test_the_search_for_unsafe_code_can_fail(code):
    assert len([*faults_in(code)]) == 1


def answered(url: str, request: bytes) -> int:
    """The status of the answer to what is sent as it is; 0 for none."""
    host, _, port = url.split("/")[2].rpartition(":")
    with socket.create_connection((host, int(port)), timeout=10.0) as link:
        link.sendall(request)
        answer = link.recv(15)
    return int(answer.split()[1]) if answer else 0


def request_of(url: str, path: str = "/live.jpg", **headers: str) -> bytes:
    lines = {
        "Host": url.split("/")[2],
        **{name.replace("_", "-"): headers[name] for name in headers},
    }
    head = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
    return f"GET {path} HTTP/1.1\r\n{head}\r\n".encode()


SHAKE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
}
SOCKET = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """The page for this machine alone."""
    with served("record", "-o", tmp_path_factory.mktemp("local") / "cell") as (url, process):
        yield url, process


@pytest.mark.parametrize(
    ("status", "headers"),
    [
        (200, {}),
        (200, {"Host": "LOCALHOST.:1", "Origin": "http://LOCALHOST.:1"}),
        (200, {"Host": "[::1]"}),
        (200, {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "navigate"}),
        (403, {"Sec_Fetch_Site": "cross-site", "Sec_Fetch_Mode": "no-cors"}),
        (403, {"Origin": "http://elsewhere.example"}),
        (403, {"Origin": "null"}),
        (403, {"Origin": "http://["}),
        (403, {"Host": "elsewhere.example"}),
        (403, {"Host": "192.0.2.7"}),
        (403, {"Host": "localhost.elsewhere.example"}),
        (400, {"Host": "["}),
        (400, {"Host": "localhost@elsewhere.example"}),
        (400, {"Host": "localhost/elsewhere"}),
        (400, {"Host": "localhost:99999999"}),
        (400, {"Host": ""}),
        (403, {**SHAKE, "Origin": "http://elsewhere.example"}),
        (403, {**SHAKE}),
    ],
    ids=str,
)
def test_other_sites_are_refused(status, headers, local):
    url = local[0]
    assert (
        answered(url, request_of(url, SOCKET if "Upgrade" in headers else "/live.jpg", **headers))
        == status
    )


def test_no_header_ends_in_a_traceback(local):
    url, process = local
    hostile = ("[", "http://[", "\xff\x80", "%00%ff", '=;=;"', "a" * 9000, "-1", "99e99", "\t", "")
    names = (
        *("Host", "Origin", "Cookie", "Accept", "Accept-Encoding", "Accept-Language", "Range"),
        *("If-None-Match", "If-Modified-Since", "If-Range", "X-Forwarded-For", "X-Forwarded-Host"),
        *("X-Forwarded-Proto", "X-Forwarded-Prefix", "Content-Length", "Content-Type", "Expect"),
        *("Transfer-Encoding", "Connection", "Upgrade", "Sec-WebSocket-Version", "Referer"),
        *("Sec-WebSocket-Key", "Sec-WebSocket-Extensions", "Sec-WebSocket-Protocol", "Via"),
        *("Sec-Fetch-Site", "Sec-Fetch-Mode", "Sec-Purpose", "NiceGUI-Check", "User-Agent"),
    )
    with urllib.request.urlopen(url) as answer:
        page = answer.read().decode()
    script = re.search(r'src="(/_nicegui/[^"]+)"', page)[1]
    for name in names:
        for value in hostile:
            for path, more in (("/", {}), (script, {}), (SOCKET, {**SHAKE, "Origin": url})):
                headers = {**more, name.replace("-", "_"): value}
                request = request_of(url, path, **headers).decode().encode("latin-1")
                assert answered(url, request) in (0, *range(100, 500)), headers
    for line in (
        "GET",
        "GET / HTTP/9",
        "\0\0",
        "GET /\xff\0 HTTP/1.1",
        "GET http://[ HTTP/1.1",
        "GET //[ HTTP/1.1",
    ):
        assert answered(url, f"{line}\r\n\r\n".encode("latin-1")) < 500
    twice = request_of(url).replace(b"\r\n\r\n", b"\r\nHost: elsewhere.example\r\n\r\n")
    assert answered(url, twice) == 400
    assert "Traceback" not in process.said()
    assert answered(url, request_of(url)) == 200


def test_no_message_of_a_browser_ends_in_a_traceback(local, browser):
    url, process = local
    with opened(browser, url) as page:
        client = page.evaluate("window.clientId")
        events = (
            "event",
            "handshake",
            "javascript_response",
            "ack",
            "log",
            "too_large_message",
            "x",
        )
        contents = (
            None,
            [],
            {},
            {"client_id": client},
            {"client_id": []},
            {"client_id": client}
            | {
                name: value
                for name in (
                    "id",
                    "listener_id",
                    "args",
                    "request_id",
                    "result",
                    "next_message_id",
                    "level",
                    "message",
                    "tab_id",
                    "document_id",
                    "msg",
                    "error",
                )
                for value in ({"a": [None]},)
            },
        )
        hostile = [f"42{json.dumps([event, content])}" for event in events for content in contents]
        hostile += [f"42{json.dumps([event])}" for event in events]
        hostile += [
            "",
            "4",
            "42",
            "42[",
            "42{}",
            "4" + "2" + "[" * 5000,
            "43[]",
            "43",
            "44",
            "45",
            "47",
        ]
        hostile += [
            "451-[]",
            '451-["event",{"_placeholder":true,"num":9}]',
            "40/else,",
            "41/else,",
            "6",
        ]
        hostile += [
            "9",
            "x",
            "\x00",
            "2",
            "3",
            "1",
            "0{}",
            "5",
            '42/,["event",{}]',
            "429999999999[]",
        ]
        page.evaluate(
            """async ([path, messages]) => {
                messages.push(new Uint8Array([4, 255]));
                for (const message of messages) await new Promise(end => {
                    const link = new WebSocket(path);
                    link.onclose = link.onerror = end;
                    link.onopen = () => {
                        link.send("40"), link.send(message), setTimeout(() => link.close(), 30);
                    };
                });
            }""",
            [SOCKET, hostile],
        )
        assert "Traceback" not in process.said(), process.said()[-3000:]
        sync_api.expect(page.get_by_text("Start", exact=True)).to_be_visible()


def test_a_request_whose_sender_is_gone_ends_in_no_traceback(local):
    url, process = local
    host, _, port = url.split("/")[2].rpartition(":")
    for path in (SOCKET.replace("websocket", "polling"), "/", "/live.jpg", "/view/1"):
        for method in (b"GET", b"POST"):
            request = request_of(url, path, Content_Length="40").replace(b"GET", method, 1)
            for _ in range(5):
                with socket.create_connection((host, int(port)), timeout=10.0) as link:
                    link.sendall(request)
                    # Closed with a reset, as by a process that was killed.
                    link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    assert answered(url, request_of(url)) == 200
    assert "Traceback" not in process.said(), process.said()[-3000:]


def test_silent_connections_take_no_place_for_long(local):
    url, process = local
    host, _, port = url.split("/")[2].rpartition(":")
    silent = [socket.create_connection((host, int(port)), timeout=60.0) for _ in range(220)]
    # Half a request, and no end of it.
    silent[0].sendall(b"GET / HTTP/1.1\r\nHost: ")
    # One too many is closed at once, and the others after a while.
    for link in (silent[-1], silent[1], silent[0]):
        with suppress(ConnectionResetError):
            assert link.recv(1) == b""
    for link in silent:
        link.close()
    assert answered(url, request_of(url)) == 200
    assert "Traceback" not in process.said()


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """The page for a network, in a site's folder: its address, its process, and the folder."""
    site = tmp_path_factory.mktemp("network") / "site"
    (site / "inside").mkdir(parents=True)
    (site.parent / "outside").mkdir()
    (site / "led").symlink_to(site.parent / "outside")
    with served("record", "-o", site / "cell", host="0.0.0.0", folder=site) as (url, process):
        yield url, process, site


def invitation(process) -> str:
    """The address for the next browser."""
    return re.findall(r"http://\S+", process.said())[-1]


def test_a_browser_of_the_network_is_let_in_by_its_token_once(network, browser):
    url, process, site = network
    assert f"read what is below {site}" in process.said()
    base = url.partition("/?")[0]
    paths = (
        "/",
        "/live.jpg",
        "/report",
        "/favicon.ico",
        "/_nicegui/",
        SOCKET.replace("websocket", "polling"),
    )
    for path in (*paths, "/?token=", "/?token=%ff", "/?token=wrong", "/nothing"):
        assert answered(base, request_of(base, path)) == 403
    assert answered(base, request_of(base, SOCKET, Origin=base, **SHAKE)) == 403
    for method in ("HEAD", "POST"):
        request = request_of(base, url.removeprefix(base)).replace(b"GET", method.encode())
        assert answered(base, request) == 403
    with urllib.request.urlopen(invitation(process)) as answer:
        cookie = answer.headers["Set-Cookie"]
    assert {"HttpOnly", "SameSite=strict", "Path=/"} <= {*re.split("; ", cookie)}
    # It was good once, and the terminal has another one.
    assert answered(base, request_of(base, url.removeprefix(base))) == 403
    assert invitation(process) != url
    let_in = {"Cookie": cookie.partition(";")[0]}
    assert answered(base, request_of(base, **let_in)) == 200
    assert answered(base, request_of(base, SOCKET, Origin=base, **SHAKE, **let_in)) == 101
    elsewhere = "http://elsewhere.example"
    for more in ({"Origin": elsewhere}, {"Host": "elsewhere.example"}, {}):
        assert answered(base, request_of(base, SOCKET, **SHAKE, **let_in, **more)) == 403
    assert answered(base, request_of(base, Host="elsewhere.example", **let_in)) == 403
    assert (
        answered(base, request_of(base, Host="elsewhere.example", Origin=elsewhere, **let_in))
        == 403
    )
    wrong = {"Cookie": let_in["Cookie"][:-1]}
    assert answered(base, request_of(base, **wrong)) == 403
    with opened(browser, invitation(process)) as page:
        page.get_by_role("button", name="Start").wait_for()
        page.reload()
        page.get_by_role("button", name="Start").wait_for()


def test_a_browser_of_the_network_names_files_of_the_site_alone(network, browser):
    _, process, site = network
    outside = site.parent / "outside"
    with opened(browser, invitation(process)) as page:
        alert, start = page.get_by_role("alert"), page.get_by_role("button", name="Start")
        start.wait_for()
        for camera in (
            *(f"folder:{outside}", "folder:../outside", "folder:led", "folder:led/..", "folder:/"),
            *(
                "uvc:/dev/video0",
                "uvc:file:///etc/hosts",
                "uvc:concat:led/x",
                "uvc:videotestsrc ! x",
            ),
            *("genicam:inside/x.cti", "genicam:x.cti:a/b", f"played:{outside}", "folder:\N{NULL}"),
        ):
            choose(page, "Camera", camera)
            start.click()
            alert.get_by_text(f"is not below {site}").wait_for()
            alert.get_by_text(repr(camera)).wait_for()
        choose(page, "Camera", "folder:inside")
        for label in (FIELDS[3], FIELDS[4]):
            choose(page, label, str(outside / "x.toml"))
            start.click()
            alert.get_by_text(f"x.toml' is not below {site}").wait_for()
            choose(page, label, "")
        choose(page, FIELDS[4], "charuco_9x6_30mm")
        start.click()
        alert.get_by_text("has no further picture").wait_for()
