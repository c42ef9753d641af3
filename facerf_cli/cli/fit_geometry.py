"""`facerf fit-geometry`: the face model fitted to photos, as files that other programs open."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from facerf_cli.cli.batch import BatchOptions, Item, Outcome, run_batch
from facerf_cli.cli.options import (
    DryRunOption,
    FaceModelOption,
    InputColourspaceOption,
    InputsArgument,
    JobsOption,
    OutputOption,
    OverwriteOption,
    settings_of,
)
from facerf_cli.cli.photo_options import (
    FaceOption,
    FittedFace,
    LandmarksOption,
    PhotoOptions,
    TextureSizeOption,
    face_model,
    facts_of,
    fit_faces,
    provenance,
    read_photo,
)
from facerf_cli.files.atomic import atomic_path

if TYPE_CHECKING:
    import numpy as np

    from facerf_cli.files.images import LinearImage
    from facerf_cli.files.meshes import TexturedMesh

_OUTPUTS = (
    "_texture.exr",
    "_texture.png",
    "_normals.exr",
    "_normals.png",
    "_mesh.glb",
    "_mesh.mtl",
    "_mesh.obj",
    "_overlay.jpg",
    "_fit.npz",
)


@dataclass(frozen=True)
class _FitGeometry:
    """Fits one item and writes it; settings only."""

    photo: PhotoOptions

    def outputs_of(self, item: Item) -> list[Path]:
        """Every file of an item's (first) face."""
        return [item.output(self.photo.first_tag + ending) for ending in _OUTPUTS]

    def __call__(self, item: Item) -> Outcome:
        """Fit every face that was asked for."""
        image = read_photo(item, self.photo)
        faces = fit_faces(item, image, self.photo)
        for face in reversed(faces):
            self._write(item, image, face)
        written = [item.output(face.tag + ending) for face in faces for ending in _OUTPUTS]
        return Outcome(written, facts_of(faces))

    def _write(self, item: Item, image: "LinearImage", face: FittedFace) -> None:
        from facerf_cli.colour import srgb_to_linear
        from facerf_cli.face.drawings import draw_fit
        from facerf_cli.face.fit import save_fit
        from facerf_cli.face.landmarks import to_display
        from facerf_cli.files.images import write_display, write_exr
        from facerf_cli.files.meshes import write_glb, write_obj

        def path(ending: str) -> Path:
            return item.output(face.tag + ending)

        metadata = provenance(item, self.photo)
        visible = face.texture.visible.numpy()
        texture, normals = (
            tensor.permute(1, 2, 0).numpy() for tensor in (face.texture.texture, face.texture.normals)
        )
        write_exr(path("_texture.exr"), texture, layers={"visible": visible}, metadata=metadata)
        write_display(path("_texture.png"), texture, "auto", metadata=metadata)
        write_exr(path("_normals.exr"), normals, metadata=metadata)
        write_display(path("_normals.png"), srgb_to_linear(0.5 + 0.5 * normals), metadata=metadata)
        mesh = self._mesh(face, to_display(texture), metadata)
        write_glb(path("_mesh.glb"), mesh)
        write_obj(path("_mesh.obj"), mesh, path("_texture.png").name)
        overlay = draw_fit(image.pixels, face.fit, face_model(self.photo))
        write_display(path("_overlay.jpg"), overlay, metadata=metadata)
        with atomic_path(path("_fit.npz")) as temporary:
            save_fit(temporary, face.fit, metadata)

    def _mesh(self, face: FittedFace, texture_srgb: "np.ndarray", metadata: dict[str, Any]) -> "TexturedMesh":
        """The fitted mesh in the head's own frame; the fit holds its pose."""
        from facerf_cli.face.topology import grid_triangles, grid_uv
        from facerf_cli.files.meshes import TexturedMesh
        from facerf_cli.raster.texture import vertex_normals

        vertices = face_model(self.photo).vertices(face.fit.alpha[None], face.fit.beta[None])[0]
        return TexturedMesh(
            vertices_m=vertices.numpy(),
            normals=vertex_normals(vertices, grid_triangles()).numpy(),
            triangles=grid_triangles().numpy(),
            uv=grid_uv().numpy(),
            texture_srgb=texture_srgb,
            metadata=metadata,
        )


def fit_geometry(
    context: typer.Context,
    inputs: InputsArgument,
    output: OutputOption,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    texture_size: TextureSizeOption = 256,
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
) -> None:
    """Fit the face model to photos: mesh, texture, normals, and a picture of the fit.

    For each photo: _fit.npz (pose, shape, crop), _mesh.glb and _mesh.obj (metres, the head upright),
    _texture.exr and .png (in UV; the EXR's layer 'visible' says what the photo shows), _normals.exr (camera
    space) and .png, and _overlay.jpg, the mesh over the photo. The report holds each fit's error (a share of
    the distance between the outer eye corners), its quality (good, fair, poor) and the pose.
    """
    photo = PhotoOptions(settings_of(context), input_colourspace, face_model, face, landmarks, texture_size)
    photo.check()
    work = _FitGeometry(photo)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    raise typer.Exit(run_batch("fit-geometry", inputs, work, work.outputs_of, options, photo.settings))
