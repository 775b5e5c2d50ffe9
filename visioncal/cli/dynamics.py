"""`visioncal dynamics`."""

import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import typer

from visioncal.cli.console import (
    EXIT_BAD,
    answer,
    exit_status,
    print_json,
    print_table,
    report_written,
    say,
)
from visioncal.cli.dynamics_options import (
    FRICTION,
    PLANNED_FRICTION,
    DynamicsGainsOptions,
    DynamicsIdentifyOptions,
    DynamicsPayloadOptions,
    DynamicsPlanOptions,
    DynamicsRecordOptions,
    DynamicsValidateOptions,
    StreamOptions,
)
from visioncal.cli.plan import boxes_of, floor_of
from visioncal.cli.progress import shown_progress
from visioncal.cli.summary import print_verdict
from visioncal.core.codec import wrong_value
from visioncal.core.errors import DataError
from visioncal.core.files import check_free
from visioncal.core.limits import DynamicsLimits
from visioncal.core.number_format import figure, matched, significant, some_of
from visioncal.core.parsing import numbers_in
from visioncal.core.threads import signals_as_interrupts
from visioncal.dynamics.base import BaseModel
from visioncal.dynamics.differences import check_as_identified, difference_of
from visioncal.dynamics.excitation import ExcitationRequest, excite
from visioncal.dynamics.identified import CLASSES, UNKNOWN, Identified, judge, to_document
from visioncal.dynamics.identify import SLOW_RAD_S, Options, predict, validate
from visioncal.dynamics.limits import DefaultLimits, MotionMargins, motion_limits
from visioncal.dynamics.model import DynamicModel, FrictionTerms
from visioncal.dynamics.payload import check_gains, drive_gains, estimate_payload
from visioncal.dynamics.plan_files import MotionPlan, motion_document
from visioncal.dynamics.run import (
    IdentificationRequest,
    conditioned_streams,
    current_streams,
    identify_session,
    robot_of,
    select_arm,
)
from visioncal.dynamics.sweeps import SweepRequest, plan_sweeps
from visioncal.interchange.outputs import Written, write_dynamics, write_motions
from visioncal.live.capture.motions import record_motion
from visioncal.live.drivers.ur import UrArm
from visioncal.planning.messages import plan_words
from visioncal.present.torques import torque_table
from visioncal.present.words import said
from visioncal.robot import load_robot
from visioncal.robot.collision import capsule
from visioncal.robot.inertia import Inertias, symmetric_matrices
from visioncal.session import STREAMS, Session, check_stream, save_stream


def dynamics_plan_command(options: DynamicsPlanOptions) -> None:
    """Plans an exciting motion and sweeps, writes them into a folder, and reports them."""
    arm = load_robot(options.robot)
    bodies = [box.body for box in boxes_of(options)]
    if options.tool is not None:
        length, radius = (1e-3 * number for number in options.tool)
        if min(length, radius) <= 0.0:
            needed = "a length and a radius above zero [mm]"
            raise wrong_value(options.tool, needed, "--tool")
        flange = arm.chain.placements[-1]
        tip = flange[:3, 3] + flange[:3, 2] * max(length - radius, 0.0)
        bodies.append(capsule("tool", arm.joint_count, flange[:3, 3], tip, radius))
    payload = None
    if options.payload is not None:
        kg, *centre_mm = options.payload
        if kg < 0.0:
            raise DataError(
                f"--payload is of {kg:g} kg, but must have a mass of 0 kg or more.",
                culprits=["--payload"],
            )
        _check_centre("--payload", centre_mm)
        # A point mass, in the flange's frame.
        centre_m, no_extent = 1e-3 * np.array([centre_mm]), np.zeros((1, 3, 3))
        payload = np.asarray(Inertias.of_bodies(np.array([kg]), centre_m, no_extent).values[0])
    allowed = motion_limits(
        arm,
        MotionMargins(
            float(np.deg2rad(options.margin_deg)),
            options.speed,
            options.acceleration,
            options.torque_margin,
            1e-3 * options.clearance_mm,
            floor_of(options),
        ),
        missing=DefaultLimits(
            *(
                None if degrees is None else math.radians(degrees)
                for degrees in (options.range_deg, options.speed_deg, options.acceleration_deg)
            )
        ),
        bodies=tuple(bodies),
        payload=payload,
    )
    request = ExcitationRequest(
        options.duration,
        options.harmonics,
        _friction_terms(options.friction, PLANNED_FRICTION),
        options.starts,
        options.seed,
        seconds=np.inf if options.seconds is None else options.seconds,
    )
    sweeps = None
    with shown_progress(quiet=options.as_json) as progress:
        # The sweeps first: they are quick, and fail for the same reasons.
        if not options.no_sweeps:
            sweeps = plan_sweeps(
                allowed, SweepRequest(speeds=options.sweep_speeds, seed=options.seed)
            )
        plan = MotionPlan(allowed, excite(allowed, request, progress), sweeps)
    document = motion_document(plan)
    written = write_motions(options.out, plan, options.rate_hz, document)
    if options.as_json:
        print_json(document)
    else:
        for words in plan_words(plan):
            answer(words)
        warnings = [f"not checked: {name}" for name in allowed.unchecked]
        if sweeps is not None and sweeps.left_out:
            warnings.append(f"too little room to sweep {some_of(sweeps.left_out)}")
        for words in warnings:
            answer(words, "warning: ", "bold yellow")
    report_written(written, quiet=options.as_json)


