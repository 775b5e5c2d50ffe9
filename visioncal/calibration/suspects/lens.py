"""Lenses: stated ones that do not fit, errors beyond their models, and changes of focus."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from visioncal.calibration.pipeline.assessment import FitAssessment
from visioncal.calibration.pipeline.lens_fields import mean_distance_m
from visioncal.calibration.pipeline.run_state import RunState
from visioncal.calibration.stages.cameras import NEW_LENS, misread_lens, most_moved_px
from visioncal.calibration.stages.corner_sizes import smaller_picture
from visioncal.calibration.stages.error_sizes import Zoom
from visioncal.calibration.suspects.suspect import ARM_ERRORS, INFLATED, UNEXPLAINED, Suspect
from visioncal.core.errors import VisioncalError
from visioncal.core.limits import CLEAR_RATIO, CONTRADICTION
from visioncal.core.number_format import counted, figure, mm_and_deg
from visioncal.core.quantiles import FALSE_ALARM, chi2_limit
from visioncal.core.types import Camera, FloatArray, IntArray
from visioncal.core.verdict import CALIBRATE, NOTE, Finding, Remedy
from visioncal.estimation import unknowns
from visioncal.estimation.fit import Fit
from visioncal.estimation.joint import moved_mahalanobis_sq
from visioncal.estimation.problem_parts import Effect
from visioncal.estimation.scene import ONLY_CAMERA
from visioncal.estimation.steps import Step
from visioncal.model.effects.board_sags import BoardSags
from visioncal.model.effects.effect import SIGNIFICANT
from visioncal.model.effects.window import Window, nearer
from visioncal.results.compare import intrinsics_names
from visioncal.vision.boards import kind_of
from visioncal.vision.camera import intrinsics, normalise, with_intrinsics
from visioncal.vision.intrinsics import estimate_intrinsics

# Changes of intrinsics or corners below this show in no image, and in no pick [px].
_LEAST_MOVE_PX = 0.1
# A step of the centre by more is that of the image: a lens that is hit moves it by less [px].
_SHIFTED_PX = 3.0
# Share of the focal length by which no zoom creeps unseen: a board that curls looks so.
_MOST_CREEP = 0.03
# Share of the focal length by which distortion that changed alone may seem to change it, too.
_ALONE = 3e-3
# Another model of a lens leaves so much less: more than an even field does; and so much less that
# it is the lens, however small both are: where corners end, the models part by far more.
_BETTER, _FAR_BETTER = 1.1, 2.0
# Cosine of the steepest tilt of a pane to the sight: beyond it, little light comes through.
_STEEPEST = float(np.cos(np.deg2rad(75.0)))
_OTHER_MODEL = "Give matrix and distortion of a model that fits the lens, or keep to the middle of "
_OTHER_MODEL += "the image."
_ONE_LENS = "Keep one lens, and one setting of the driver that rectifies pictures"


def _stated(run: RunState) -> Iterator[Finding]:
    """Stated intrinsics and noise of corners that the corners contradict."""
    fitted = run.assessment.fit
    for camera in fitted.unknowns.of(unknowns.LENS):
        for finding in (*_of_camera(run.assessment, camera), *_taken_as_exact(run, camera)):
            yield finding.of("" if camera == ONLY_CAMERA else camera)


def _taken_as_exact(run: RunState, camera: str) -> Iterator[Finding]:
    """The condition of all sigmas beside a given lens that counts as exact, by its derivative."""
    fitted, lens = run.assessment.fit, (unknowns.LENS, camera)
    scene = fitted.camera_parameters.problems[camera].scene
    is_exact = not scene.estimated and scene.matrix_sigma_px is None
    # After a step the derivative is another.
    if (
        run.assessment.is_stepped
        or not is_exact
        or len(fitted.unknowns.columns(lens))
        or camera not in fitted.frames
    ):
        return
    by_px = run.cell_fit.lens_changes[camera] / fitted.camera(camera).matrix[0]
    moves = fitted.response(Effect.free("a given lens", by_sensor=by_px))
    moves = moves[fitted.unknowns[unknowns.EDGE, camera]]
    far_mm, far_deg = 1e3 * np.linalg.norm(moves[3:], axis=0), np.linalg.norm(moves[:3], axis=0)
    (focal, *centre) = zip(far_mm.tolist(), np.rad2deg(far_deg).tolist(), strict=True)
    yield Finding(
        "given_lens",
        "Sigmas hold if the given lens is exact, as no matrix_sigma_px is stated: 1 px of its "
        f"focal length moves the camera by {mm_and_deg(*focal)}, 1 px of its centre by up to "
        f"{mm_and_deg(*np.max(centre, axis=0).tolist())}.",
    )


def _of_camera(assessment: FitAssessment, camera: str) -> Iterator[Finding]:
    fitted = assessment.fit
    optics, seen, lens = fitted.camera_parameters, fitted.linearised, (unknowns.LENS, camera)
    problem, columns = optics.problems[camera], fitted.unknowns.columns(lens)
    moving = fitted.unknowns.moved[columns]
    stack, compressed = problem.stack, seen.compressed[[*optics.problems].index(camera)]
    count, stated_px = problem.unknowns(compressed), stack.stated_px
    shown_px = stack.shown_px(compressed.residuals, count)
    if (
        stated_px is not None
        and shown_px > stated_px
        and stack.contradicts(compressed.residuals, count)
    ):
        yield Finding(
            "corner_noise",
            f"The corners scatter by {figure(shown_px)} px, and corners.csv states "
            f"{figure(stated_px)} px (sigma_px of a typical corner). The result goes by the "
            "scatter.",
            Remedy(
                "Look for errors of the detector, the lens or the target that sigma_px leaves out."
            ),
        )
    if problem.scene.mode == "refine" and not moving.any():
        views = counted(len(stack.views), "view", ("leaves", "leave"))
        yield Finding(
            "remark",
            f'intrinsics = "refine" was not done: {len(stack.px)} corners in {views} too '
            "little to judge by.",
            Remedy(
                "Show a board with more corners, or more views, or state matrix_sigma_px, how well "
                "fx, fy, cx, cy are known."
            ),
        )
    lens_now = optics.camera(camera)
    if problem.scene.estimated and (size := smaller_picture(lens_now, stack.px)) is not None:
        (width, height), (cx, cy) = lens_now.resolution, lens_now.matrix[2:4]
        yield Finding(
            "image_sizes",
            f"The corners look like those of pictures of {size[0]} x {size[1]} px, where the "
            f"camera's are {width} x {height}: the lens has its centre at ({cx:.0f}, {cy:.0f}), "
            "and no corner lies beyond that size. Its frames are right, but pixels of a whole "
            "picture are of another lens.",
            Remedy(
                f"State resolution = [{size[0]}, {size[1]}], or find the corners in whole pictures."
            ),
        )
    if not problem.scene.estimated and has_changed(fitted, columns):
        moves = (fitted.values(lens) - intrinsics(problem.scene.camera))[:4]
        sigmas_px = problem.stated_sigma[:4]
        moved = f"fx, fy, cx, cy moved by {_px(moves)} px."
        stated, refined = problem.scene.camera, optics.camera(camera)
        moved_px, bent_px = most_moved_px(stated, refined, stack.px)
        if bent_px > max(np.abs(moves).max(), _LEAST_MOVE_PX):
            names = ", ".join(intrinsics_names(stated)[4:])
            moved = f"the distortion, {names}, moved corners by up to {figure(bent_px)} px; {moved}"
        is_wrong = problem.scene.matrix_sigma_px is None
        is_wrong |= bool(np.any(np.abs(moves) > CONTRADICTION * sigmas_px))
        # Beside a board whose size is held, the lens explains residuals by distance.
        is_wrong &= has_changed(assessment.sized, columns)
        if is_wrong and moved_px > _LEAST_MOVE_PX:
            words = f"The given intrinsics do not fit these images and were refined: {moved}"
            words += misread_lens(stated, refined, stack.px, moved_px)
            yield Finding("lens", words, NEW_LENS)
        else:
            allowed = "within what is stated, or no more than images or a board's size explain"
            yield Finding(NOTE, f"The given intrinsics were refined {allowed}: {moved}")
    if not moving.all():
        held = problem.scene.camera
        moves = np.zeros(len(intrinsics(held)))
        moves[fitted.unknowns.values_of(lens)] = fitted.shift[columns]
        information = np.linalg.inv(fitted.by_noise[np.ix_(columns, columns)])
        squared = float(fitted.shift[columns] @ information @ fitted.shift[columns])
        free = with_intrinsics(held, intrinsics(held) + moves)
        moved_px, bent_px = most_moved_px(held, free, stack.px)
        if moved_px > _LEAST_MOVE_PX and squared > chi2_limit(FALSE_ALARM, len(columns)):
            would = f"fx, fy, cx, cy would move by {_px(moves[:4])} px"
            if bent_px > np.abs(moves[:4]).max():
                names = ", ".join(intrinsics_names(held)[4:])
                would = f"the distortion, {names}, would move corners by up to {figure(bent_px)} px"
            yield Finding(
                "lens",
                f"The given intrinsics do not fit these images: free, {would}."
                f"{misread_lens(held, free, stack.px, moved_px)} But intrinsics = "
                '"hold" keeps them; what this does to the result counts in its sigmas.',
                NEW_LENS,
                mahalanobis_sq=squared,
                up_to_mm=_misplaced_mm(fitted, camera, moved_px),
            )


def _misplaced_mm(fitted: Fit, camera: str, px: float) -> float:
    """Error of a place by an error in pixels, at the distance of a camera's views [mm]."""
    focal_px = float(np.mean(fitted.camera(camera).matrix[:2]))
    return 1e3 * px / focal_px * mean_distance_m(fitted, camera)


