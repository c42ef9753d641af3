"""The figures of the paper's Tables 1 to 4 (paper, 'Results'), shown next to ours; measured on other data."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PublishedFigure:
    """A published figure: mean and standard deviation over images of one metric of one method.

    `group` is the fact and value of our figures that it is shown with ('pose', 'same pose'); None is all
    images. `source` and `data` name where it was published and what it was measured on.
    """

    method: str
    metric: str
    mean: float
    sd: float | None = None
    group: tuple[str, str] | None = None
    source: str = "the paper"
    data: str = "other data than ours"
    digits: int | None = None  # after the decimal point, as published; None: as ours

    def shown(self, digits: int) -> tuple[str, str]:
        """Format mean and standard deviation, with the published digits if they are known."""
        digits = digits if self.digits is None else self.digits
        return f"{self.mean:.{digits}f}", "" if self.sd is None else f"{self.sd:.{digits}f}"


_LIGHT_STAGE = "people in a light stage; other data than ours"
_CELEBA = "130 images of CelebA-HQ; other data than ours"
_TEST_SET = "86 light-stage images in natural light; other data than ours"
_METHODS = ("the paper's", "Smith et al.", "Schneider et al.", "Tewari et al.")
_SAME, _DIFFERENT = ("pose", "same pose"), ("pose", "different pose")


def _table_2(metric: str, data: str, figures: tuple[tuple[float, float], ...]) -> tuple[PublishedFigure, ...]:
    """A row of Table 2: mean and standard deviation of each of `_METHODS`."""
    return tuple(
        PublishedFigure(method, metric, mean, sd, None, "Table 2", data, 3)
        for method, (mean, sd) in zip(_METHODS, figures, strict=True)
    )


TABLE_1 = (
    PublishedFigure("the paper's", "si_mse", 0.00070, 0.00059, _SAME, "Table 1", _LIGHT_STAGE),
    PublishedFigure("the paper's", "si_mse", 0.00084, 0.00088, _DIFFERENT, "Table 1", _LIGHT_STAGE),
)
TABLE_2_RECONSTRUCTION = (
    *_table_2("si_mse", _CELEBA, ((0.004, 0.002), (0.017, 0.015), (0.010, 0.008), (0.007, 0.003))),
    *_table_2("face_distance", _CELEBA, ((0.550, 0.080), (0.650, 0.076), (0.685, 0.067), (0.762, 0.075))),
)
TABLE_2_TRANSFER = (
    *_table_2("si_mse", _TEST_SET, ((0.002, 0.001), (0.018, 0.011), (0.007, 0.005), (0.003, 0.001))),
    *_table_2("face_distance", _TEST_SET, ((0.482, 0.084), (0.605, 0.092), (0.644, 0.077), (0.689, 0.076))),
)
TABLE_3 = (
    PublishedFigure("without normals", "si_mse", 0.00113, 0.00093, _SAME, "Table 3", _LIGHT_STAGE),
    PublishedFigure("without normals", "si_mse", 0.00126, 0.00116, _DIFFERENT, "Table 3", _LIGHT_STAGE),
)
TABLE_4 = (
    PublishedFigure("all components", "si_mse", 0.004, 0.002, None, "Table 4", _CELEBA, 3),
    PublishedFigure("mean face", "si_mse", 0.011, 0.005, None, "Table 4", _CELEBA, 3),
    PublishedFigure("all components", "face_distance", 0.550, 0.080, None, "Table 4", _CELEBA, 3),
    PublishedFigure("mean face", "face_distance", 0.550, 0.073, None, "Table 4", _CELEBA, 3),
)
