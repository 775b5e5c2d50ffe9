"""Reads what a recording draws."""

from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader

from visioncal.present.recording import paths


def column(
    path: Path, entity: str, component: str, timeline: str = paths.TIMELINE
) -> dict[int, np.ndarray]:
    """Reads one component of one entity by the place of the view; static ones have the place 0."""
    found: dict[int, np.ndarray] = {}
    for chunk in RrdReader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if component in batch.schema.names and (chunk.is_static or timeline in batch.schema.names):
            times = range(1) if chunk.is_static else batch.column(timeline).to_numpy().tolist()
            values = map(np.array, batch.column(component).to_pylist())
            found |= dict(zip(times, values, strict=True))
    return found
