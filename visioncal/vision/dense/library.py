"""torch and kornia, which come with the extra `dense`, and the device that they work on."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from visioncal.core.errors import DataError
from visioncal.core.threads import SharedSetting

DEVICES = ("auto", "cpu", "cuda")


def library(name: str) -> Any:  # noqa: ANN401 - a module of a package that need not be there
    """Imports torch or kornia.

    Raises:
        DataError: It is not installed, with the command that installs it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise DataError(
            f"--dense needs {name}, which cannot be imported: {error}.",
            culprits=["--dense"],
            next_step="Install it: pip install 'visioncal[dense]'",
        ) from error


def chosen_device(wanted: str) -> str:
    """Chooses the device to work on.

    Args:
        wanted: `auto` for a GPU where there is one, `cpu` or `cuda`.

    Raises:
        DataError: There is no such device, or torch is not installed.
    """
    if wanted not in DEVICES:
        raise DataError(
            f"device {wanted!r} is not one of {', '.join(DEVICES)}.", culprits=["--device"]
        )
    there = bool(library("torch").cuda.is_available())
    if wanted == "cuda" and not there:
        raise DataError(
            "--device cuda: torch finds no GPU here.",
            culprits=["--device"],
            next_step="Leave it out, or install torch with CUDA and its driver.",
        )
    return "cuda" if there and wanted != "cpu" else "cpu"


@contextmanager
def _one_thread() -> Iterator[None]:
    torch = library("torch")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# Images are worked on side by side; torch's threads inside ours wait for one another.
ONE_TORCH_THREAD = SharedSetting(_one_thread)
