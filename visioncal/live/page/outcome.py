"""What a calibration or a check says of the views so far, by the command that a user would run."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

# Colours of a traffic light; grey: no result yet.
Light = Literal["green", "yellow", "red", "grey"]
_OF_VERDICTS: dict[str, Light] = {"good": "green", "check": "yellow", "bad": "red"}


@dataclass(frozen=True, eq=False)
class Outcome:
    """The answer of `calibrate` or `verify`."""

    light: Light
    title: str  # The verdict in a word or two.
    reasons: tuple[str, ...]  # The likeliest first.
    next_step: str  # What to do; empty for nothing.
    folder: Path  # Where its files are; those of a trial are gone.
    views: int  # Number of views of which it is.
    document: dict[str, Any]  # What the command printed; empty where it failed.

    @property
    def report(self) -> Path:
        """Its page."""
        return self.folder / "report.html"


def ask_command(words: Sequence[str], folder: Path | None, views: int) -> Outcome:
    """Runs a command of visioncal with `--json` as a process of its own, and reads its answer.

    Args:
        words: The command and its options, but for its output.
        folder: Where it writes; None for a trial, which draws nothing and keeps no file.
        views: Number of views of the session.
    """
    with tempfile.TemporaryDirectory() as passing:
        if folder is None:
            folder, words = Path(passing) / "trial", (*words, "--no-report", "--no-recording")
        command = [sys.executable, "-P", "-m", "visioncal", *words, "-o", str(folder), "--json"]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        document = json.loads(ended.stdout)
    except ValueError:
        reasons = (ended.stderr.strip()[-2000:] or f"exit status {ended.returncode}",)
        return Outcome("red", "failed", reasons, "", folder, views, {})
    if "error" in document:
        error = document["error"]
        return Outcome("grey", "no result", (error["message"],), error["next"], folder, views, {})
    if "verdict" not in document:
        # Its sentences say what to do.
        said = (tuple(document["sentences"]), "", folder, views, document)
        return (
            Outcome("green", "valid", *said)
            if document["passed"]
            else Outcome("red", "not valid", *said)
        )
    status, findings = document["verdict"]["status"], document["verdict"]["findings"]
    reasons = tuple(finding["words"] for finding in findings)
    step: dict[str, str] = next((finding["do"] for finding in findings if "do" in finding), {})
    words = " ".join(step[part] for part in ("words", "command") if part in step)
    return Outcome(_OF_VERDICTS[status], status, reasons, words, folder, views, document)
