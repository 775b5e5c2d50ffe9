"""A cell whose arm warms up while it observes its board."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from visioncal.core.types import FloatArray
from visioncal.simulation.cell import SimulatedCell
from visioncal.simulation.heat import Heat, Warming, heated_flanges, warm_up
from visioncal.simulation.layout import CellOptions
from visioncal.simulation.observing import observed, simulate


@dataclass(frozen=True, eq=False)
class Round:
    """Schedule of views during a warm-up."""

    first: int = 24  # Number of different views at the start, before the arm is warm.
    references: int = 6  # Number of them that are repeated.
    every_s: float = 300.0  # Time between repetitions [s].
    minutes: float = 100.0  # Duration of the repetitions [min].
    pace_s: float = 5.0  # Time between views [s].

    def schedule(self) -> tuple[FloatArray, Sequence[int]]:
        """(m,) times [s], and indices of the views."""
        stamps = list(self.pace_s * np.arange(self.first))
        shown = list(range(self.first))
        again = np.linspace(0, self.first - 1, self.references).astype(int).tolist()
        for begin in np.arange(self.every_s, 60.0 * self.minutes, self.every_s):
            stamps += list(begin + self.pace_s * np.arange(self.references))
            shown += again
        return np.array(stamps), shown


@dataclass(frozen=True, eq=False)
class WarmUpOptions:
    """Options of a cell whose arm warms up."""

    cell: CellOptions = field(default_factory=CellOptions)  # The cell.
    heat: Heat | None = None  # Thermal parameters of the arm; None draws them by the cell's seed.
    round: Round = field(default_factory=Round)  # Schedule of views.
    hours: float = 5.0  # Duration of the temperature record [h].
    temperatures: bool = True  # Whether the controller reports temperatures; otherwise currents.

    @property
    def heats(self) -> Heat:
        """Thermal parameters of the arm."""
        return self.heat or Heat.drawn(self.cell.seed)

    def warming(self) -> Warming:
        """Temperatures over the whole duration."""
        return warm_up(self.heats, self.hours, seed=self.cell.seed)


def simulate_warm_up(options: WarmUpOptions) -> SimulatedCell:
    """Observes a cell's board while its arm warms up.

    Returns:
        The views, each with the arm's temperature at its time; temperatures or currents until the
        last view are in the stream `heat`.

    Raises:
        DataError: As `simulate`.
    """
    heat, warming = options.heats, options.warming()
    stamps_s, shown = options.round.schedule()
    postures = simulate(replace(options.cell, views=options.round.first)).robot.joints
    cold = simulate(options.cell, postures[list(shown)])
    robot, links_c = cold.robot, warming.at(stamps_s)
    warm_poses = heated_flanges(
        robot.true_arm, heat, robot.joints, links_c, robot.true_base_from_flange
    )
    warm = replace(cold, robots={"": replace(robot, true_base_from_flange=warm_poses)})
    return replace(
        observed(warm),
        stamps_s=stamps_s,
        streams={
            "heat": warming.recorded(temperatures=options.temperatures, until_s=float(stamps_s[-1]))
        },
        facts={"heat": asdict(heat)},
    )
