"""`facerf relight`: photos, or stacks of predicted lights, under environment maps and lamps."""

import logging
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from facerf_cli.commands.batch import BatchOptions, Outcome, run_batch
from facerf_cli.commands.canvas import Backdrop, Canvas, read_matte
from facerf_cli.commands.inputs import Item
from facerf_cli.commands.options import (
    DryRunOption,
    FaceModelOption,
    InputColourspaceOption,
    InputsArgument,
    JobsOption,
    OutputOption,
    OverwriteOption,
    settings_of,
)
from facerf_cli.commands.photo import (
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
from facerf_cli.commands.shots import Sampling, Shot, collect_shots, light_photos, usable, write_balls
from facerf_cli.commands.values import numbers, parse_directions, parse_pose
from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.records import LOGGER_NAME

if TYPE_CHECKING:
    from torch import Tensor

    from facerf_cli.face.fit import FaceFit
    from facerf_cli.files.images import Picture

Composite = Literal["photo", "face"]
_HELD = 4  # relit textures are held this many times over while light is added to them
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class _Relight:
    """Relights one item under every shot; settings only."""

    photo: PhotoOptions
    shots: tuple[Shot, ...]
    rig: str
    sampling: Sampling
    pose: str | None
    composite: Composite
    surround: bool
    matte: Path | None
    exposure_ev: float | None  # None: auto
    memory_bytes: int

    def outputs_of(self, item: Item) -> list[Path]:
        """An EXR and a PNG a shot."""
        tag = self.photo.first_tag
        return [shot.output(item, tag, suffix) for shot in self.shots for suffix in (".exr", ".png")]

    def __call__(self, item: Item) -> Outcome:
        """Relight a photo."""
        picture = read_photo(item, self.photo)
        faces = fit_faces(item, picture, self.photo)
        outputs: list[Path] = []
        exposures_ev: dict[str, float] = {}
        for face in reversed(faces):
            for path, exposure_ev in self._relight_face(item, picture, face):
                outputs += [path, path.with_suffix(".png")]
                exposures_ev[path.stem] = exposure_ev
        return Outcome(outputs, facts_of(faces) | {"exposure_ev": exposures_ev})

    def _relight_face(self, item: Item, picture: "Picture", face: FittedFace) -> Iterator[tuple[Path, float]]:
        """Write every shot of a face; the EXR's path and the PNG's exposure of each."""
        from facerf_cli.pipeline import predict_olat, weigh_batches

        models = load_models_once(self.photo)
        size_px = picture.pixels.shape[0], picture.pixels.shape[1]
        vertices, turn = self._turned(face.fit, face.fit.vertices_camera(models.face))
        directions, weights = light_photos(self.shots, self.rig, self.sampling)
        canvas = Canvas(vertices, face.fit.crop, size_px, face.texture, self._backdrop(picture, size_px))

        def relit(rows: slice) -> "Tensor":
            olats = predict_olat(models, face.texture, directions, turn, self.memory_bytes)
            return weigh_batches(olats, weights[rows])

        metadata = provenance(item, self.photo, models.checkpoint_name)
        yield from self._write_shots(item, face, canvas, relit, metadata)

    def _turned(self, fit: "FaceFit", vertices: "Tensor") -> "tuple[Tensor, Tensor | None]":
        """The mesh [V, 3] in the target's pose, and the turn that brings it there, if there is one."""
        from facerf_cli.pipeline import turned

        rotation = parse_pose(self.pose)
        if rotation is None:
            return vertices, None
        turn, translation_m = turned(fit, rotation)
        return (vertices - translation_m) @ turn.mT + translation_m, turn

    def _backdrop(self, picture: "Picture", size_px: tuple[int, int]) -> Backdrop | None:
        if self.composite == "face":
            return None
        matte = None if self.matte is None else read_matte(self.matte, size_px)
        return Backdrop(picture, self.surround, matte)

    def _write_shots(
        self,
        item: Item,
        face: FittedFace,
        canvas: Canvas,
        relit: "Callable[[slice], Tensor]",
        metadata: dict[str, Any],
    ) -> Iterator[tuple[Path, float]]:
        """All shots, as many at a time as fit the memory; one prediction serves those."""
        at_once = max(1, self.memory_bytes // (_HELD * 4 * face.texture.texture.numel()))
        for first in range(0, len(self.shots), at_once):
            shots = self.shots[first : first + at_once]
            textures = relit(slice(first, first + at_once))
            exposures_ev = self._exposures_ev(shots, textures, face.texture.visible)
            for shot, texture in zip(shots, textures, strict=True):
                path = shot.output(item, face.tag, ".exr")
                canvas.write(path, texture, exposures_ev[shot.name], metadata)
                yield path, exposures_ev[shot.name]

    def _exposures_ev(self, shots: Iterable[Shot], textures: "Tensor", visible: "Tensor") -> dict[str, float]:
        """By name of the light: one for all its frames, so that a turning sky does not pump."""
        from facerf_cli.colour import auto_exposure_ev

        found: dict[str, float] = {}
        for shot, texture in zip(shots, textures, strict=True):
            exposure_ev = self.exposure_ev
            if exposure_ev is None:
                exposure_ev = auto_exposure_ev(texture.permute(1, 2, 0).numpy(), visible.numpy())
            found[shot.name] = min(exposure_ev, found.get(shot.name, exposure_ev))
        return found


def relight(
    context: typer.Context,
    inputs: InputsArgument,
    output: OutputOption,
    envmap: Annotated[
        list[str] | None,
        typer.Option(
            "--envmap",
            metavar="SKY.exr|DIR",
            help="Lat-long maps (.exr, .hdr), twice as wide as high: files, folders or quoted patterns. May "
            "be repeated; .exr and .hdr files that follow it directly are maps too.",
            show_default=False,
        ),
    ] = None,
    light: Annotated[
        list[str] | None,
        typer.Option(
            "--light",
            metavar="AZ,EL[,R,G,B][;...]",
            help="A picture under a single light from azimuth and elevation in degrees (AZ > 0: from the "
            "picture's right), or under several that shine together, with ; between them. May be repeated.",
            show_default=False,
        ),
    ] = None,
    lights: Annotated[
        str, typer.Option("--lights", metavar="N|FILE", help="The rig that maps are weighed over.")
    ] = "150",
    rotate: Annotated[
        str | None,
        typer.Option(
            "--rotate",
            metavar="DEG|FROM:TO:N",
            help="Turn the maps: DEG is added to every azimuth; or N frames .0000, .0001, ... (TO left out).",
            show_default="as they are",
        ),
    ] = None,
    pose: Annotated[
        str | None,
        typer.Option(
            metavar="YAW,PITCH,ROLL",
            help="Turn the head to this pose, in degrees; gives the face alone.",
            show_default="the photo's",
        ),
    ] = None,
    exposure: Annotated[
        str,
        typer.Option(
            metavar="EV|auto", help="Of the PNG; the EXR holds absolute light. auto: by the lit face."
        ),
    ] = "auto",
    composite: Annotated[
        Composite | None,
        typer.Option(
            help="The photo with its face relit, or the rendered face with alpha.",
            show_default="photo; face with --pose",
        ),
    ] = None,
    keep_background: Annotated[
        bool,
        typer.Option("--keep-background", help="Leave hair and background as they are, bit for bit."),
    ] = False,
    matte: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="What the light may change: a grey picture (or its alpha) of the photo's size.",
            show_default=False,
        ),
    ] = None,
    ball: Annotated[
        bool, typer.Option("--ball", help="Also a mirror ball and a diffuse ball under each map.")
    ] = False,
    envmap_sampling: Annotated[
        Sampling,
        typer.Option(help="A light takes the map's integral over its cell, or, as in the paper, one pixel."),
    ] = "cell",
    texture_size: TextureSizeOption = 256,
    memory: Annotated[float, typer.Option(metavar="GB", min=0.1, help="For the prediction, about.")] = 2.0,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
) -> None:
    """Relight photos under environment maps and single lights.

    Each picture is an EXR of absolute, scene-linear light, with the layers face.A (the face's soft mask),
    normal, position (camera space; metres) and uv, and a PNG at --exposure. One prediction serves all maps
    and rotations of a photo. Frame numbers at the end of a name (sky.0001.exr) stay there.
    """
    settings = settings_of(context)
    if pose is not None and composite == "photo":
        raise UsageError("--pose turns the head out of its photo; use --composite face with it")
    parse_pose(pose)
    parse_directions(lights)
    exposure_ev = None if exposure == "auto" else numbers(exposure, (1,), "--exposure")[0]
    photo = PhotoOptions(settings, input_colourspace, face_model, face, landmarks, texture_size)
    photo.check()
    asked = collect_shots(envmap or (), rotate, light or (), output)
    shots = usable(asked)
    if not shots:
        raise FacerfError("no map can be used")
    mode: Composite = composite or ("photo" if pose is None else "face")
    work = _Relight(
        photo,
        shots,
        lights,
        envmap_sampling,
        pose,
        mode,
        not keep_background,
        matte,
        exposure_ev,
        int(memory * 2**30),
    )
    if not dry_run:
        load_models_once(photo)
        if ball:
            write_balls(shots, output, exposure_ev, overwrite)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    code = run_batch("relight", inputs, work, work.outputs_of, options, settings)
    raise typer.Exit(max(code, int(len(shots) < len(asked))))
