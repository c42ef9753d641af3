"""`facerf fit-geometry`: the face model fitted to photos, as files that other programs open."""

from dataclasses import dataclass
from pathlib import Path

import typer

from facerf_cli.batch.inputs import Item, collect_items, file_pattern
from facerf_cli.batch.made_from import OneRecipe
from facerf_cli.batch.run import BatchOptions, Outcome, run_items
from facerf_cli.cli.options import (
    DryRunOption,
    FaceModelOption,
    InputColourspaceOption,
    InputsArgument,
    JobsOption,
    NameOption,
    OutputOption,
    OverwriteOption,
    settings_of,
)
from facerf_cli.cli.photo_options import (
    FITTING,
    FaceOption,
    GeometryOption,
    LandmarksFromOption,
    LandmarksOption,
    PhotoOptions,
    TextureSizeOption,
)

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
class FitGeometry:
    """Fits one item and writes it; settings only."""

    photo: PhotoOptions

    def outputs_of(self, item: Item) -> list[Path]:
        """Every file of an item's (first) face."""
        return [item.output(self.photo.first_tag + ending) for ending in _OUTPUTS]

    def __call__(self, item: Item) -> Outcome:
        """Fit every chosen face."""
        from facerf_cli.work.segment_and_fit import write_fits

        tags, facts = write_fits(item, self.photo)
        return Outcome([item.output(tag + ending) for tag in tags for ending in _OUTPUTS], facts)


def fit_geometry(
    context: typer.Context,
    inputs: InputsArgument,
    output: OutputOption,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    geometry: GeometryOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    texture_size: TextureSizeOption = None,
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
    name: NameOption = None,
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
) -> None:
    """Fit the face model to photos: mesh, texture, normals, and an overlay of the fit.

    For each photo: _fit.npz (pose, shape, crop), _mesh.glb and _mesh.obj (metres, the head upright),
    _texture.exr and .png (in UV space; the EXR's layer 'visible' marks what the photo shows), _normals.exr
    (camera space) and .png, and _overlay.jpg, the mesh over the photo. The report holds each fit's error (a
    share of the distance between the outer eye corners), its quality (good, fair, poor) and the pose.
    """
    photo = PhotoOptions(
        settings_of(context),
        input_colourspace,
        face_model,
        face,
        landmarks,
        geometry,
        texture_size,
        landmarks_from,
    )
    photo.check()
    work = FitGeometry(photo)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    items = collect_items(
        inputs, output, pattern=file_pattern(name), null_separated=photo.settings.null_separated
    )
    code = run_items(
        "fit-geometry",
        items,
        work,
        work.outputs_of,
        options,
        photo.settings,
        OneRecipe(work),
        prepare=photo.preparation(dry_run, FITTING),
    )
    raise typer.Exit(code)
