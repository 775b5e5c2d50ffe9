"""Matches of features where a ratio test fails, by kornia (extra `kornia`), on a GPU if present.

AdaLAM (Cavalli et al. 2020) keeps matches whose neighbours move alike and needs no weights.
LightGlue (Lindenberger et al. 2023) is used where its weights for SIFT lie in the folder of a
picture's `weights_in` or in torch's own cache, and never fetched. Nothing else imports kornia or
torch.
"""

import pickle
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from visioncal.core.errors import DataError
from visioncal.core.types import FloatArray, IntArray

if TYPE_CHECKING:
    from kornia.feature import LightGlue
    from torch import Tensor

# Names that kornia and the authors give to the weights for SIFT.
_NAMES = ("sift_lightglue_v0-1_arxiv-pth", "sift_lightglue.pth")


@dataclass(frozen=True, eq=False)
class Features:
    """Features of an image by SIFT."""

    px: FloatArray  # (n, 2).
    size_px: FloatArray  # (n,) diameters.
    angle_deg: FloatArray  # (n,).
    described: npt.NDArray[np.float32]  # (n, 128) square roots of shares.
    shape: tuple[int, ...]  # (h, w) of the image.


def is_installed() -> bool:
    """Whether the extra `kornia` is."""
    return find_spec("kornia") is not None


def check_weights(folder: Path | None) -> None:
    """Checks that a folder has weights of LightGlue, and that these can be used; None for none.

    Raises:
        DataError: The extra is not installed, or the folder has no weights for SIFT.
    """
    if folder is None:
        return
    if not is_installed():
        raise DataError(
            "--weights: LightGlue is kornia's, which is not installed.",
            culprits=["--weights"],
            next_step="Install visioncal[kornia].",
        )
    if not any((folder / name).is_file() for name in _NAMES):
        raise DataError(
            f"--weights: {folder} has no file {' or '.join(_NAMES)}.",
            culprits=["--weights"],
            next_step="Put the weights of LightGlue for SIFT there; nothing is fetched.",
        )


def hard_matches(
    seen: Features, known: Features, weights_in: Path | None = None
) -> Iterator[IntArray]:
    """(m, 2) indices of features of two images that belong together, by one way after the other.

    Weights of LightGlue are looked for in a folder, where one is given, and in torch's cache.
    """
    import torch
    from kornia.feature import laf_from_center_scale_ori, match_adalam

    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")

    def tensor(values: npt.ArrayLike) -> "Tensor":
        return torch.as_tensor(np.asarray(values, np.float32), device=device)

    features = (seen, known)
    frames = [
        laf_from_center_scale_ori(
            tensor(one.px)[None],
            tensor(one.size_px)[None, :, None, None],
            tensor(one.angle_deg)[None, :, None],
        )
        for one in features
    ]
    described = [tensor(one.described) for one in features]
    with torch.inference_mode():
        _, pairs = match_adalam(*described, *frames, hw1=seen.shape, hw2=known.shape)
        yield pairs.cpu().numpy()
        cache = Path(torch.hub.get_dir(), "checkpoints")
        folders = (cache,) if weights_in is None else (weights_in, cache)
        files = (folder / name for folder in folders for name in _NAMES)
        weights = next((file for file in files if file.is_file()), None)
        if weights is None:
            return
        matcher = light_glue(weights).to(device)
        images = [
            {
                "keypoints": tensor(one.px)[None],
                "descriptors": vectors[None],
                "scales": tensor(one.size_px)[None],
                "oris": tensor(np.deg2rad(one.angle_deg))[None],
                "image_size": tensor(np.array(one.shape[::-1], float))[None],
            }
            for one, vectors in zip(features, described, strict=True)
        ]
        found = matcher({"image0": images[0], "image1": images[1]})
        yield found["matches"][0].cpu().numpy()


def light_glue(weights: Path) -> "LightGlue":
    """LightGlue for SIFT with weights from a file, whose sizes are those of the network.

    Raises:
        DataError: The file cannot be read, or has the weights of another network.
    """
    import torch
    from kornia.feature import LightGlue

    other = DataError(f"{weights} does not have the weights of LightGlue for SIFT.")
    try:
        state = torch.load(str(weights), map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError) as error:
        raise other from error
    # The authors' older names: self_attn.3. in place of transformers.3.self_attn.
    state = {
        f"transformers.{name.split('.')[1]}.{name.split('.')[0]}.{name.split('.', 2)[2]}"
        if name.startswith(("self_attn.", "cross_attn."))
        else name: value
        for name, value in state.items()
    }
    layers = {name.split(".")[1] for name in state if name.startswith("transformers.")}
    width, depth = state["input_proj.weight"].shape if "input_proj.weight" in state else (128, 128)
    network = LightGlue(
        None,
        input_dim=depth,
        descriptor_dim=width,
        add_scale_ori=True,
        n_layers=max(len(layers), 1),
    )
    try:
        missing = set(network.load_state_dict(state, strict=False).missing_keys)
    except RuntimeError as error:
        raise other from error
    if missing & {name for name, _ in network.named_parameters()}:
        raise other
    return network.eval()