def has_changed(fitted: Fit, columns: IntArray) -> bool:
    """Whether what a fit moved of lens and board values differs significantly from the stated."""
    moved = columns[fitted.unknowns.moved[columns]]
    if not len(moved):
        return False
    return bool(moved_mahalanobis_sq(fitted, moved) > chi2_limit(FALSE_ALARM, len(moved)))


def _px(values: FloatArray) -> str:
    return ", ".join(f"{'-' if value < 0 else '+'}{figure(abs(value))}" for value in values)


def _beyond(run: RunState) -> Iterator[Finding]:
    """Significant errors beyond the model: of a part of the image, and changes of the focus."""
    fit = run.assessment.fit
    for name, noise_px in fit.sigmas_px.items():
        levels, distance_m = fit.lens_levels(name), mean_distance_m(fit, name)
        field, *changes = levels.gains[:3]
        of = _lens_words(fit, name)
        if field > SIGNIFICANT:
            if (model := _of_fisheye(run, name, of)) is not None:
                yield replace(model, mahalanobis_sq=field)
                continue
            field_px = levels.field * noise_px
            words = "corners of one part of the image are off alike, by "
            words = f"{of} departs from its model: {words}{figure(field_px)} px."
            advice = _OTHER_MODEL
            if any(kind_of(board).has_lone_tags for board in run.session.boards.values()):
                words += " Or else the corners of lone tags were found off: blur and light shift "
                words += "them, unlike those where squares meet."
                advice += " Or take a ChArUco board or an AprilGrid."
            yield Finding(
                "lens_field",
                f"{words} The result counts it, and belongs to this lens.",
                Remedy(advice),
                mahalanobis_sq=field,
                up_to_mm=_misplaced_mm(fit, name, field_px),
            )
        percents = [100.0 * noise_px * share for share in (levels.breathing, levels.jitter)]
        when = ("where the distance doubles", "from view to view")
        how = [
            f"by {figure(percent)} % {words}"
            for percent, words, gain in zip(percents, when, changes, strict=True)
            if gain > SIGNIFICANT
        ]
        sizes, moves = run.cell_fit.sizes, run.cell_fit.inlier_fit.moves
        zoom = sizes.zoomed.get(name)
        bumped = {at.stop for at in moves if at.frame == name}
        if zoom is not None and bumped and zoom.station in (None, *bumped):
            # A bump of the camera, which is named, explains it: as a change there, or as a creep.
            continue
        if zoom is not None and zoom.station is None and abs(zoom.share) > _MOST_CREEP:
            continue
        if zoom is not None:
            yield _zoomed(run, name, zoom, changes[1])
        elif how:
            yield Finding(
                "focus",
                f"{of} changes its focal length {' and '.join(how)}.",
                Remedy("Fix the focus (no autofocus), or work at one distance."),
                mahalanobis_sq=max(changes),
                up_to_mm=10.0 * max(percents) * distance_m,
                consequence="The result counts it.",
            )


