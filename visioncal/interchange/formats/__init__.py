"""Readers of foreign recordings: one file a format, with one entry each in the registry.

A foreign recording becomes a session in three steps: `read_foreign` reads its numbers as they are
written, `assemble` builds the session, and `write_session` stores it. In between, a
`DoubtfulSession` tests whether the poses are meant in another convention. `convert` does all of
this.

A new format is a file with a `ForeignFormat` and its entry in `registry.FOREIGN_FORMATS`. Another
common name of a field needs no format: it is added to the keys in `poses`, `fields` (times),
`columns` (images) or `intrinsics`, and a recording with it to the samples of the tests.
"""

from visioncal.interchange.formats.assemble import assemble
from visioncal.interchange.formats.foreign import ForeignRecording, ImportOptions, PoseImportOptions
from visioncal.interchange.formats.registry import (
    FOREIGN_FORMATS,
    convert,
    read_foreign,
    write_session,
)
from visioncal.interchange.formats.rereading import (
    DoubtfulRobot,
    DoubtfulSession,
    load_for_rereading,
    reread,
)
