"""`visioncal simulate`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from visioncal.cli.console import messages, shown_progress
from visioncal.simulation import (
    CellOptions,
    Payload,
    Round,
    SweepOptions,
    WarmUpOptions,
    arm_named,
    charuco_target,
    checkerboard_target,
    fine_camera,
    fisheye_camera,
    simulate,
    simulate_warm_up,
    truth_path,
    wide_camera,
    write_session,
    write_sweep,
    write_warm_up,
)
from visioncal.simulation import sweep as swept
from visioncal.types import CameraMount

_CAMERAS = {"wide": wide_camera, "fine": fine_camera, "fisheye": fisheye_camera}
# Where the centre of a simulated load is, in the flange's frame [m].
_CENTRE_M = (0.0, 0.0, 0.1)
_BOARDS = {"charuco": charuco_target, "checkerboard": checkerboard_target}


def simulate_command(
    folder: Annotated[Path, typer.Argument(help="Where to write the session.")],
    mount: Annotated[CameraMount, typer.Option(help="Where the camera is.")] = "eye-in-hand",
    views: Annotated[int, typer.Option(min=1, help="Number of views.")] = 20,
    robot: Annotated[str, typer.Option(help="ur3e, ur5e or ur10e.")] = "ur10e",
    camera: Annotated[
        Literal["wide", "fine", "fisheye"],
        typer.Option(help="1280 x 800, 2448 x 2048, or a fisheye."),
    ] = "wide",
    board: Annotated[
        Literal["charuco", "checkerboard"], typer.Option(help="What is printed.")
    ] = "charuco",
    robot_sigma_mm: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Repeatability of the robot [mm].")
    ] = 0.03,
    robot_sigma_mrad: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Repeatability of its rotation [mrad].")
    ] = 0.05,
    arm_sigma_mm: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Departure of the arm's lengths [mm].")
    ] = 0.0,
    arm_sigma_mrad: Annotated[
        float, typer.Option(min=0.0, max=100.0, help="Departure of its angles [mrad].")
    ] = 0.0,
    wrong_views: Annotated[
        int, typer.Option(min=0, help="Views whose reported pose is wrong.")
    ] = 0,
    board_scale: Annotated[
        float, typer.Option(min=0.5, max=2.0, help="Printed over stated size of the board.")
    ] = 1.0,
    with_intrinsics: Annotated[
        bool, typer.Option(help="Whether the session states the camera's intrinsics.")
    ] = True,
    images: Annotated[
        bool, typer.Option(help="Whether to render images; pose pairs are written otherwise.")
    ] = True,
    sweep: Annotated[
        bool,
        typer.Option(help="A sweep without stops: pose pairs by one clock, the robot by another."),
    ] = False,
    clock_offset_ms: Annotated[
        float, typer.Option(help="With --sweep: what the camera's clock is ahead [ms].")
    ] = 37.0,
    warm_up: Annotated[
        bool,
        typer.Option(
            help="A cold arm that works for 100 minutes: pose pairs, and its joints' temperatures."
        ),
    ] = False,
    currents: Annotated[
        bool, typer.Option(help="With --warm-up: motor currents instead of temperatures.")
    ] = False,
    stiffness_knm: Annotated[
        float | None,
        typer.Option(min=0.1, help="Stiffness of every joint [kN m/rad]; rigid if left out."),
    ] = None,
    payload_kg: Annotated[
        list[float] | None,
        typer.Option(min=0.0, help="What the arm carries; several times for stops in turn."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Another cell for every number.")] = 0,
) -> None:
    """Write a simulated session, and its truth in a file beside it."""
    options = CellOptions(
        robot=robot,
        mount=mount,
        views=views,
        target=_BOARDS[board](),
        camera=_CAMERAS[camera](),
        state_intrinsics=with_intrinsics,
        robot_sigma_m=1e-3 * robot_sigma_mm,
        robot_sigma_rad=1e-3 * robot_sigma_mrad,
        dh_sigma_m=1e-3 * arm_sigma_mm,
        dh_sigma_rad=1e-3 * arm_sigma_mrad,
        wrong_views=wrong_views,
        board_scale=board_scale,
        compliance_rad_per_nm=_compliance(robot, stiffness_knm),
        payloads=tuple(Payload(it, _CENTRE_M) for it in payload_kg or ()),
        seed=seed,
    )
    if warm_up:
        how = WarmUpOptions(options, round=Round(first=views))
        write_warm_up(simulate_warm_up(how), folder, temperatures=not currents)
    elif sweep:
        clocks = SweepOptions(camera_minus_robot_s=1e-3 * clock_offset_ms)
        write_sweep(swept(options, clocks), folder)
    else:
        with shown_progress(quiet=False) as told:
            write_session(
                simulate(options),
                folder,
                lambda share: told("render", round(share * views), views),
                images=images,
            )
    messages().print(f"wrote {folder}\nwrote {truth_path(folder)}")


def _compliance(robot: str, stiffness_knm: float | None) -> tuple[float, ...]:
    """What each joint yields to a torque [rad/(N m)]; empty for a rigid arm."""
    if stiffness_knm is None:
        return ()
    return (1e-3 / stiffness_knm,) * len(arm_named(robot).offset)