def _check_centre(name: str, centre_mm: Sequence[float]) -> None:
    """Refuses a centre of mass within 1 mm of the flange, which no body on it has."""
    if 0.0 < max(abs(value) for value in centre_mm) < 1.0:
        raise DataError(
            f"{name} is {list(centre_mm)}: a centre of mass within 1 mm of the flange's origin.",
            culprits=[name],
            next_step="It is in mm, not in m.",
        )


def _friction_terms(words: str, known: Sequence[str]) -> FrictionTerms:
    """Reads the option --friction: names among `known`, separated by commas, or none."""
    wanted = [] if words.strip().lower() == "none" else [part.strip() for part in words.split(",")]
    wrong = [name for name in wanted if name not in known]
    if wrong:
        raise DataError(
            f"--friction names {some_of(wrong)[:80]}; the terms are {some_of(known)}, or none.",
            culprits=["--friction"],
        )
    return FrictionTerms(*(name in wanted for name in known))


def dynamics_record_command(options: DynamicsRecordOptions) -> None:
    """Runs `visioncal dynamics record`."""
    kind, _, host = options.arm.partition(":")
    if kind != "ur" or not host:
        step = "Other arms' recordings go into streams/NAME.csv of a session."
        raise wrong_value(options.arm, "ur:HOST, as ur:192.168.0.10", "--arm", step)
    path = options.out / STREAMS / f"{options.stream}.csv"
    check_free(path, force=False, replaceable=False)
    with signals_as_interrupts(), closing(UrArm(host, watch_only=True, full_rate=True)) as arm:
        found = record_motion(arm, arm.rate_hz, rest_s=options.rest_s, report=say)
        model = options.robot or arm.model
    check_stream(options.stream, found)
    out, streams = options.out, {options.stream: found}
    if (out / "session.toml").is_file():
        save_stream(out, options.stream, found)
    else:
        document = {"schema": 1, "name": out.name or "motions", "robot": {"model": model}}
        Session.of_streams(document, streams).save(out)
    say(
        f"wrote {len(found)} samples to {path}. They hold currents: identify needs --gains, "
        "which visioncal dynamics gains finds"
    )


def _requested(streams: StreamOptions) -> IdentificationRequest:
    """The request for an identification."""
    gains = numbers_in(streams.gains, "--gains") if streams.gains else ()
    return IdentificationRequest(
        tuple(streams.stream or ()),
        cutoff_hz=streams.cutoff_hz,
        gains_nm_a=gains,
        robot=streams.robot,
    )


def _session(path: Path) -> Session:
    """Loads a session; tables that are none are answered with where they belong."""
    folder = path.parent if path.is_file() else path
    files = (file for at in ("", "*/") for file in folder.glob(f"{at}session.toml"))
    if path.exists() and path.suffix.lower() != ".rrd" and not any(files):
        raise DataError(
            f"{path} must be a session with streams of angles and torques.",
            culprits=[str(path)],
            next_step="Write each motion as streams/NAME.csv in a session's folder, with columns "
            "stamp_s, q1_rad ..., tau1_nm ... and, where it is recorded, dq1_rad_s ..., beside a "
            "session.toml with schema = 1, name, and model in [robot].",
        )
    return Session.load(path)


