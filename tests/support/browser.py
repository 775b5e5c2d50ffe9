"""A headless Chromium: how a page looks, on a screen and on paper."""

import shutil
import subprocess
from pathlib import Path

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")


def chromium(page: Path, *flags: str) -> None:
    """Opens a page and ends, having done what the flags say."""
    profile = page.with_name("profile")
    options = ["--headless", "--no-sandbox", "--hide-scrollbars", f"--user-data-dir={profile}"]
    command = [CHROMIUM, *options, *flags, page.absolute().as_uri()]
    subprocess.run(command, check=True, capture_output=True)


def picture(page: Path, width: int, height: int, into: Path) -> None:
    """Takes a picture of a page [px]."""
    chromium(page, f"--window-size={width},{height}", f"--screenshot={into}")


def printed(page: Path, into: Path) -> None:
    """Prints a page as a PDF."""
    chromium(page, "--no-pdf-header-footer", f"--print-to-pdf={into}")
