"""`visioncal audit`."""

from typing import Any

import numpy as np
import typer

from visioncal.cli.console import EXIT_BAD, answer, print_json
from visioncal.cli.result_options import AuditOptions
from visioncal.core.errors import DataError
from visioncal.core.number_format import counted, figure
from visioncal.interchange.formats.episodes import read_episodes
from visioncal.interchange.result_files import load_calibration
from visioncal.verification.scene_audit import SceneMove, assumed_camera, scene_moves
from visioncal.vision.boards.imaging import read_image


def audit_command(options: AuditOptions) -> None:
    """Runs `visioncal audit`."""
    episodes = read_episodes(options.dataset, options.image_key)
    camera = assumed_camera(episodes[0].load(0))
    if options.against is not None:
        known = load_calibration(options.against).camera
        if known is None:
            raise DataError(
                f"{options.against} was calibrated from measured poses, and has no lens.",
                culprits=["--against"],
                next_step="Leave it out: small turns hardly depend on the lens.",
            )
        camera = known.camera
    mask = None if options.mask is None else read_image(options.mask) > 127
    for name, size in (("mask", mask), ("camera", np.empty(camera.resolution[::-1]))):
        if size is not None and size.shape != episodes[0].load(0).shape:
            raise DataError(
                f"the {name} has {size.shape[1]} x {size.shape[0]} px, but must have the size of "
                "the episodes' frames.",
                culprits=[f"--{'mask' if name == 'mask' else 'against'}"],
            )
    moves = scene_moves(
        episodes, camera, mask=mask, looks=options.looks, steady_px=options.steady_px
    )
    documents = []
    for move in moves:
        documents.append(_document(move))
        if not options.as_json:
            answer(_words(move))
    frames = sum(episode.count for episode in episodes)
    if options.as_json:
        print_json({"episodes": len(episodes), "frames": frames, "moves": documents})
    else:
        found = counted(len(documents), "move") if documents else "no move"
        answer(f"{found} in {counted(len(episodes), 'episode')}, {counted(frames, 'frame')}")
    if documents:
        raise typer.Exit(EXIT_BAD)


def _words(move: SceneMove) -> str:
    at_s = move.frame / move.episode.frames_a_second if move.episode.frames_a_second else 0.0
    time = f" ({at_s:.1f} s)" if at_s else ""
    where = (
        f"{move.episode.name}, {f'frame {move.frame}{time}' if move.frame else 'from its start'}"
    )
    if move.found.reason:
        return f"{where}: the camera shows another part of the scene ({move.found.reason})"
    shift, turn = np.linalg.norm(move.found.shift_px), np.linalg.norm(move.found.turn)
    return (
        f"{where}: the camera moved: the image's middle by {figure(float(shift))} px, as by a turn "
        f"of {figure(float(np.rad2deg(turn)))} deg"
    )


def _document(move: SceneMove) -> dict[str, Any]:
    document: dict[str, Any] = {"episode": move.episode.name, "frame": move.frame}
    if move.found.reason:
        return document | {"reason": move.found.reason}
    values = {"shift_px": move.found.shift_px, "sigma_px": move.found.shift_sigma_px}
    values["turn_deg"] = np.rad2deg(move.found.turn)
    return document | {name: value.round(5).tolist() for name, value in values.items()}
