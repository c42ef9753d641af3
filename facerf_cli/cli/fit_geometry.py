"""`facerf fit-geometry`: the face model fitted to photos, in common file formats."""

from dataclasses import dataclass

import typer

from facerf_cli.batch.inputs import Item
from facerf_cli.cli.options import InputsArgument
from facerf_cli.work.photo_options import FITTING
from facerf_cli.work.photo_work import FileOrFolder, PhotoWork, Written

_TEXTURES = ("_texture.exr", "_texture.png", "_normals.exr", "_normals.png")
_MESHES = ("_mesh.glb", "_mesh.mtl", "_mesh.obj")


@dataclass(frozen=True, kw_only=True)
class FitGeometry(PhotoWork):
    """`facerf fit-geometry`."""

    verb, endings, networks = "fit-geometry", (*_TEXTURES, *_MESHES, "_fit.jpg", "_fit.npz"), FITTING
    file_endings = ("_mesh.glb",)

    def write(self, item: Item) -> Written:
        """Fit every chosen face."""
        from facerf_cli.work.fit_geometry import write_fits

        return write_fits(item, self.photo)


def fit_geometry(inputs: InputsArgument, work: FitGeometry, batch: FileOrFolder) -> None:
    """Fit the face model to photos: mesh, texture, normals, and an overlay of the fit.

    Each photo gets _fit.npz (pose, shape, crop), _mesh.glb and _mesh.obj (metres, head upright), _texture.exr
    and .png (in UV space; the EXR's layer 'visible' marks visible texels), _normals.exr (camera space) and
    .png, and _fit.jpg, the mesh over the photo. The report contains each fit's error (relative to the
    distance between the outer eye corners), its quality (good, fair, poor) and the pose.
    """
    raise typer.Exit(work.run(inputs, batch))
