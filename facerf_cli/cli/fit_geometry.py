"""`facerf fit-geometry`: the face model fitted to photos, as files that other programs open."""

import typer

from facerf_cli.batch.run import BatchOptions
from facerf_cli.cli.options import InputsArgument
from facerf_cli.work.verbs import FitGeometry


def fit_geometry(
    inputs: InputsArgument,
    work: FitGeometry,
    batch: BatchOptions,
) -> None:
    """Fit the face model to photos: mesh, texture, normals, and an overlay of the fit.

    For each photo: _fit.npz (pose, shape, crop), _mesh.glb and _mesh.obj (metres, the head upright),
    _texture.exr and .png (in UV space; the EXR's layer 'visible' marks what the photo shows), _normals.exr
    (camera space) and .png, and _overlay.jpg, the mesh over the photo. The report holds each fit's error (a
    share of the distance between the outer eye corners), its quality (good, fair, poor) and the pose.
    """
    raise typer.Exit(work.run(inputs, batch))
