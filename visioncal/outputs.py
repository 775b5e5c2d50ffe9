"""What `visioncal calibrate` writes: the result, the report and the recording."""

import tempfile
from pathlib import Path

from visioncal.errors import DataError
from visioncal.pipeline import Run
from visioncal.session import Session

CALIBRATION, REPORT, RECORDING = "calibration.json", "report.html", "recording.rrd"


def write_outputs(
    folder: Path, session: Session | None, run: Run, note: str = ""
) -> tuple[Path, ...]:
    """Writes the three files into a folder.

    They are made aside first: where one of them fails, none appears, and files that an earlier
    calibration left there stay as they were.

    Args:
        folder: Where to; it is made where there is none.
        session: What was calibrated; None where it was not kept, which leaves the recording out.
        run: The result and its evidence.
        note: What the reader should know of the report itself.

    Returns:
        The files that were written.

    Raises:
        DataError: The folder cannot be written.
    """
    # Plots and the recording's codec take half a second to import, which help need not wait for.
    from visioncal.recording import write_recording
    from visioncal.report import write_report
    from visioncal.viewer import blueprint

    # The result last: it is what the others are beside.
    files = (*([] if session is None else [RECORDING]), REPORT, CALIBRATION)
    taken = [folder / file for file in files if (folder / file).is_dir()]
    if taken:
        raise DataError(
            f"{taken[0]} is a folder, where a file is to be written.", culprits=[str(taken[0])]
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".writing-") as name:
            aside = Path(name)
            run.calibration.save(aside / CALIBRATION)
            write_report(aside / REPORT, run.calibration, session, run.evidence, note)
            if session is not None:
                layout = blueprint(session, run.calibration)
                write_recording(aside / RECORDING, session, run.calibration, run.evidence, layout)
            for file in files:
                (aside / file).replace(folder / file)
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be written: {error.strerror or error}.",
            culprits=[str(folder)],
            next_step="Make room in it, or choose another folder.",
        ) from error
    return tuple(folder / file for file in reversed(files))
