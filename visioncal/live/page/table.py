"""The views as a table, each with its picture and its pose, and what may be mended in a row."""

from collections.abc import Callable

from nicegui import ui

from visioncal.core.documents.pendants import PendantPose
from visioncal.live.drivers.manual import pose_words
from visioncal.live.page.station import Row, Snapshot, Station, Visitor

# Where the pictures of views are served.
VIEWS = "/view"


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
        self._rows: dict[int, tuple[Row, bool, ui.row]] = {}
        with ui.column().classes("w-full gap-0").props("role=table aria-label=views") as self._all:
            pass
        with ui.dialog() as self._dialog, ui.card().classes("w-full").style("max-width: 720px"):
            self._build()

    def _build(self) -> None:
        self._number, mend = 0, self._station.mend
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
            self._act("Remove", mend, "not wanted")
        with ui.row().classes("w-full items-center gap-1"):
            self._other = ui.select([], label="Another view").classes("w-40")
            self._act(
                "Exchange their poses",
                lambda visitor, number: mend(visitor, "exchanged", number, self._other.value or 0),
            )
        ui.label("Are poses and pictures one apart from this view on?").classes("text-sm")
        with ui.row().classes("w-full items-center gap-1"):
            self._act("This picture has no pose", mend, "no pose")
            self._act("This pose has no picture", mend, "no picture")

    def _act(self, words: str, request: Callable[..., None], *more: object) -> None:
        ask = lambda: request(self._visitor, self._number, *more)  # noqa: E731
        ui.button(words, on_click=ask).props("flat")

    def _open(self, row: Row) -> None:
        self._number, self._title.text = row.number, f"View {row.number}  {row.picture}"
        self._picture.set_source(f"{VIEWS}/{row.number}?{row.version}")
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
        """Draws the rows that have changed."""
        there = {row.number: row for row in now.views}
        for number in self._rows.keys() - there.keys():
            self._rows.pop(number)[2].delete()
        for number, row in there.items():
            again = number == now.again
            before = self._rows.get(number)
            if before is None:
                with self._all:
                    line = ui.row().classes(
                        "w-full items-center no-wrap gap-3 py-1 border-b border-gray-300"
                    )
                line.props("role=row").props["aria-label"] = f"view {number}"
                line.move(target_index=0)
            elif before[:2] == (row, again):
                continue
            else:
                line = before[2]
                line.clear()
            self._rows[number] = row, again, line
            with line:
                self._draw(row, again=again)

    def _draw(self, row: Row, *, again: bool) -> None:
        ui.label(f"{row.number}").classes("w-8 shrink-0 text-right text-lg").props("role=rowheader")
        thumbnail = ui.image(f"{VIEWS}/{row.number}?{row.version}").classes("w-20 shrink-0")
        thumbnail.props("no-spinner alt=picture")
        with ui.column().classes("w-44 shrink-0 gap-0 text-sm").props("role=cell"):
            ui.label(row.picture).classes("w-full truncate font-bold")
            ui.label("to be taken again" if again else row.state)
        pose = ui.label(row.pose).classes("grow font-mono text-sm min-w-0").props("role=cell")
        pose.style("overflow-wrap: anywhere")
        residual = ui.label(row.residual).classes("w-32 shrink-0 text-right").props("role=cell")
        residual.classes("text-red-700" if row.is_odd else "")
        change = ui.button("Change", on_click=lambda: self._open(row)).props("flat dense")
        change.props["aria-label"] = f"change view {row.number}"