def _moving(run: RunState) -> Iterator[Finding]:
    """Images that move while their rows are read."""
    fit = run.assessment.fit
    for name, noise_px in fit.sigmas_px.items():
        levels, optics = fit.lens_levels(name), fit.linearised.camera_parameters
        if levels.gains[3] > SIGNIFICANT:
            moved = levels.motion * noise_px
            moved_px = moved * float(np.mean(optics.camera(name).matrix[:2]))
            yield Finding(
                "row_motion",
                "The arm, or what it looks at, moved while pictures were read, as by a rolling "
                f"shutter: between a picture's first row and its last, by {figure(moved_px)} px "
                "(rms, along each axis). The result counts it, with poses of the middle rows.",
                Remedy(
                    "Wait until the arm stands still before each image; or sweep, with the times "
                    "of images and robot (stamp_s, streams): then the motion is known."
                ),
                mahalanobis_sq=levels.gains[3],
                up_to_mm=1e3 * moved * mean_distance_m(fit, name),
            ).of("" if name == ONLY_CAMERA else name)


def _seen_through(run: RunState) -> Iterator[Finding]:
    """Panes of glass before lenses, and boards that swell."""
    sizes = run.cell_fit.sizes
    for found in sizes.displaced:
        camera, effect = found.effect.frame, found.effect
        if isinstance(effect, Window):
            finding = pane_finding(effect, found.values)
        elif isinstance(effect, BoardSags):
            finding = _sagging(effect, found.values)
        else:
            finding = _swelling(found.values)
        rivals = sizes.instead_of(effect.kind)
        finding = replace(finding, rivals=rivals, mahalanobis_sq=found.gain)
        yield finding.of("" if camera == ONLY_CAMERA else camera)


