"""The views as a table, each with its picture and its pose, and what may be mended in a row."""

from collections.abc import Callable

from nicegui import ui

from visioncal.core.documents.pendants import PendantPose
from visioncal.live.drivers.manual import pose_words
from visioncal.live.page.state import Fault, Row, Snapshot, Visitor
from visioncal.live.page.station import Station

# Where the pictures of views are served.
VIEWS = "/view"


def picture_of(row: Row) -> str:
    """Address of a view's picture."""
    return f"{VIEWS}/{row.number}?{row.version}"


def read_as(pose: PendantPose) -> str:
    """Says how a pose was understood."""
    return f"Read as {pose.words}: {pose_words(pose.pose)}"


class ViewTable:
    """The table in one browser, the newest view first, and a dialog for one of its rows.

    Args:
        station: The recording.
        visitor: The browser.
        understand: Reads a line with a pose, or says why it cannot be read.
    """

    def __init__(
        self, station: Station, visitor: Visitor, understand: Callable[[str], PendantPose | str]
    ) -> None:
        self._station, self._visitor, self._understand = station, visitor, understand
        self._rows: dict[int, _Line] = {}
        with ui.column().classes("w-full gap-0").props("role=table aria-label=views") as self._all:
            pass
        with ui.dialog() as self._dialog, ui.card().classes("w-full").style("max-width: 720px"):
            self._build()

    def _build(self) -> None:
        self._number = 0
        with ui.row().classes("w-full items-center justify-between no-wrap"):
            self._title = ui.label("").classes("text-lg break-all")
            ui.button("Cancel", on_click=self._dialog.close).props("flat")
        self._picture = ui.image().style("max-height: 40vh").props("fit=contain")
        self._line = ui.input("Its pose, as the pendant shows it", on_change=self._read)
        self._line.classes("w-full font-mono").on("keydown.enter", self._repose)
        self._read_as = ui.label("").classes("text-sm")
        self._refused = ui.label("").classes("text-red-700").props("role=alert")
        with ui.row().classes("w-full items-center gap-1"):
            self._replaces = ui.button("Replace the pose", on_click=self._repose)
            self._act("Take again", self._station.again)
            self._mends("Remove", "not wanted")
        with ui.row().classes("w-full items-center gap-1"):
            self._other = ui.select([], label="Another view").classes("w-40")
            self._mends("Exchange their poses", "exchanged")
        ui.label("Are poses and pictures one apart from this view on?").classes("text-sm")
        with ui.row().classes("w-full items-center gap-1"):
            self._mends("This picture has no pose", "no pose")
            self._mends("This pose has no picture", "no picture")

    def _mends(self, words: str, fault: Fault) -> None:
        def mend(visitor: Visitor, number: int) -> None:
            self._station.mend(visitor, fault, number, self._other.value or 0)

        self._act(words, mend)

    def _act(self, words: str, request: Callable[[Visitor, int], None]) -> None:
        ui.button(words, on_click=lambda: request(self._visitor, self._number)).props("flat")

    def _open(self, number: int) -> None:
        row = self._rows[number].row
        self._number, self._title.text = row.number, f"View {row.number}  {row.picture}"
        self._picture.set_source(picture_of(row))
        self._line.value, self._refused.text, self._other.value = row.pose, "", None
        self._line.visible = self._read_as.visible = self._replaces.visible = row.is_typed
        self._other.set_options([number for number in self._rows if number != row.number])
        self._dialog.open()

    def _read(self) -> PendantPose | None:
        read = self._understand(self._line.value.strip())
        self._read_as.text = read if isinstance(read, str) else read_as(read)
        return None if isinstance(read, str) else read

    def _repose(self) -> None:
        if (read := self._read()) is not None:
            self._station.repose(self._visitor, self._number, read, self._line.value.strip())

    def hear(self, refusal: str) -> None:
        """Shows why a request was refused, or closes the dialog."""
        self._refused.text = refusal
        if not refusal:
            self._dialog.close()

    def show(self, now: Snapshot) -> None:
        """Draws what has changed in the rows."""
        current_rows = {row.number: row for row in now.views}
        for number in self._rows.keys() - current_rows.keys():
            self._rows.pop(number).line.delete()
        for number, row in current_rows.items():
            if number not in self._rows:
                with self._all:
                    self._rows[number] = _Line(row, self._open)
            self._rows[number].show(row, again=number == now.again)


class _Line:
    """The line of a view, above all others; it stays, so that no click meets one that is gone."""

    def __init__(self, row: Row, change: Callable[[int], None]) -> None:
        number, self.row = row.number, row
        with ui.row() as self.line:
            name = ui.label(f"{number}").classes("w-8 shrink-0 text-right text-lg")
            name.props("role=rowheader")
            self._picture = ui.image(picture_of(row)).classes("w-20 shrink-0")
            self._picture.props("no-spinner alt=picture")
            with ui.column().classes("w-44 shrink-0 gap-0 text-sm").props("role=cell"):
                self._name = ui.label("").classes("w-full truncate font-bold")
                self._state = ui.label("")
            self._pose = ui.label("").classes("grow font-mono text-sm min-w-0").props("role=cell")
            self._pose.style("overflow-wrap: anywhere")
            self._residual = ui.label("").classes("w-32 shrink-0 text-right").props("role=cell")
            button = ui.button("Change", on_click=lambda: change(number)).props("flat dense")
            button.props["aria-label"] = f"change view {number}"
        self.line.classes("w-full items-center no-wrap gap-3 py-1 border-b border-gray-300")
        self.line.props("role=row").props["aria-label"] = f"view {number}"
        self.line.move(target_index=0)

    def show(self, row: Row, *, again: bool) -> None:
        """Shows the row as it is now."""
        self.row = row
        if self._picture.source != picture_of(row):
            self._picture.set_source(picture_of(row))
        self._name.text, self._pose.text = row.picture, row.pose
        self._state.text = "to be taken again" if again else row.state
        self._residual.text = row.residual
        self._residual.classes(
            add="text-red-700" if row.is_odd else "", remove="" if row.is_odd else "text-red-700"
        )
