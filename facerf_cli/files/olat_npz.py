"""OLATs as arrays for NumPy: one .npz file, without pickles, written light by light."""

import zipfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from torch import Tensor

from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.olat_stack import StackHeader
from facerf_cli.files.write import half_floats, warn_of_clamped

_OF_STACK = ("kind", "directions", "rotation", "source", "seen", "normals", "layout_version")


def write_olat_npz(path: Path, header: StackHeader, olats: Iterable[Tensor]) -> None:
    """Write `olats` [L, H, W, 3] float16 from batches [l, 3, H, W] as they arrive, and the rest of a stack.

    Its other arrays have the names of `StackHeader`'s fields, those of the fit begin with `fit_`.
    """
    shape, beyond = (len(header.directions), *header.seen.shape, 3), 0
    rest = {name: getattr(header, name) for name in _OF_STACK}
    rest |= {f"fit_{name}": value for name, value in header.fit.items()} | header.metadata
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as file:
        with file.open("olats.npy", "w", force_zip64=True) as entry:
            description = {"descr": "<f2", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(entry, description)
            for batch in olats:
                data, clamped = half_floats(path, batch.permute(0, 2, 3, 1).cpu().numpy())
                beyond += clamped
                entry.write(data.astype("<f2").tobytes())
        for name, value in rest.items():
            with file.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asarray(value), allow_pickle=False)
    warn_of_clamped(path, beyond)
