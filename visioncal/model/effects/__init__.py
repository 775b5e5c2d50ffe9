"""Effects that move a frame, or change a lens, beside noise: one file a family.

Those that a finding names are in `NAMED`, too.
"""

from visioncal.model.effects.board_sags import BoardSags as BoardSags
from visioncal.model.effects.breathing import Breathing as Breathing
from visioncal.model.effects.clock import Clock as Clock
from visioncal.model.effects.creep import ArmGrows as ArmGrows
from visioncal.model.effects.creep import BaseCreeps as BaseCreeps
from visioncal.model.effects.creep import BaseSteps as BaseSteps
from visioncal.model.effects.creep import Creeps as Creeps
from visioncal.model.effects.creep import FrameCreeps as FrameCreeps
from visioncal.model.effects.creep import MountCreeps as MountCreeps
from visioncal.model.effects.creep import MountSteps as MountSteps
from visioncal.model.effects.creep import SightSteps as SightSteps
from visioncal.model.effects.effect import SIGNIFICANT as SIGNIFICANT
from visioncal.model.effects.effect import Displacement as Displacement
from visioncal.model.effects.effect import Effect as Effect
from visioncal.model.effects.effect import Named as Named
from visioncal.model.effects.effect import Size as Size
from visioncal.model.effects.effect import Stood as Stood
from visioncal.model.effects.focus_jitter import FocusJitter as FocusJitter
from visioncal.model.effects.heat import Heat as Heat
from visioncal.model.effects.joints_creep import JointsCreep as JointsCreep
from visioncal.model.effects.joints_creep import JointsStep as JointsStep
from visioncal.model.effects.lens_grows import LensGrows as LensGrows
from visioncal.model.effects.lens_sags import LensSags as LensSags
from visioncal.model.effects.lens_steps import LensChanges as LensChanges
from visioncal.model.effects.lens_steps import LensSteps as LensSteps
from visioncal.model.effects.links import Links as Links
from visioncal.model.effects.play import Play as Play
from visioncal.model.effects.posture import AxesSkew as AxesSkew
from visioncal.model.effects.posture import BaseTilts as BaseTilts
from visioncal.model.effects.posture import BracketBends as BracketBends
from visioncal.model.effects.posture import Stretches as Stretches
from visioncal.model.effects.posture import XStretches as XStretches
from visioncal.model.effects.posture import YStretches as YStretches
from visioncal.model.effects.posture import ZStretches as ZStretches
from visioncal.model.effects.rolling import Rolling as Rolling
from visioncal.model.effects.rolling import RowMotion as RowMotion
from visioncal.model.effects.springs import Springs as Springs
from visioncal.model.effects.springs import Weight as Weight
from visioncal.model.effects.stops_short import MovesOn as MovesOn
from visioncal.model.effects.stops_short import StopsShort as StopsShort
from visioncal.model.effects.swells import BoardSwells as BoardSwells
from visioncal.model.effects.window import Window as Window
from visioncal.model.effects.zeros import Zeros as Zeros

# From these follow the trial in every cell, the columns of the fit, covariance, budget and finding.
NAMED: tuple[type[Named], ...] = (
    BaseTilts,
    XStretches,
    YStretches,
    ZStretches,
    AxesSkew,
    BaseCreeps,
    MountCreeps,
    ArmGrows,
    JointsCreep,
    BracketBends,
    LensGrows,
    LensSags,
    StopsShort,
    MovesOn,
)
# All effects, by kind.
EFFECTS: dict[str, type[Effect]] = {
    each.kind: each
    for each in [*globals().values()]
    if isinstance(each, type) and issubclass(each, Effect) and hasattr(each, "kind")
}
