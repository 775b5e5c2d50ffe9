"""What is known of a session so far; every stage adds to it."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np

from visioncal.calibration import CameraResult, Rms, Verdict
from visioncal.estimation.appearance import Free
from visioncal.estimation.chain import chain, edge_names
from visioncal.estimation.parts import ROBOT, FramePrior
from visioncal.estimation.problem import Problem
from visioncal.estimation.scene import Scene
from visioncal.pipeline.visits import visits
from visioncal.robot import Convention, Loads, Robot
from visioncal.session import frame_name
from visioncal.session.loads import loads_of
from visioncal.stages.agree import Agreed
from visioncal.stages.arms import ArmFound, RobotArm
from visioncal.stages.diagnose import Diagnosis
from visioncal.stages.handeye import HandEyeResult
from visioncal.stages.judge import Findings
from visioncal.stages.measured import prior_of
from visioncal.stages.observed import Observed
from visioncal.stages.offset import Clock
from visioncal.stages.pnp import ViewPoses
from visioncal.stages.readings import Readings
from visioncal.stages.refine import Refined, remade
from visioncal.stages.reported import Reported
from visioncal.stages.validate import HeldOut
from visioncal.types import Corners, FloatArray, IntArray, SolverName


@dataclass(frozen=True, eq=False)
class Known(Observed):
    """Everything that is known of a session of one pair at some point of the way.

    Attributes:
        solver: The hand-eye solver asked for.
        boards: Which of the session's boards the chain holds: the one it ends at, and others.
        frames: (4, 4) where the camera and the boards are, by the frame; empty at first.
        readings: What an instrument read, where that is all that was observed.
        used: The views in the fit, in the session's order.
        candidates: The views that could be in the fit, if they agree.
        agreed: Which of them do.
        contradicted: Names of priors that they contradict, which are left out.
        free: Lens and board as all views see them together; None without corners.
        level: How far to go: `auto`, `hand-eye`, `offsets` or `kinematics`.
        convention: Of the joint table in which the arm is told; None for the stated one.
        calibrated: The robot's arm, as far as it was calibrated; None for not at all.
        hand_eye: Both unknown edges.
        diagnosis: What the residuals show beyond noise.
        arm_found: What the stops tell of a calibrated arm.
        held_out: Residuals of used views, left out of the fit.
        findings: What the verdict is made of.
        verdict: Whether to trust it all.
    """

    solver: SolverName = "joint"
    boards: tuple[int, ...] = (0,)
    frames: Mapping[str, FloatArray] = field(default_factory=dict)
    readings: Readings | None = None
    used: tuple[int, ...] = ()
    candidates: tuple[int, ...] = ()
    agreed: Agreed | None = None
    contradicted: frozenset[str] = frozenset()
    free: Free | None = None
    level: str = "auto"
    convention: Convention | None = None
    calibrated: RobotArm | None = None
    hand_eye: HandEyeResult | None = None
    diagnosis: Diagnosis | None = None
    arm_found: ArmFound = field(default_factory=ArmFound)
    held_out: HeldOut | None = None
    findings: Findings | None = None
    verdict: Verdict | None = None

    @property
    def clock(self) -> Clock | None:
        """How the clocks of camera and robot go together; None where all poses were reported."""
        return next((it.clock for it in self.clocks.values()), None)

    @property
    def camera(self) -> CameraResult | None:
        """The intrinsics, where there are images."""
        return next(iter(self.lenses.values()), None)

    @property
    def pixel_px(self) -> float | None:
        """Noise of a corner's coordinate [px]."""
        return next((it.pixel_px for it in self.cameras.values()), None)

    def with_noise(self, pixel_px: float) -> Self:
        """Takes over the noise of corners."""
        cameras = {it: replace(look, pixel_px=pixel_px) for it, look in self.cameras.items()}
        return replace(self, cameras=cameras)

    def agreeing(self, agreed: Agreed) -> Self:
        """Takes the candidates that agree into the fit; the others are rejected."""
        used = tuple(it for it, ok in zip(self.candidates, agreed.mask, strict=True) if ok)
        reasons = {it: why for it, why in self.reasons.items() if it not in self.candidates}
        known = replace(self, used=used, agreed=agreed, reasons=reasons, frames=agreed.frames)
        return known.noting(agreed.rejections)

    def seeing(self, refined: Refined) -> Self:
        """Takes over lens, board and poses, and makes the poses of all other views anew."""
        seen = {it.view: it for it in refined.views}
        known = replace(self.with_noise(refined.sigma_px), free=refined.free)
        known = replace(known, calibrated=self.robot_arm.erring(refined.arm))
        known = known.posed([it for view, it in self.poses.items() if view not in seen])
        return replace(known, poses={**known.poses, **seen})

    def posed(self, poses: Iterable[ViewPoses]) -> Self:
        """Takes over poses, made anew by lens and board where their view has just one."""
        given = {it.view: it for it in poses}
        if self.free is not None and self.pixel_px is not None:
            single = [
                it
                for it in given.values()
                if it.corners is not None and len(it.cam_from_target) == 1
            ]
            given |= {it.view: it for it in remade(single, self.free, self.pixel_px)}
        return replace(self, poses={**self.poses, **given})

    @property
    def poses_of_one_board(self) -> Mapping[int, ViewPoses]:
        """The poses of the board that most views show: those of different ones do not compare."""
        shown = [it.board for it in self.poses.values()]
        most = max(sorted(set(shown)), key=shown.count, default=0)
        return {view: it for view, it in self.poses.items() if it.board == most}

    @property
    def reported(self) -> Reported:
        """What its rows report of the robot."""
        return next(iter(self.robots.values()), Reported({}))

    @property
    def base_from_flange(self) -> Mapping[int, FloatArray]:
        """(4, 4) by view, as the robot reported it."""
        return self.reported.base_from_flange

    @property
    def robot(self) -> Robot | None:
        """The nominal robot, where the session names a known one."""
        matched = self.reported.matched
        return None if matched is None else matched.robot

    @cached_property
    def robot_arm(self) -> RobotArm:
        """The robot's arm; its stops are all views with a pose, in their order."""
        if self.calibrated is not None:
            return self.calibrated
        rows = {it.number: it for it in self.session.views}
        return RobotArm.of(
            ROBOT,
            np.array([*self.base_from_flange.values()]).reshape(-1, 4, 4),
            [rows[it] for it in self.base_from_flange],
            self.reported.matched,
            (self.session, next(iter(self.robots), "")),
        )

    def arm_at(self, views: Sequence[int]) -> RobotArm:
        """The robot's arm at some views."""
        return self.robot_arm.at(np.array([self._places[it] for it in views], dtype=np.int64))

    @property
    def arm_at_stops(self) -> RobotArm:
        """The robot's arm at the stops of the used views, by the first view of each."""
        return self.arm_at(self.first_of_stops(self.used))

    @cached_property
    def _places(self) -> Mapping[int, int]:
        return {view: at for at, view in enumerate(self.base_from_flange)}

    @property
    def scene(self) -> Scene | None:
        """What is looked at, and with what; None where there are no corners."""
        return next(iter(self.scenes.values()), None)

    @property
    def measurable_held_back(self) -> frozenset[int]:
        """Those of them whose chain can be closed."""
        return frozenset(
            view
            for view in self.held_back & self.poses.keys() & self.base_from_flange.keys()
            if self.poses[view].board in self.boards
        )

    @property
    def priors(self) -> tuple[FramePrior, ...]:
        """What is known of the edges besides, as far as views do not contradict it."""
        return tuple(it for it in self.stated_priors if it.name not in self.contradicted)

    @property
    def stated_priors(self) -> tuple[FramePrior, ...]:
        """What is stated of the edges besides; a closed form has no use for it."""
        tables = self.session.declaration.prior if self.solver == "joint" else {}
        return tuple(
            prior_of(it, tables[it]) for it in self.edge_names(self.boards) if it in tables
        )

    def edge_names(self, boards: Iterable[int]) -> tuple[str, ...]:
        """The names of the edges of the camera and of some of the session's boards."""
        camera, target = edge_names(self.session.mount)
        parent = target.partition("_from_")[0]
        return (camera, *(f"{parent}_from_{self.frame_of(it)}" for it in boards))

    def problem(self, views: Sequence[int]) -> Problem:
        """What some views measured, each with its first or chosen pose."""
        poses, first = [self.poses[view] for view in views], self.first_of_stops(views)
        covariance, effects, arm = None, [], self.arm_at(first)
        if self.readings is not None:
            covariance = np.array([it.covariance[0] for it in poses])
            effects = self.readings.effects(poses)
        elif self.free is not None:
            # Poses that others have measured do not move with lens and board.
            shift = np.zeros((len(poses), 6, len(self.free.columns)))
            if all(it.corners is not None for it in poses):
                shift = np.array([it.by_shared[0] for it in poses]).reshape(shift.shape)
            effects = [self.free.effect(shift)]
        if self.readings is None and all(it.corners is not None for it in poses):
            covariance = np.array([it.covariance[0] for it in poses]).reshape(-1, 6, 6)
        if self.clock is not None and self.clock.speeds:
            of_stops = np.isin(views, first)
            erring = arm.frees_errors()
            effects += [it.of_stops(of_stops) for it in self.clock.effects(views, erring=erring)]
        effects += arm.effects()
        return chain(
            self.session.mount,
            self.flange_poses(first),
            np.array([it.cam_from_target[0] for it in poses]).reshape(-1, 4, 4),
            covariance,
            stops=self.stops_of(views),
            targets=self.targets(views),
            order=[self.frame_of(it) for it in self.boards],
            # What is shared counts from where it is.
            effects=[replace(it, values=np.zeros(len(it))) for it in effects],
            priors=self.priors,
            turned_by_choice=self.readings is not None and not self.readings.are_poses,
        )

    def targets(self, views: Sequence[int]) -> tuple[str, ...]:
        """(m,) the frame of the target that each view shows."""
        return tuple(self.frame_of(self.poses[view].board) for view in views)

    def frame_of(self, board: int) -> str:
        """The frame of one of the session's boards."""
        if len(self.session.boards) < 2:
            return edge_names(self.session.mount)[1].partition("_from_")[2]
        return frame_name("target", tuple(self.session.boards)[board])

    def framed(self, edges: FloatArray) -> dict[str, FloatArray]:
        """Where frames are, by (1 + b, 4, 4) edges of the camera and the chain's boards."""
        frames = (self.camera_frame, *map(self.frame_of, self.boards))
        return dict(zip(frames, edges, strict=True))

    @property
    def camera_frame(self) -> str:
        """The frame of the camera, or of the instrument."""
        return edge_names(self.session.mount)[0].partition("_from_")[2]

    def first_of_stops(self, views: Sequence[int]) -> list[int]:
        """(s,) the first view of each stop."""
        first = np.unique(self.stops_of(views), return_index=True)[1]
        return [views[it] for it in first.tolist()]

    def flange_poses(self, views: Sequence[int]) -> FloatArray:
        """(m, 4, 4) `base_from_flange`: as reported, or as the calibrated arm has it."""
        return self.arm_at(views).poses

    def loads(self, views: Sequence[int]) -> Loads:
        """What the flange carried at some views, and from which side the joints came."""
        rows = {view.number: view for view in self.session.views}
        return loads_of(
            [rows[view].numbers for view in views],
            [rows[view].text.get("approach", "") for view in views],
        )

    def with_readings(self, readings: Readings) -> Self:
        """Takes over an instrument's readings, and makes their poses by the present arm."""
        views = [view for view in readings.read_m if view in self.base_from_flange]
        flange = dict(zip(views, self.flange_poses(views), strict=True))
        known = replace(self, readings=readings, poses=readings.poses(flange))
        return known.noting(readings.rejections)

    @property
    def estimates_looks(self) -> bool:
        """Whether the views have to tell the first effect.

        That is lens and board where the lens was estimated, or the places of further points on the
        flange.
        """
        if self.readings is not None:
            return not self.readings.are_poses and len(self.readings.names) > 1
        told = self.camera is not None and self.camera.estimated
        return told and self.free is not None and len(self.free.columns) > 0

    @property
    def stops(self) -> IntArray:
        """(m,) which stop of the robot each used view was taken at; see `stops_of`."""
        return self.stops_of(self.used)

    def stops_of(self, views: Sequence[int]) -> IntArray:
        """(m,) which stop of the robot each view was taken at, numbered from 0.

        Views of one stop share the robot's error. Where the session does not number its stops,
        views with the same reported pose and load are of one, and those between which the robot
        stood still. Poses that were measured by others are not told apart from the robot's: of
        several boards, each has stops of its own then.
        """
        visited = self._visits
        loads = self.loads(views).rows
        keys: dict[object, int] = {}
        stops = np.array(
            [
                keys.setdefault(
                    (visit, load.tobytes()) if isinstance(visit := visited[view], tuple) else visit,
                    len(keys),
                )
                for view, load in zip(views, loads, strict=True)
            ],
            dtype=np.int64,
        )
        if len(self.boards) < 2 or all(self.poses[view].corners is not None for view in views):
            return stops
        of_board: dict[tuple[int, int], int] = {}
        both = zip(stops.tolist(), (self.poses[view].board for view in views), strict=True)
        return np.array([of_board.setdefault(it, len(of_board)) for it in both], dtype=np.int64)

    @cached_property
    def _visits(self) -> Mapping[int, object]:
        return visits(self.session.views, self.base_from_flange)

    def seen(self, views: Sequence[int]) -> list[Corners | None]:
        """The corners of some views that their poses were made from."""
        return [self.poses[view].corners for view in views]

    @property
    def robot_noise(self) -> FloatArray | None:
        """(2,) noise of the flange [rad, m]; None where it cannot be told from the camera's."""
        return None if self.solved.problem.is_combined else self.solved.noise.robots[0]

    @property
    def solved(self) -> HandEyeResult:
        """Both unknown edges.

        Raises:
            RuntimeError: A stage asks for them before they are solved for: the order is wrong.
        """
        if self.hand_eye is None:
            raise RuntimeError("a stage that needs the hand-eye result comes before it")
        return self.hand_eye


def rms_of(away_m: FloatArray, away_rad: FloatArray, rms_px: FloatArray) -> Rms:
    """Root mean squares over views [m, rad, px]; what a view does not tell is NaN."""
    away_m, turns_rad, seen = (it[np.isfinite(it)] for it in (away_m, away_rad, rms_px))
    return Rms(
        mm=float(1e3 * np.sqrt(np.mean(away_m**2))),
        deg=float(np.rad2deg(np.sqrt(np.mean(turns_rad**2)))) if len(turns_rad) else None,
        px=float(np.sqrt(np.mean(seen**2))) if len(seen) else None,
    )