def _swelling(values: FloatArray) -> Finding:
    percent = 100.0 * float(values[0])
    return Finding(
        "board_swells",
        f"The board {'grew' if percent > 0.0 else 'shrank'} by {figure(abs(percent))} % "
        "during the session, as paper in the damp. The result is that of its size at the end.",
        Remedy("Print it on aluminium or glass, or let it lie in the room for a day."),
    )


def _sagging(sags: BoardSags, values: FloatArray) -> Finding:
    return Finding(
        "board_sags",
        "The board bends with its weight as the robot turns it: level it is bowed otherwise than "
        f"upright, by {figure(1e3 * sags.bow_m(values))} mm between its highest and its lowest "
        "corner. It was taken out of the corners, and the result is that of the board as it is "
        "upright.",
        Remedy(
            "Glue the board to a stiff plate (aluminium or glass of 5 mm or more), or lay it down "
            "and put the camera on the flange; or hold it upright in all views."
        ),
    )


def pane_finding(window: Window, values: FloatArray) -> Finding:
    """Finding on a pane by its (3,) values; on the lens, of one that is tilted as no pane is."""
    thick_m, normal = window.pane(values)
    if normal[2] < _STEEPEST:
        return Finding(
            "lens_field",
            "The lens departs from its model, on one side of the image otherwise than on the "
            "other. It was taken out of the corners, and the result belongs to this lens.",
            Remedy(_OTHER_MODEL),
        )
    shift_mm = 1e3 * thick_m * nearer(np.array([[0.0, 0.0, 1.0]]), normal)[0]
    tilt = f"{np.rad2deg(np.arccos(normal[2])):.0f} deg"
    where = ", ".join(f"{part:.1f}" for part in shift_mm.tolist())
    return Finding(
        "window",
        "The camera looks through a tilted pane of glass, as of a housing or a mirror's front: "
        f"about {figure(1e3 * thick_m)} mm thick, tilted by {tilt}. It was taken out of the "
        "corners, and the result is of the place from which the lens seems to look through it, "
        f"({where}) mm from where it is, along its own axes. It holds for looks through this pane.",
        Remedy(
            "Take the pane away, or put it square to the line of sight, and record again; or "
            "leave it as it is, and look with the middle of the image."
        ),
    )


