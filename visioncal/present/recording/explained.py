"""How far images are explained: the board as it should look, and what is left."""

from collections.abc import Iterable

import rerun as rr

from visioncal.present.recording import paths
from visioncal.results.evidence import ViewEvidence


def is_drawn(evidence: Iterable[ViewEvidence]) -> bool:
    """Whether any image was explained."""
    return any(it.explained is not None for it in evidence)


def log_view(stream: rr.RecordingStream, seen: ViewEvidence) -> None:
    """Logs one view's images at the stream's current time, or takes back the view before."""
    found = seen.explained
    for entity, image in (
        (paths.DRAWN, None if found is None else found.drawn),
        (paths.REST, None if found is None else found.rest),
    ):
        if image is None:
            stream.log(entity, rr.Clear(recursive=False))
        else:
            stream.log(entity, rr.EncodedImage(contents=image, media_type="image/jpeg"))
    words = "This image was not looked at." if found is None else found.words
    stream.log(paths.BLUR_NOTE, rr.TextDocument(words, media_type="text/markdown"))
