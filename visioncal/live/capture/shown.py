"""Shows a recording in the viewer while it is made."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from visioncal.live.capture.core import CaptureEvent, note_of
from visioncal.live.capture.take import Missed

if TYPE_CHECKING:
    from visioncal.present.recording.live import LiveDrawing


@dataclass(frozen=True, eq=False)
class Shown:
    """A watcher that draws each view."""

    drawing: "LiveDrawing"

    def stepped(self, step: CaptureEvent) -> None:
        """Draws a view."""
        # Rerun takes half a second to import, which recordings that nobody watches need not wait.
        from visioncal.present.recording.live import LiveView

        found = step.found
        if isinstance(found, Missed):
            return
        known = None if step.accuracy is None or step.accuracy.is_open else step.accuracy.mm
        self.drawing.draw(
            LiveView(
                step.view,
                found.frame.image,
                found.corners.px,
                found.state.base_from_flange,
                found.state.q,
                known,
                note_of(step),
            )
        )