def changed_lens(run: RunState, step: Step) -> Finding:
    """The finding that a lens changed at once, by a step of what the robot's motion shows."""
    share, *shift = step.value.tolist()
    x_px, y_px = run.assessment.fit.camera(step.of).matrix[:2] * shift
    zoom = Zoom(step.stop, share, (float(x_px), float(y_px)))
    return replace(_zoomed(run, step.of, zoom, step.gain), consequence="")


def _lens_words(fit: Fit, camera: str) -> str:
    return "The lens" if len(fit.sigmas_px) == 1 else f"The lens of {camera}"


def _zoomed(run: RunState, camera: str, zoom: Zoom, gain: float) -> Finding:
    """The finding that a lens changed by more than one that warms up."""
    instead, cell = run.cell_fit.sizes.instead_of(zoom.kind), run.cell_fit.cell
    of = _lens_words(run.assessment.fit, camera)
    share = f"{figure(100.0 * abs(zoom.share))} % "
    share += "longer" if zoom.share > 0.0 else "shorter"
    words = f"{of} crept, as where focus or zoom give way: its focal length became {share}."
    do = Remedy("Fix zoom and focus, and record again.")
    if zoom.station is not None:
        first = cell.start_words(zoom.station)
        do = cell.or_separately("Fix zoom and focus", zoom.station)
        words = f"{of} changed at once, as where it was zoomed, refocused or hit: {first}, "
        # Corners are a quarter of the width from the centre, on average.
        by_zoom_px = 0.25 * abs(zoom.share) * run.assessment.fit.camera(camera).resolution[0]
        shift_px, (x_px, y_px) = float(np.hypot(*zoom.shift_px)), map(figure, zoom.shift_px)
        words += f"its focal length is {share}"
        if shift_px > by_zoom_px:
            words += f" and its centre ({x_px}, {y_px}) px from where it was"
        words += "."
        if zoom.kind == "lens changes":
            is_longer = abs(zoom.share) > _ALONE
            words = f"{of} changed at once: {first}, its distortion is another one"
            words += f" and its focal length {share}" * is_longer
            words += f", as where {'it was zoomed or refocused, ' * is_longer}pictures are "
            words += "rectified in one part alone, or another lens was put on."
            do = cell.or_separately(_ONE_LENS, zoom.station)
        elif shift_px > min(_SHIFTED_PX, CLEAR_RATIO * by_zoom_px) and not instead:
            keep = "Keep one region of interest" if shift_px > _SHIFTED_PX else "Fix the lens"
            do = cell.or_separately(keep, zoom.station)
            return _shifted(of, zoom, f"{first}, ", do, gain)
    counts = "The result counts it as scatter."
    return Finding("focus", words, do, mahalanobis_sq=gain, consequence=counts, rivals=instead)


