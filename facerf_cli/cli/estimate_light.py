"""`facerf estimate-light`: the light of a photo, as a map, as numbers and as a picture."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from facerf_cli.baselines import Kind
from facerf_cli.cli.batch import BatchOptions, Item, Outcome, run_batch
from facerf_cli.cli.light_options import LightOptions, Refine, estimate_light_of
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
    fit_faces,
    load_models_once,
    provenance,
    read_photo,
)
from facerf_cli.errors import UsageError

if TYPE_CHECKING:
    from facerf_cli.files.images import LinearImage

_OUTPUTS = ("_light.exr", "_light.json", "_light.png")
_MOST_ORDER = 20


@dataclass(frozen=True)
class EstimateLight:
    """Estimates the light of one photo and writes it; settings only."""

    options: LightOptions
    width_px: int
    sh_order: int

    def outputs_of(self, item: Item) -> list[Path]:
        """Every file of an item's (first) face."""
        return [item.output(self.options.photo.first_tag + ending) for ending in _OUTPUTS]

    def __call__(self, item: Item) -> Outcome:
        """Estimate the light of every face that was asked for."""
        image = read_photo(item, self.options.photo)
        faces = fit_faces(item, image, self.options.photo)
        facts = [self._write(item, image, face) for face in reversed(faces)][::-1]
        written = [item.output(face.tag + ending) for face in faces for ending in _OUTPUTS]
        return Outcome(written, facts[0] if len(facts) == 1 else {"faces": facts})

    def _write(self, item: Item, image: "LinearImage", face: FittedFace) -> dict[str, Any]:
        from facerf_cli.cli.items.light_image import draw_estimate
        from facerf_cli.files.images import write_display, write_exr
        from facerf_cli.files.light_files import Harmonics, LightRecord, write_light
        from facerf_cli.light.rig_latlong import rig_to_latlong
        from facerf_cli.light.sh import CONVENTION, rig_coefficients

        estimate = estimate_light_of(item.input_path, image, face, self.options)
        models = load_models_once(self.options.photo)
        said = {f"facerf:light_{name}": _word(value) for name, value in estimate.facts.items()}
        metadata = provenance(item, self.options.photo, models.checkpoint_name) | said
        envmap = rig_to_latlong(estimate.light, self.width_px // 2)
        base = item.output(f"{face.tag}_light")
        write_exr(base.with_name(base.name + ".exr"), envmap.numpy(), metadata=metadata)
        light, rig = estimate.light, f"--lights {self.options.rig}"
        harmonics = Harmonics(rig_coefficients(light, self.sh_order), CONVENTION)
        record = LightRecord(light.directions, light.weights, rig, harmonics, metadata)
        write_light(base.with_name(base.name + ".json"), record)
        shown = draw_estimate(face, models.face, estimate.explained, envmap)
        write_display(base.with_name(base.name + ".png"), shown, metadata=metadata)
        return face.facts() | estimate.facts


def _word(value: Any) -> str | int | float:
    """A fact in a file's header, which holds words and numbers."""
    return value if isinstance(value, (int, float, str)) else " ".join(map(str, value or ["none"]))


def estimate_light(
    context: typer.Context,
    inputs: InputsArgument,
    output: OutputOption,
    lights: Annotated[
        str,
        typer.Option("--lights", metavar="N|FILE", help="The rig over which the light is solved for."),
    ] = "150",
    non_negative: Annotated[
        bool,
        typer.Option(
            "--non-negative/--signed",
            help="Lights that shine, robust to highlights, hair and glasses; or the paper's plain least "
            "squares, whose weights may be negative and huge.",
        ),
    ] = True,
    refine: Annotated[
        Refine, typer.Option(help="Go on from the least squares by features of the texture.")
    ] = "none",
    vgg_weights: Annotated[
        str | None,
        typer.Option(
            metavar="imagenet|PATH",
            help="The paper's V_f for --refine features: fetched once (528 MiB), or a file.",
            show_default="S_f, the shipped network that knows where light comes from",
        ),
    ] = None,
    reflectance: Annotated[
        Kind, typer.Option(help="The model of the face; baselines estimate a light of their own.")
    ] = "field",
    keep_eyes: Annotated[
        bool, typer.Option("--keep-eyes", help="Let the eyes count too (the paper leaves them out).")
    ] = False,
    matte: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="What of the photo may be used (no hair, no glasses, say): a grey picture, or its alpha, "
            "of the photo's size. The photo's own alpha counts likewise.",
            show_default=False,
        ),
    ] = None,
    width: Annotated[
        int, typer.Option(min=16, max=8192, help="Of the map in pixels; the height is half.")
    ] = 512,
    sh_order: Annotated[
        int, typer.Option(min=0, max=_MOST_ORDER, help="Of the spherical harmonics in the JSON.")
    ] = 2,
    texture_size: TextureSizeOption = 256,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
) -> None:
    """Estimate the light of photos from how it falls on their faces.

    For each photo: _light.exr, a lat-long map for `relight --envmap`; _light.json, the lights that add up to
    it and their spherical harmonics; and _light.png: the photo, the face as this light explains it, where
    that is too bright (red) and too dark (blue), a mirror ball and a diffuse ball. The report holds the
    residual inside the mask, the brightest direction (azimuth, elevation) and the share of clipped texels.

    A face tells much of the light before it and little of that behind it. Brightness and colour of the light
    cannot be told from those of the skin; they are what the network takes the skin for.
    """
    if width % 2:
        raise UsageError(f"--width {width}: the height is half of it, so give an even number")
    photo = PhotoOptions(settings_of(context), input_colourspace, face_model, face, landmarks, texture_size)
    photo.check()
    how = LightOptions(photo, reflectance, lights, non_negative, refine, vgg_weights, keep_eyes, matte)
    how.check()
    work = EstimateLight(how, width, sh_order)
    if not dry_run:
        load_models_once(photo)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    raise typer.Exit(run_batch("estimate-light", inputs, work, work.outputs_of, options, photo.settings))
