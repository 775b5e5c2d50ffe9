"""Calibration or check of the views so far, by the command that a user would run."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from visioncal.calibration.suspects.outliers import EXCHANGED
from visioncal.core.number_format import figure
from visioncal.session import View

# Colours of a traffic light; grey: no result yet.
Light = Literal["green", "yellow", "red", "grey"]
_OF_VERDICTS: dict[str, Light] = {"good": "green", "check": "yellow", "bad": "red"}


@dataclass(frozen=True, eq=False)
class Outcome:
    """The answer of `calibrate` or `verify`."""

    light: Light
    title: str  # The verdict in a word or two.
    reasons: tuple[str, ...]  # The likeliest first.
    next_step: str  # The remedy; empty for none.
    folder: Path  # Where its files are; those of a trial are gone.
    views: tuple[View, ...]  # The rows of which it is.
    document: dict[str, Any]  # Output of the command; empty where it failed.

    @property
    def report(self) -> Path:
        """The page of the report."""
        return self.folder / "report.html"

    @property
    def exchanged(self) -> tuple[int, int] | None:
        """Numbers of two views whose poses it takes for exchanged; None for no such pair."""
        findings = self.document.get("verdict", {}).get("findings", ())
        pairs = (each["views"] for each in findings if each["kind"] == EXCHANGED)
        return next(((pair[0], pair[1]) for pair in pairs if len(pair) == 2), None)

    def residual(self, view: View) -> tuple[str, bool]:
        """Residual of a row in words, and whether it was left out; empty where it is not of it."""
        entries = self.document.get("views", ()) if any(view is one for one in self.views) else ()
        entry = next((each for each in entries if each["view"] == view.number), None)
        if entry is None:
            return "", False
        far = entry["residual_mm"]
        words = "" if far is None else f"{figure(far)} mm"
        return words if entry["used"] else f"{words}, left out".strip(", "), not entry["used"]


def ask_command(words: Sequence[str], folder: Path | None, views: tuple[View, ...]) -> Outcome:
    """Runs a command of visioncal with `--json` as a process of its own, and reads its answer.

    Args:
        words: The command and its options, but for its output.
        folder: Where it writes; None for a trial, which draws nothing and keeps no file.
        views: The rows of the session.
    """
    is_trial = folder is None
    with tempfile.TemporaryDirectory() as passing:
        if folder is None:
            folder, words = Path(passing) / "trial", (*words, "--no-report", "--no-recording")
        command = [sys.executable, "-P", "-m", "visioncal", *words, "-o", str(folder), "--json"]
        pipe = subprocess.PIPE
        # Pictures and requests come first.
        below = getattr(subprocess, "BELOW_NORMAL_PRIORITY_CLASS", 0) if is_trial else 0
        with subprocess.Popen(
            command, stdout=pipe, stderr=pipe, text=True, creationflags=below
        ) as process:
            if is_trial and hasattr(os, "setpriority"):
                with suppress(OSError):
                    os.setpriority(os.PRIO_PROCESS, process.pid, 19)
            answer, complaint = process.communicate()
    try:
        document = json.loads(answer)
    except ValueError:
        reasons = (complaint.strip()[-2000:] or f"exit status {process.returncode}",)
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