def _shifted(of: str, zoom: Zoom, first: str, do: Remedy, gain: float) -> Finding:
    """The finding that images are shifted from some view on."""
    x_px, y_px = map(figure, zoom.shift_px)
    words = f"{first[0].upper()}{first[1:]}the images are shifted by ({x_px}, {y_px}) px, as where "
    if np.hypot(*zoom.shift_px) > _SHIFTED_PX:
        words += "another part of the sensor is read (a region of interest), or "
    return Finding(
        "image_shifted",
        f"{words}{of[0].lower()}{of[1:]} was hit.",
        do,
        mahalanobis_sq=gain,
    )


def _of_fisheye(run: RunState, name: str, of: str) -> Finding | None:
    """The finding that an estimated lens is a fisheye lens; None where that fits no better."""
    look = run.cameras.get(name)
    if look is None or look.resolution is None or look.lens is None:
        return None
    if not look.lens.estimated or look.table.model == "fisheye":
        return None
    targets = tuple(run.session.boards.values())
    used = {view: px for view, px in look.corners.items() if view in run.used}
    # A wide view that another model cannot explain is left out, and would tell the most.
    for corners in (used, look.corners)[: 1 + (len(used) < len(look.corners))]:
        try:
            taken, fisheye = (
                estimate_intrinsics(corners, targets, look.resolution, model)
                for model in (look.table.model, "fisheye")
            )
        except VisioncalError:
            continue
        taken_px, fisheye_px = taken.sigma_px, fisheye.sigma_px
        gained_px = np.sqrt(max(taken_px**2 - fisheye_px**2, 0.0))
        px = np.concatenate([seen.px for seen in corners.values()])
        is_clear = gained_px >= _LEAST_MOVE_PX or fisheye_px * _FAR_BETTER <= taken_px
        is_better = fisheye_px * _BETTER <= taken_px and is_clear
        if is_better and _bends(fisheye.camera, px):
            return Finding(
                "lens_model",
                f"{of} is of another model: as a fisheye lens it leaves corners "
                f"{figure(fisheye_px)} px from any pose of the board, and {figure(taken_px)} px as "
                f"the model {look.table.model}.",
                Remedy('In session.toml, write model = "fisheye" in [camera].', CALIBRATE),
            )
    return None


def _bends(lens: Camera, px: FloatArray) -> bool:
    """Whether a fisheye lens is nearer to one than to a lens that keeps straight lines straight.

    At the farthest of (n, 2) pixels: its radius is that of the angle, or that of its tangent.
    """
    off = (px - lens.matrix[2:]) / lens.matrix[:2]
    farthest = int(np.argmax(np.sum(off**2, axis=1)))
    tangent = float(np.linalg.norm(normalise(lens, px[[farthest]])))
    return bool(np.linalg.norm(off[farthest]) < (np.arctan(tangent) + tangent) / 2.0)


# A held lens that the corners contradict looks like a board of another size or shape, and, by the
# views' postures, like arm errors; the lens is tested beside all three.
LENS = Suspect(
    "lens",
    _stated,
    1e-4,
    True,
    ("board_size", "board_shape", ARM_ERRORS, "corner_noise", UNEXPLAINED),
)
FIELD = Suspect("lens_field", _beyond, 1e-4, True)
# A look is off by what the focus changes, however well the robot repeats.
FOCUS = Suspect("focus", None, 1e-4, True, inflates=("robot_noise",))
SHIFTED = Suspect(
    "image_shifted",
    None,
    1e-4,
    True,
    ("moved_at_once", "something_moved", "place", ARM_ERRORS, UNEXPLAINED),
    INFLATED,
)
MOTION = Suspect("row_motion", _moving, 1e-4, True)
WINDOW = Suspect("window", _seen_through, 1e-4, True)
SWELLS = Suspect("board_swells", None, 1e-4, True)
SAGS = Suspect("board_sags", None, 1e-4, True)
MODEL = Suspect("lens_model", None, 1e-4, True, hides=("lens_field", "focus"))
