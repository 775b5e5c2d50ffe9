"""The page itself (NiceGUI): what a station shows, and what a person may ask of it.

Every browser has a page of its own of the one station, redrawn from its snapshot; a reload loses
nothing.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from fastapi import Response
from nicegui import app, ui

from visioncal.core.conventions import POSE_FORMS
from visioncal.core.documents.pendants import PendantPose, pendant_words, read_pose
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted
from visioncal.live.drivers.manual import pose_words
from visioncal.live.page.access import Admission
from visioncal.live.page.outcome import Outcome
from visioncal.live.page.station import PageText, Snapshot, Station

_COLOURS = {"green": "#2e9e2e", "yellow": "#e0a800", "red": "#c62828", "grey": "#777777"}
_PICTURE, _REPORT = "/live.jpg", "/report"


def serve(station: Station, text: PageText, host: str, port: int, *, opens: bool) -> None:
    """Serves the page until Ctrl-C.

    Args:
        station: The recording.
        text: What the page asks and says.
        host: Address to listen on.
        port: Its port.
        opens: Whether to open a browser.
    """
    loopback = ("127.0.0.1", "localhost", "::1")
    # By another address a page may have any name.
    app.add_middleware(Admission, hosts=loopback if host in loopback else ())

    def live_picture() -> Response:
        headers = {"Cache-Control": "no-store"}
        return Response(station.snapshot.picture, 200, headers, "image/jpeg")

    def report() -> Response:
        outcome = station.snapshot.outcome
        if outcome is None or not outcome.report.is_file():
            return Response("There is no report.", 404)
        return Response(outcome.report.read_bytes(), media_type="text/html")

    app.get(_PICTURE)(live_picture)
    app.get(_REPORT)(report)
    ui.page("/", title=text.title)(lambda: _Page(station, text) and None)
    app.on_shutdown(station.close)
    ui.run(
        host=host, port=port, title=text.title, reload=False, show=opens, show_welcome_message=False
    )


class _Page:
    """The page in one browser."""

    def __init__(self, station: Station, text: PageText) -> None:
        self._station, self._text = station, text
        self._shown: Snapshot | None = None
        self._inputs: dict[str, ui.input] = {}
        setup = station.snapshot.setup
        with ui.row().classes("w-full items-center gap-4"):
            ui.label(text.title).classes("text-2xl")
            self._light = ui.label().classes("text-white text-xl px-4 py-1").props("role=status")
            self._status = ui.label("").props("aria-live=polite")
        self._problem = ui.label("").classes("text-red-700 text-lg").props("role=alert")
        self._note = ui.label("").classes("text-sm")
        with ui.card().classes("w-full") as self._setup:
            for name, (label, choices) in text.fields.items():
                value = getattr(setup, name)
                field = ui.input(label, value=value, autocomplete=[*choices]).classes("w-full")
                # Names of folders are data: `props()` would parse them, and run what they say.
                field.props("clearable").props["hint"] = ", ".join(choices)
                self._inputs[name] = field
            ui.button("Start", on_click=self._begin)
        self._outcome = ui.card().classes("w-full gap-1")
        with ui.row().classes("w-full gap-4 items-start") as self._live:
            self._build_live()
        self._history = ui.column().classes("w-full")
        self._refresh()
        ui.timer(0.2, self._refresh)

    def _begin(self) -> None:
        chosen = {name: str(field.value or "") for name, field in self._inputs.items()}
        self._station.begin(replace(self._station.snapshot.setup, **chosen))

    def _build_live(self) -> None:
        station = self._station
        with ui.column().classes("flex-1").style("min-width: min(100%, 480px)"):
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
                    ui.input("Pose of the flange, as the pendant shows it", on_change=self._read)
                    .props("autofocus autocomplete=off")
                    .classes("w-full font-mono")
                    .on("keydown.enter", self._take)
                )
                self._understood = ui.label("").props("aria-live=polite")
            with ui.row().classes("gap-1"):
                self._take_button = ui.button("Take view (Enter)", on_click=self._take)
                for words, request in (
                    ("Undo last", station.undo),
                    ("Another pose", station.skip),
                    (self._text.finish, station.finish),
                    ("Close", station.end),
                ):
                    button = ui.button(words, on_click=partial(self._ask, request))
                    button.props["flat"] = request != station.finish
            self._missed = ui.label("").classes("text-red-700").props("role=alert")
            self._views = ui.column().classes("gap-0 text-sm")

    def _ask(self, request: Callable[[Snapshot], None]) -> None:
        if self._shown is not None:
            request(self._shown)

    def _read(self) -> PendantPose | None:
        """Reads the typed pose, and says how it is understood."""
        line = self._typed.value.strip()
        self._understood.text = ""
        if not line:
            return None
        try:
            read = read_pose(line, "the pose", self._form.value or None)
        except DataError as error:
            self._understood.text = f"{error.message} {error.next_step}"
            return None
        words = f"Read as {read.words}: {pose_words(read.pose)}"
        # No flange is within 10 mm of its base.
        is_metric = read.reading.unit == "mm" and np.abs(read.pose[:3, 3]).max() < 0.01
        self._understood.text = f"{words}. In metres? Then write X 0.5 m." if is_metric else words
        return None if is_metric else read

    def _take(self) -> None:
        read, shown = self._read(), self._shown
        if read is not None and shown is not None:
            self._station.take(read.pose, read.form.name, shown)

    def _refresh(self) -> None:
        """Shows what has changed in the snapshot."""
        now, before = self._station.snapshot, self._shown
        self._shown = now
        if now is before:
            return
        is_live = now.phase == "live"
        self._setup.visible = now.phase in ("setup", "stopped")
        self._live.visible = is_live or bool(now.views)
        self._problem.text = now.problem
        self._status.text = self._status_of(now)
        if is_live and (before is None or now.pictures != before.pictures):
            self._picture.set_source(f"{_PICTURE}?{now.pictures}")
        self._still.text = {None: "", True: "still", False: "hold still"}[now.is_still]
        self._note.text = now.note
        self._sees.text, self._advice.text = now.sees, now.advice
        self._typing.visible = self._take_button.visible = now.takes_typed
        self._missed.text = now.missed
        if before is None or now.coverage != before.coverage:
            self._coverage.content = now.coverage
        if before is None or (now.next_pose, now.pose_form) != (before.next_pose, before.pose_form):
            pose = now.next_pose
            self._next.text = "" if pose is None else pose.words
            flange = None if pose is None else pose.base_from_flange
            self._next_pose.visible = self._warned.visible = flange is not None
            if flange is not None:
                self._next_pose.text = pendant_words(flange, POSE_FORMS[now.pose_form])
        if before is None or now.views != before.views:
            self._views.clear()
            with self._views:
                for line in reversed(now.views):
                    ui.label(line)
            if before is not None and len(now.views) > len(before.views):
                self._typed.value = ""
        if before is None or (now.trial, now.outcome) != (before.trial, before.outcome):
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
        so_far = " so far" if now.outcome is None and shown is not None else ""
        self._light.text = f"{words}{so_far}"
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
        self._history.clear()
        with self._history:
            for light, date, line in self._text.history():
                with ui.row().classes("items-center no-wrap"):
                    ui.label("\N{BLACK CIRCLE}").style(f"color:{_COLOURS[light]}")
                    ui.label(f"{date}: {line}")
