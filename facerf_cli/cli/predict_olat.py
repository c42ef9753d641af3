"""`facerf predict-olat`: a photo's face under every light of a rig, as an OLAT stack."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

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
    facts_of,
    fit_faces,
    load_models_once,
    provenance,
    read_photo,
)
from facerf_cli.cli.values import parse_directions, parse_pose

if TYPE_CHECKING:
    import numpy as np
    from torch import Tensor

    from facerf_cli.face.fit import FaceFit
    from facerf_cli.files.olat_stack import StackHeader

Precision = Literal["float32", "bf16"]
_TILE_PX = 128  # of the contact sheet


@dataclass(frozen=True)
class _PredictOlat:
    """Predicts one item's stack and contact sheet; settings only."""

    photo: PhotoOptions
    lights: str
    pose: str | None
    image: bool
    memory_bytes: int
    precision: Precision

    def outputs_of(self, item: Item) -> list[Path]:
        """The stack and its contact sheet."""
        return self._outputs(item, self.photo.first_tag)

    def _outputs(self, item: Item, tag: str) -> list[Path]:
        return [item.output(f"{tag}_olat.exr"), item.output(f"{tag}_olat.png")]

    def __call__(self, item: Item) -> Outcome:
        """Predict every face that was asked for."""
        from facerf_cli.files.images import write_display
        from facerf_cli.files.olat_stack import write_olat_stack

        directions = parse_directions(self.lights)
        faces = fit_faces(item, read_photo(item, self.photo), self.photo)
        outputs: list[Path] = []
        for face in reversed(faces):
            stack, sheet = self._outputs(item, face.tag)
            header = self._header(item, face, directions)
            tiles: list[np.ndarray] = []
            write_olat_stack(stack, header, self._olats(face, directions, tiles))
            write_display(sheet, _contact_sheet(tiles, header.directions), "auto", metadata=header.metadata)
            outputs += [stack, sheet]
        return Outcome(outputs, facts_of(faces) | {"lights": len(directions)})

    def _olats(self, face: FittedFace, directions: "Tensor", tiles: "list[np.ndarray]") -> "Iterator[Tensor]":
        """OLATs in batches [l, 3, H, W], textures or pictures; small pictures [l, h, w, 3] go to `tiles`."""
        from torch.nn.functional import avg_pool2d

        from facerf_cli.pipeline import explain_photo, predict_olat, render_face, turn_to

        models = load_models_once(self.photo)
        rotation = parse_pose(self.pose)
        turn = None if rotation is None else turn_to(face.fit, rotation)
        bf16, quotient = self.precision == "bf16", explain_photo(models, face.texture)
        large, small = self._see(face), self._see(face, 2 * _TILE_PX)
        olats = predict_olat(models, face.texture, directions, turn, self.memory_bytes, bf16, quotient)
        for textures in olats:
            tiles.append(avg_pool2d(render_face(textures, *small), 2).permute(0, 2, 3, 1).numpy())
            yield render_face(textures, *large) if self.image else textures

    def _see(self, face: FittedFace, side_px: int | None = None) -> "tuple[Tensor, Tensor]":
        """`see_face` in the asked pose, by the crop's camera, its picture `side_px` wide."""
        from facerf_cli.pipeline import see_face
        from facerf_cli.raster.camera import crop_camera

        vertices = self._posed(face).vertices_camera(load_models_once(self.photo).face)
        return see_face(vertices, crop_camera(side_px or face.fit.crop.size_px))

    def _posed(self, face: FittedFace) -> "FaceFit":
        rotation = parse_pose(self.pose)
        return face.fit if rotation is None else replace(face.fit, rotation=rotation)

    def _header(self, item: Item, face: FittedFace, directions: "Tensor") -> "StackHeader":
        import torch

        from facerf_cli.face.fit import fit_to_arrays
        from facerf_cli.face.topology import LAYOUT_VERSION
        from facerf_cli.files.olat_stack import StackHeader
        from facerf_cli.pipeline import render_face, turn_to

        posed, texture = self._posed(face), face.texture
        source, normals, seen = texture.texture, texture.normals, texture.visible
        if self.image:
            uv, seen = self._see(face)
            turn = turn_to(face.fit, posed.rotation)
            both = torch.stack([source, torch.einsum("dc,cij->dij", turn, normals)])
            source, normals = render_face(both, uv, seen)
        metadata = provenance(item, self.photo, load_models_once(self.photo).checkpoint_name)
        return StackHeader(
            kind="image" if self.image else "texture",
            directions=directions.numpy(),
            rotation=posed.rotation.numpy(),
            source=source.permute(1, 2, 0).numpy(),
            seen=seen.numpy(),
            normals=normals.permute(1, 2, 0).numpy(),
            layout_version=LAYOUT_VERSION,
            fit=fit_to_arrays(face.fit),
            metadata=metadata,
        )


def _contact_sheet(tiles: "list[np.ndarray]", directions: "np.ndarray") -> "np.ndarray":
    """Every light's picture, with a mark of where it stands."""
    import numpy as np

    from facerf_cli.files.drawings import contact_sheet, mark_light

    images = np.concatenate(tiles)
    white = float(np.percentile(images, 99.5))
    for image, direction in zip(images, directions, strict=True):
        mark_light(image, direction, white)
    return contact_sheet(images)


def predict_olat(
    context: typer.Context,
    inputs: InputsArgument,
    output: OutputOption,
    lights: Annotated[
        str,
        typer.Option(
            metavar="N|FILE|'AZ,EL;...'",
            help="A uniform rig of N lights, or directions in degrees: a text file of lines, or a list.",
        ),
    ] = "150",
    pose: Annotated[
        str | None,
        typer.Option(
            metavar="YAW,PITCH,ROLL", help="The head's pose, in degrees.", show_default="the photo's"
        ),
    ] = None,
    image: Annotated[
        bool, typer.Option("--image/--texture", help="Pictures of the face, or UV textures of it.")
    ] = False,
    texture_size: TextureSizeOption = 256,
    memory: Annotated[float, typer.Option(metavar="GB", min=0.1, help="For the prediction, about.")] = 2.0,
    precision: Annotated[Precision, typer.Option(help="Of the network's arithmetic.")] = "float32",
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
) -> None:
    """Predict a photo's face under every single light of a rig.

    Each photo gives an OLAT stack (one OpenEXR file, a part a light, with the fit in it; `facerf relight`
    takes it in a photo's place) and a contact sheet. Lights are fixed to the camera and of unit intensity:
    AZ > 0 lights the picture's right side, EL > 0 comes from above.
    """
    settings = settings_of(context)
    parse_directions(lights)
    parse_pose(pose)
    photo = PhotoOptions(settings, input_colourspace, face_model, face, landmarks, texture_size)
    photo.check()
    if not dry_run:
        load_models_once(photo)
    work = _PredictOlat(photo, lights, pose, image, int(memory * 2**30), precision)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    raise typer.Exit(run_batch("predict-olat", inputs, work, work.outputs_of, options, settings))