def dynamics_identify_command(options: DynamicsIdentifyOptions) -> None:
    """Identifies the dynamics from a session's streams, and writes and reports them."""
    request = replace(
        _requested(options),
        validate_on=options.validate_on or "",
        rotors=options.rotors,
        options=Options(
            terms=replace(_friction_terms(options.friction, FRICTION), slow_rad_s=SLOW_RAD_S),
            stribeck=options.stribeck,
            checked=not options.unchecked,
        ),
    )
    run = identify_session(_session(options.session), request)
    identified = run.identified
    written = Written(()) if options.output is None else write_dynamics(options.output, run)
    if options.as_json:
        print_json(to_document(identified))
    else:
        _report(identified, () if run.predicted is None else run.predicted.notes)
    if options.output is None and not options.as_json:
        say("nothing was written: -o names a folder for it")
    report_written(written, quiet=options.as_json, status=exit_status(judge(identified)))


def dynamics_validate_command(options: DynamicsValidateOptions) -> None:
    """Predicts the torques of a session's streams, and prints the prediction errors."""
    identified = Identified.load(options.against)
    streams = conditioned_streams(_session(options.session), identified, _requested(options))
    predictions = [predict(identified, stream) for stream in streams]
    validations = [validate(identified, prediction) for prediction in predictions]
    worst = max(float(validation.shares.max()) for validation in validations)
    status = EXIT_BAD if worst > DynamicsLimits().range_share[1] else 0
    if options.as_json:
        documents = []
        for prediction in predictions:
            document = {
                "stream": prediction.label,
                "rms_nm": prediction.rms_nm(prediction.predicted_nm).tolist(),
                "torque_nm": prediction.torque_nm.tolist(),
            }
            if prediction.consistent_nm is not None:
                rms_nm = prediction.rms_nm(prediction.consistent_nm)
                document["consistent_rms_nm"] = rms_nm.tolist()
            documents.append(document)
        print_json(documents)
        raise typer.Exit(status)
    for prediction, validation in zip(predictions, validations, strict=True):
        answer("\n".join([prediction.label, *prediction.notes]))
        # Of the worst stream.
        fitted = np.max([stream.rms_nm for stream in identified.streams], axis=0)
        print_table(
            ("joint", "predicted to [N m]", "of its range", "fitted to [N m]"),
            [
                (name, figure(rms_nm), f"{figure(100.0 * share)} %", figure(fitted_nm))
                for name, rms_nm, share, fitted_nm in zip(
                    identified.robot.joint_names,
                    validation.rms_nm.tolist(),
                    validation.shares.tolist(),
                    fitted.tolist(),
                    strict=True,
                )
            ],
        )

    if worst > DynamicsLimits().range_share[0]:
        check_as_identified(identified, streams)
        for stream in streams:
            if words := difference_of(identified, stream):
                answer(f"{stream.label} was recorded otherwise: {words}.", "warning: ", "yellow")
    raise typer.Exit(status)


def _report(identified: Identified, validation_notes: Sequence[str]) -> None:
    """Prints the verdict, the fit, and the notes on the validation samples."""
    print_verdict(judge(identified), f"dynamics of {identified.robot.name}")
    for stream in identified.streams:
        left_out = f", {stream.left_out} torques left out" if stream.left_out else ""
        answer(
            f"{stream.label}: {stream.samples} samples at {figure(2 * stream.cutoff_hz)} Hz of "
            f"a motion up to {figure(stream.band_hz)} Hz{left_out}"
        )
        for note in stream.notes:
            answer(f"  - {note}")
    fitted = {note for stream in identified.streams for note in stream.notes}
    for note in (name for name in validation_notes if name not in fitted):
        answer(f"  - {note}")
    counts = [(word, identified.determined.count(word)) for _, word in CLASSES]
    shares = ", ".join(f"{count} to {word}" for word, count in counts[:-1])
    answer(
        f"{identified.base.rank} base parameters: {shares}, {counts[-1][1]} {counts[-1][0]}, "
        f"{identified.determined.count(UNKNOWN)} {UNKNOWN}"
    )
    torques = torque_table(identified)
    print_table(torques.titles, [row.cells for row in torques.rows])
    for words in said("torque_note", identified):
        answer(words)


