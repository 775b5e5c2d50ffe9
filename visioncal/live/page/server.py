"""The page itself (NiceGUI): what a station shows, and what a person may ask of it.

Every browser has a page of its own of the one station, redrawn from its snapshot; a reload loses
nothing.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
import uvicorn
from fastapi import FastAPI, Response
from nicegui import app, core, ui
from nicegui.helpers import schedule_browser

from visioncal.core.conventions import POSE_FORMS
from visioncal.core.documents.pendants import PendantPose, pendant_words, read_pose
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted
from visioncal.live.page.access import Admission, Connection, refuse_malformed
from visioncal.live.page.outcome import Outcome
from visioncal.live.page.state import PageText, Snapshot, Visitor
from visioncal.live.page.station import Station
from visioncal.live.page.table import VIEWS, ViewTable, read_as

_COLOURS = {"green": "#2e9e2e", "yellow": "#e0a800", "red": "#c62828", "grey": "#777777"}
_PICTURE, _REPORT = "/live.jpg", "/report"


def serve(
    station: Station, text: PageText, host: str, port: int, admission: Admission, *, opens: bool
) -> None:
    """Serves the page until Ctrl-C.

    Args:
        station: The recording.
        text: What the page asks and says.
        host: Address to listen on.
        port: Its port.
        admission: Who is let in.
        opens: Whether to open a browser.
    """

    def live_picture() -> Response:
        headers = {"Cache-Control": "no-store"}
        return Response(station.snapshot.picture, 200, headers, "image/jpeg")

    def report() -> Response:
        outcome = station.snapshot.outcome
        if outcome is None or not outcome.report.is_file():
            return Response("There is no report.", 404)
        return Response(outcome.report.read_bytes(), media_type="text/html")

    def picture_of(number: int) -> Response:
        # Its address names the version, too: what was shown once is not drawn again.
        headers = {"Cache-Control": "private, max-age=86400, immutable"}
        picture = station.picture(number)
        return Response(picture, 200, headers, "image/jpeg") if picture else Response("", 404)

    site = FastAPI(openapi_url=None)
    site.get(_PICTURE)(live_picture)
    site.get(f"{VIEWS}/{{number}}")(picture_of)
    site.get(_REPORT)(report)
    ui.page("/", title=text.title)(lambda: _Page(station, text) and None)
    app.on_shutdown(station.close)
    # Nothing is compressed: that would come before the answers' restraints.
    ui.run_with(site, gzip_middleware_factory=None, show_welcome_message=False)
    refuse_malformed(core.sio)
    if opens:
        schedule_browser("http", host, port, f"/?{admission.query}")
    uvicorn.run(
        admission.around(site),
        host=host,
        port=port,
        http=Connection,
        ws="wsproto",
        log_level="warning",
        proxy_headers=False,
    )


class _Page:
    """The page in one browser."""

    def __init__(self, station: Station, text: PageText) -> None:
        self._station, self._text = station, text
        self._shown: Snapshot | None = None
        self._visitor = Visitor(station.snapshot)
        self._answers = 0
        self._inputs: dict[str, ui.input] = {}
        setup = station.snapshot.setup
        with ui.row().classes("w-full items-center gap-4"):
            ui.label(text.title).classes("text-2xl")
            self._light = ui.label().classes("text-white text-xl px-4 py-1").props("role=status")
            self._of = ui.label("")
            self._status = ui.label("").props("aria-live=polite")
        self._problem = ui.label("").classes("text-red-700 text-lg").props("role=alert")
        self._note = ui.label("").classes("text-sm")
        with ui.card().classes("w-full") as self._setup:
            for name, (label, choices) in text.fields.items():
                value = getattr(setup, name)
                field = ui.input(label, value=value, autocomplete=[*choices]).classes("w-full")
                # Names of folders are data: `props()` would parse them, and run what they say.
                field.props("clearable hide-bottom-space").props["hint"] = ", ".join(choices)
                self._inputs[name] = field
            ui.button("Start", on_click=self._begin)
        self._outcome = ui.card().classes("w-full gap-1")
        with ui.row().classes("w-full gap-4 items-start") as self._live:
            self._build_live()
        self._table = ViewTable(station, self._visitor, self._understand)
        self._history = ui.column().classes("w-full")
        self._refresh()
        ui.timer(0.05, self._refresh)
        ui.timer(0.0, self._restore, once=True)

    def _begin(self) -> None:
        chosen = {name: str(field.value or "") for name, field in self._inputs.items()}
        self._station.begin(replace(self._station.snapshot.setup, **chosen))

    def _build_live(self) -> None:
        station = self._station
        with ui.column().classes("flex-1").style("min-width: min(100%, 360px)"):
            with ui.row().classes("w-full items-center") as self._folder:
                self._due = (
                    ui.select([], label="Picture of the next pose", on_change=self._choose)
                    .props("options-dense")
                    .classes("grow")
                )
                ui.button("Leave it out", on_click=self._leave_out).props("flat")
            self._picture = ui.interactive_image().classes("w-full").props("alt='live picture'")
            with ui.row().classes("items-center"):
                self._still = ui.label("").classes("text-xl font-bold")
                self._sees = ui.label("")
            self._coverage = ui.html()
            self._advice = ui.label("").classes("text-sm")
        with ui.column().classes("flex-1").style("min-width: min(100%, 360px)"):
            self._next = ui.label("").classes("text-lg")
            self._next_pose = ui.label("").classes("font-mono")
            self._warned = ui.label(
                "Drive there yourself, slowly: nothing here knows cables, tools or obstacles."
            ).classes("text-sm")
            with ui.column().classes("w-full gap-1") as self._typing:
                forms = {name: form.words for name, form in POSE_FORMS.items()}
                self._form = ui.select(
                    {"": "form of the pose: as recognised", **forms},
                    value=station.snapshot.setup.pose_form,
                    on_change=self._read,
                ).classes("w-full")
                self._typed = (
                    ui.textarea("Pose of the flange, as the pendant shows it", on_change=self._read)
                    .props("autofocus autogrow rows=1 autocomplete=off")
                    .classes("w-full font-mono")
                    .on("keydown.enter.prevent", self._take)
                    .on(
                        "update:model-value",
                        js_handler="text => sessionStorage.setItem(document.title, text)",
                    )
                )
                self._understood = ui.label("").props("aria-live=polite")
            self._refusal = ui.label("").classes("text-red-700").props("role=alert")
            with ui.row().classes("gap-1"):
                self._take_button = ui.button("Take view (Enter)", on_click=self._take)
                self._keep = self._button("", station.again, None)
                actions: tuple[tuple[str, Callable[..., None]], ...] = (
                    ("Undo last", partial(station.mend, fault="not wanted")),
                    ("Another pose", station.skip),
                    (self._text.finish, station.finish),
                    ("Close", station.end),
                )
                for words, request in actions:
                    self._button(words, request).props["flat"] = request != station.finish
            self._missed = ui.label("").classes("text-red-700").props("role=alert")

    def _button(self, words: str, request: Callable[..., None], *more: object) -> ui.button:
        return ui.button(words, on_click=lambda: request(self._visitor, *more))

    def _choose(self) -> None:
        name = self._due.value
        # Set by `_refresh`, it asks for nothing.
        if name and name != self._visitor.seen.due:
            self._station.choose(self._visitor, name)

    def _leave_out(self) -> None:
        if due := self._visitor.seen.due:
            self._station.choose(self._visitor, due, leaves_out=True)

    def _understand(self, line: str) -> PendantPose | str:
        """Reads a line, or says why it cannot be read."""
        try:
            read = read_pose(line, "the pose", self._form.value or None)
        except DataError as error:
            return f"{error.message} {error.next_step}"
        # No flange is within 10 mm of its base.
        is_metric = read.reading.unit == "mm" and np.abs(read.pose[:3, 3]).max() < 0.01
        return f"{read_as(read)}. In metres? Then write X 0.5 m." if is_metric else read

    def _lines(self) -> list[str]:
        return [line.strip() for line in self._typed.value.splitlines() if line.strip()]

    def _read(self) -> list[PendantPose]:
        """Reads the typed poses, and says how they are understood; none where one cannot be."""
        lines, poses, wrong = self._lines(), list[PendantPose](), list[str]()
        for number, line in enumerate(lines, 1):
            read = self._understand(line)
            if isinstance(read, str):
                wrong.append(read if len(lines) == 1 else f"Line {number}: {read}")
            else:
                poses.append(read)
        words = [*map(read_as, poses)]
        if len(poses) > 1:
            words = [f"{len(poses)} poses, each of the next picture. The first: {words[0]}"]
        self._understood.text = " ".join(wrong or words)
        return [] if wrong else poses

    async def _restore(self) -> None:
        """Shows what was typed, and not taken, before a reload."""
        with suppress(TimeoutError):
            kept = await ui.run_javascript("sessionStorage.getItem(document.title)")
            if isinstance(kept, str) and not self._typed.value:
                self._typed.value = kept

    def _take(self) -> None:
        if poses := self._read():
            self._station.take(self._visitor, poses, self._lines(), self._visitor.seen)

    def _hear(self) -> None:
        """Shows what became of the visitor's requests."""
        visitor = self._visitor
        if visitor.answers == self._answers:
            return
        self._answers = visitor.answers
        self._refusal.text = visitor.refusal
        self._table.hear(visitor.refusal)
        if visitor.refusal:
            return
        if visitor.lines == tuple(self._lines()):
            self._typed.value, visitor.lines = "", ()
            ui.run_javascript("sessionStorage.removeItem(document.title)")
        if visitor.returned and not self._typed.value:
            self._typed.value = visitor.returned
        visitor.returned = ""

    def _refresh(self) -> None:
        """Shows what has changed in the snapshot."""
        now, before = self._station.snapshot, self._shown
        self._shown = self._visitor.seen = now
        self._hear()
        if now is before:
            return

        def changed(*names: str) -> bool:
            return any(before is None or getattr(now, n) != getattr(before, n) for n in names)

        is_live = now.phase == "live"
        self._setup.visible = now.phase in ("setup", "stopped")
        self._live.visible = is_live or bool(now.views)
        self._problem.text = now.problem
        self._status.text = self._status_of(now)
        if is_live and changed("pictures"):
            self._picture.set_source(f"{_PICTURE}?{now.pictures}")
        self._still.text = {None: "", True: "still", False: "hold still"}[now.is_still]
        self._note.text = now.note
        self._sees.text, self._advice.text = now.sees, now.advice
        self._typing.visible = self._take_button.visible = now.takes_typed
        self._missed.text = now.missed
        if changed("coverage"):
            self._coverage.content = now.coverage
        if changed("next_pose", "pose_form", "due"):
            # A picture that is there has its pose; a place is suggested for those to come.
            pose = None if now.due else now.next_pose
            words = f"Type the pose at which {now.due} was taken." if now.due else ""
            self._next.text = words if pose is None else pose.words
            flange = None if pose is None else pose.base_from_flange
            self._next_pose.visible = self._warned.visible = flange is not None
            if flange is not None:
                self._next_pose.text = pendant_words(flange, POSE_FORMS[now.pose_form])
        self._folder.visible = now.is_stored and now.takes_typed
        if changed("waiting", "left_out"):
            left_out = {name: f"{name} (left out)" for name in now.left_out}
            names = {name: name for name in now.waiting} | left_out
            self._due.set_options(names, value=now.due or None)
        self._keep.visible, self._keep.text = now.again is not None, f"Keep view {now.again}"
        again = "" if now.again is None else f" {now.again} again"
        self._take_button.text = f"Take view{again} (Enter)"
        self._table.show(now)
        if changed("trial", "outcome", "outdated"):
            self._show_outcome(now)

    def _status_of(self, now: Snapshot) -> str:
        if now.phase == "opening":
            return "opening the devices ..."
        if now.is_judging:
            return "computing the result ..."
        if now.phase == "stopped":
            return f"on the disk: {counted(len(now.views), 'view')}"
        return f"{now.arm}: {counted(len(now.views), 'view')}" if now.phase == "live" else ""

    def _show_outcome(self, now: Snapshot) -> None:
        shown: Outcome | None = now.outcome or now.trial
        light, words = ("grey", "no result yet") if shown is None else (shown.light, shown.title)
        if shown is not None:
            words += "" if now.outcome else " so far"
            count = counted(len(shown.views), "view")
            self._of.text = f"of {count}{f'; {now.outdated}' if now.outdated else ''}"
        self._light.text = words
        self._light.style(f"background:{_COLOURS[light]};border-radius:1em;white-space:nowrap")
        self._outcome.clear()
        self._outcome.visible = shown is not None
        if shown is not None:
            with self._outcome:
                for reason in shown.reasons[:3]:
                    ui.label(reason)
                # A trial's commands would be of a folder that is gone.
                if now.outcome is not None:
                    if shown.next_step:
                        ui.label(f"Next: {shown.next_step}").classes("font-bold")
                    ui.label(f"The files are in {shown.folder}.").classes("text-sm")
                    if shown.report.is_file():
                        ui.link("Open the report", _REPORT, new_tab=True)
                if shown.exchanged and not now.outdated:
                    first, second = shown.exchanged
                    words = f"Exchange the poses of views {first} and {second}"
                    self._button(words, self._station.mend, "exchanged", first, second)
        self._history.clear()
        with self._history:
            for light, date, line in self._text.history():
                with ui.row().classes("items-center no-wrap"):
                    ui.label("\N{BLACK CIRCLE}").style(f"color:{_COLOURS[light]}")
                    ui.label(f"{date}: {line}")
