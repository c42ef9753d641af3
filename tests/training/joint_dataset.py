"""A prepared dataset of four people under twenty lights with pairs, for the joint stage."""

from pathlib import Path

from facerf_cli.dataset.dataset import Dataset
from facerf_cli.dataset.pairs import draw_pairs, write_pairs
from facerf_cli.dataset.weights import envmap_names
from facerf_cli.synth.sky.skies import ProceduralMaps
from tests.dataset.dataset_fixture import write_small_dataset

CROP_PX, SIDE = 48, 32


def write_joint_dataset(folder: Path, crop_px: int = CROP_PX) -> Dataset:
    """Write the dataset and its pairs."""
    dataset = write_small_dataset(folder, lights=20, crop_px=crop_px)
    maps = envmap_names(ProceduralMaps(3, 0, 32))
    write_pairs(dataset, draw_pairs(dataset, maps, 6, 0), overwrite=False)
    return dataset