def dynamics_payload_command(options: DynamicsPayloadOptions) -> None:
    """Estimates the payload, and prints it."""
    identified = Identified.load(options.against)
    loaded = conditioned_streams(_session(options.session), identified, _requested(options))
    payload = estimate_payload(
        identified,
        loaded,
        friction_changes=not options.same_friction,
        gain_sigma=0.01 * options.gains_sigma,
    )
    if options.as_json:
        print_json(payload.document())
        return
    for note in (note for conditioned in loaded for note in conditioned.notes):
        say(note)
    mass = f"{matched(payload.mass_kg, payload.mass_sigma_kg)} kg"
    pairs = zip(1e3 * payload.centre_m, 1e3 * payload.centre_sigma_m, strict=True)
    centre = ", ".join(
        f"{matched(value, sigma)} (sigma {significant(sigma)})" for value, sigma in pairs
    )
    gains = ""
    if payload.gains_sigma_kg:
        gains = f", {significant(payload.gains_sigma_kg)} of it from the drives' gains"
    lines = [
        f"mass {mass} (sigma {significant(payload.mass_sigma_kg)}{gains})",
        f"centre {centre} mm in the flange's frame",
    ]
    # A UR's program has kg, m and kg m^2.
    at_m = ", ".join(f"{value:.5f}" for value in payload.centre_m)
    on_ur = f"set_target_payload({payload.mass_kg:.4f}, [{at_m}]"
    if payload.consistent:
        inertia = ", ".join(f"{value:.4g}" for value in payload.inertia_kg_m2)
        lines.append(f"inertia about it (xx, xy, yy, xz, yz, zz) {inertia} kg m^2")
        xx, xy, yy, xz, yz, zz = payload.inertia_kg_m2.tolist()
        on_ur += f", [{', '.join(f'{value:.6f}' for value in (xx, yy, zz, xy, xz, yz))}]"
    else:
        lines.append("its inertia is lost in the noise")
    left = ", ".join(significant(rm) for rm in payload.rms_nm.tolist())
    lines.append(f"unexplained {left} N m, joint by joint")
    typer.echo("\n".join([*lines, f"on a UR: {on_ur})"]))


def dynamics_gains_command(options: DynamicsGainsOptions) -> None:
    """Estimates the torque constants of an arm's drives from a known body on its flange."""
    _check_centre("--com-mm", options.com_mm)
    centre, about = 1e-3 * np.array(options.com_mm), symmetric_matrices(np.array(options.inertia))
    body = Inertias.of_bodies(np.array([options.mass_kg]), centre[None], about[None])
    if not (options.mass_kg > 0.0 and body.consistent):
        raise DataError(
            f"--mass-kg {options.mass_kg:g} and --inertia {options.inertia} are those of no body.",
            culprits=["--mass-kg", "--inertia"],
            next_step="A mass above 0 kg is needed, and an inertia about its centre; none stands "
            "for a body as small as a point.",
        )
    without = select_arm(_session(options.session), options.named)
    robot = robot_of(without)
    empty = current_streams(without, robot, options.cutoff_hz)
    full = current_streams(
        select_arm(_session(options.loaded), options.named),
        robot,
        options.cutoff_hz or empty[0].cutoff_hz,
    )
    base = BaseModel.reduce(DynamicModel(robot, FrictionTerms(motor_inertia=True)))
    gains = drive_gains(base, empty, full, np.asarray(body.values[0]))
    doubts = () if options.unchecked else check_gains(gains, base, empty)
    if options.as_json:
        rows: list[dict[str, str | float]] = [{"joint": name} for name in robot.joint_names]
        # Only the joint where its gain is not determined.
        for joint in np.flatnonzero(gains.determined):
            rows[joint]["nm_per_a"] = float(gains.nm_per_a[joint])
            rows[joint]["sigma_nm_per_a"] = float(gains.sigma[joint])
        print_json(rows)
        return
    for name, gain, sigma, determined in zip(
        robot.joint_names,
        gains.nm_per_a.tolist(),
        gains.sigma.tolist(),
        gains.determined,
        strict=True,
    ):
        words = "not determined: the body hardly moves it"
        if determined:
            words = f"{matched(gain, sigma)} N m/A (sigma {significant(sigma)})"
        say(f"{name}: {words}")
    for words in doubts:
        say(words, "warning: ", "yellow")
    if gains.determined.all():
        typer.echo(f"--gains {','.join(f'{value:.5g}' for value in gains.nm_per_a)}")
    else:
        say(
            "--gains needs all joints: move those that are not determined more, or take a body "
            "that is heavier or whose centre is farther from their axes."
        )
