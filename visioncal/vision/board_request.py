"""Options that describe a board."""

from dataclasses import dataclass

from visioncal.core.options import flag, option


@dataclass(frozen=True)
class BoardRequest:
    """Requirements of a board; None and empty texts are chosen automatically."""

    kind: str = option(
        "Kind of the board.",
        metavar="charuco|checkerboard|aprilgrid|gridboard|circles|dots|marker",
        default="",
    )
    columns: int | None = option("Squares along x; inner corners of a checkerboard, tags, circles.")
    rows: int | None = option("The same along y.")
    square_mm: float | None = option(
        "Side of a square, or distance of circles' rows; else the largest."
    )
    marker_mm: float | None = option("Side of the markers of a ChArUco board.")
    dictionary: str = option("As DICT_5X5_100, DICT_APRILTAG_36h11.", default="")
    legacy: bool = flag("The ChArUco layout from before OpenCV 4.6.")
    marker_id: int | None = option("Id of a single marker; the first of a board.", "--id")
    size_mm: float | None = option("Side of a single marker or a tag; left out: the largest.")
    spacing: float | None = option("White between the markers of a grid, in their sides: 0.3.")
    border: int | None = option("Dark modules around their bits: 2, as Kalibr has it.")
    diameter_mm: float | None = option("Diameter of circles.")
    asymmetric: bool = flag("Every second row of circles is shifted by half.")
    width_mm: float | None = option("Printed width of a picture.")
    name: str = option("Name of a board described by options.", default="")

    @property
    def side_mm(self) -> float | None:
        """Side of a square, or of a single marker or a tag; None for the largest."""
        return self.square_mm if self.size_mm is None else self.size_mm
