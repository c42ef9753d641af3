"""Options of `prepare-dataset` and `relight-dataset`; light to import."""

from dataclasses import dataclass

from facerf_cli.option import FACE, option

_DATASET, _PAIRS = "Dataset", "Pairs"  # panels of the help


@dataclass(frozen=True)
class DatasetSettings:
    """Settings of the contents of a dataset.

    Attributes:
        split: Sizes of training, validation and test: counts of subjects (300/10/40) or fractions; subjects
            are assigned at random by --seed.
        crop: Side of the crops, a multiple of 8.
        face_model: Morphable model to fit: builtin, or a .npz of `face-model import`.
    """

    split: str = option("0.8/0.1/0.1", metavar="T/V/T", panel=_DATASET)
    crop: int | None = option(
        None, metavar="PX", shown_default="256, or less where the face has fewer pixels", panel=_DATASET
    )
    face_model: str = option("builtin", metavar="NAME|PATH", panel=FACE)


@dataclass(frozen=True)
class PairSettings:
    """Which pairs to draw from a dataset.

    Attributes:
        envmaps: Lat-long maps (.exr, .hdr) of any size to relight with: a folder (walked recursively), a
            file, or N maps drawn from --seed.
        envmaps_test: Maps for the people of the split test; no other split uses them.
        per_subject: Number of images of each subject.
        lazy: Write only the recipes; training does not need the images.
    """

    envmaps: str = option(..., metavar="DIR|FILE|procedural:N", shown_default=False)
    envmaps_test: str | None = option(
        None,
        metavar="DIR|FILE|procedural:N",
        shown_default="one in ten of --envmaps",
        panel=_PAIRS,
    )
    per_subject: int = option(1000, metavar="N", panel=_PAIRS, least=1, most=100_000)
    lazy: bool = option(False, panel=_PAIRS)
