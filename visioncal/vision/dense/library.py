"""Access to torch and kornia, which the extra `dense` installs, and to their device."""

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
        DataError: The library is not installed.
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
    """Chooses the torch device.

    Args:
        wanted: `auto` for a GPU if there is one, `cpu` or `cuda`.

    Raises:
        DataError: There is no such device, or torch is not installed.
    """
    if wanted not in DEVICES:
        raise DataError(
            f"device {wanted!r} is not one of {', '.join(DEVICES)}.", culprits=["--device"]
        )
    has_gpu = bool(library("torch").cuda.is_available())
    if wanted == "cuda" and not has_gpu:
        raise DataError(
            "--device cuda: torch finds no GPU here.",
            culprits=["--device"],
            next_step="Leave it out, or install torch with CUDA and its driver.",
        )
    return "cuda" if has_gpu and wanted != "cpu" else "cpu"


@contextmanager
def _one_thread() -> Iterator[None]:
    torch = library("torch")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


# Images are processed in parallel threads, which torch's own threads would slow down.
ONE_TORCH_THREAD = SharedSetting(_one_thread)
