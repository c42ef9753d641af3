"""What `facerf relight` does with one item: a photo, or an OLAT stack that was predicted before."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from facerf_cli.baselines import Kind
from facerf_cli.cli.batch import Item, Outcome
from facerf_cli.cli.items.relit_images import Backdrop, Canvas, ImageCanvas, read_matte
from facerf_cli.cli.lights import Sampling, Shot, light_photos, light_stack
from facerf_cli.cli.photo_options import (
    FittedFace,
    PhotoOptions,
    face_model,
    facts_of,
    fit_faces,
    load_models_once,
    provenance,
    read_photo,
)
from facerf_cli.cli.values import parse_pose
from facerf_cli.errors import InputError
from facerf_cli.logs import attributes_of_sum

if TYPE_CHECKING:
    from torch import Tensor

    from facerf_cli.baselines.base import Reflectance
    from facerf_cli.face.fit import FaceFit
    from facerf_cli.files.images import LinearImage
    from facerf_cli.files.olat_stack import OlatStack
    from facerf_cli.pipeline import Models

Composite = Literal["photo", "face"]
_HELD = 4  # relit textures are held this many times over while light is added to them
_LIGHTS_AT_ONCE = 16  # of a stack, made floats


@dataclass(frozen=True)
class Relight:
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
    asked_for_photo: bool  # --composite photo, in so many words
    reflectance: Kind = "field"

    def outputs_of(self, item: Item) -> list[Path]:
        """An EXR and a PNG a shot."""
        tag = self.photo.first_tag
        return [shot.output(item, tag, suffix) for shot in self.shots for suffix in (".exr", ".png")]

    def __call__(self, item: Item) -> Outcome:
        """Relight a photo or a stack."""
        from facerf_cli.files.olat_stack import is_olat_stack

        stack = item.input_path.suffix.lower() == ".exr" and is_olat_stack(item.input_path)
        written, facts = self._relight_stack(item) if stack else self._relight_photo(item)
        outputs = [path.with_suffix(suffix) for path in written for suffix in (".exr", ".png")]
        exposures_ev = {path.stem: exposure_ev for path, exposure_ev in written.items()}
        return Outcome(outputs, facts | {"exposure_ev": exposures_ev})

    def _relight_photo(self, item: Item) -> tuple[dict[Path, float], dict[str, Any]]:
        image = read_photo(item, self.photo)
        faces = fit_faces(item, image, self.photo)
        written: dict[Path, float] = {}
        for face in reversed(faces):  # the first one's files say that the photo is finished
            written.update(self._relight_face(item, image, face))
        return written, facts_of(faces)

    def _relight_face(
        self, item: Item, image: "LinearImage", face: FittedFace
    ) -> Iterator[tuple[Path, float]]:
        """Write every shot of a face; the EXR's path and the PNG's exposure of each."""
        models = load_models_once(self.photo)
        size_px = image.pixels.shape[0], image.pixels.shape[1]
        fit, turn = self._turned(face.fit)
        vertices = fit.vertices_camera(models.face)
        directions, weights = light_photos(self.shots, self.rig, self.sampling)
        canvas = Canvas(vertices, face.fit.crop, size_px, face.texture, self._backdrop(image, size_px))
        reflectance = self._reflectance_of(models, face)

        def relit(rows: slice) -> "Tensor":
            return reflectance.relit(directions, weights[rows], turn)

        metadata = provenance(item, self.photo, models.checkpoint_name)
        if self.reflectance != "field":
            metadata["facerf:reflectance"] = self.reflectance
        yield from self._write_shots(item, face.tag, canvas, relit, metadata)

    def _reflectance_of(self, models: "Models", face: FittedFace) -> "Reflectance":
        """The face's reflectance; the field is held to the photo, for which no light need be known."""
        from facerf_cli.baselines.explain import explain
        from facerf_cli.baselines.field import Field
        from facerf_cli.pipeline import explain_photo

        if self.reflectance == "field":
            return Field(models, face.texture, explain_photo(models, face.texture), self.memory_bytes)
        return explain(self.reflectance, models, face.fit, face.texture).reflectance

    def _turned(self, fit: "FaceFit") -> "tuple[FaceFit, Tensor | None]":
        """The fit in the target's pose, and the turn [3, 3] that brings it there, if there is one."""
        from facerf_cli.pipeline import turn_to

        rotation = parse_pose(self.pose)
        return (fit, None) if rotation is None else (replace(fit, rotation=rotation), turn_to(fit, rotation))

    def _backdrop(self, image: "LinearImage", size_px: tuple[int, int]) -> Backdrop | None:
        if self.composite == "face":
            return None
        matte = None if self.matte is None else read_matte(self.matte, size_px)
        return Backdrop(image, self.surround, matte)

    def _relight_stack(self, item: Item) -> tuple[dict[Path, float], dict[str, Any]]:
        import torch

        from facerf_cli.files.olat_stack import read_olat_stack
        from facerf_cli.pipeline import weigh_batches

        if self.pose is not None or self.asked_for_photo:
            raise InputError(f"{item.input_path}: a stack is one pose of a face without its photo")
        if self.reflectance != "field":
            raise InputError(
                f"{item.input_path}: a stack is of the field; for {self.reflectance} give its photo"
            )
        stack = read_olat_stack(item.input_path)
        canvas, facts = self._stack_canvas(item, stack)
        weights = light_stack(self.shots, torch.from_numpy(stack.header.directions).float(), self.sampling)

        def relit(rows: slice) -> "Tensor":
            batches = (half.float() for half in torch.split(stack.olats, _LIGHTS_AT_ONCE))
            return weigh_batches(batches, weights[rows])

        metadata = attributes_of_sum(stack.header.metadata, item.input_path.name)
        return dict(self._write_shots(item, "", canvas, relit, metadata)), facts

    def _stack_canvas(self, item: Item, stack: "OlatStack") -> tuple[Canvas | ImageCanvas, dict[str, Any]]:
        """What a stack's pictures are seen on, the crop's own frame; and what is known of its fit."""
        import torch

        from facerf_cli.face.crop import Crop
        from facerf_cli.face.fit import fit_from_arrays
        from facerf_cli.face.topology import LAYOUT_VERSION
        from facerf_cli.pipeline import FaceTexture

        header = stack.header
        if header.kind == "image":
            return ImageCanvas(torch.from_numpy(header.seen), header.normals), {}
        try:
            if header.layout_version != LAYOUT_VERSION:
                raise ValueError("it has another UV layout")
            fit = fit_from_arrays(header.fit)
            posed = replace(fit, rotation=torch.from_numpy(header.rotation).float())
            vertices = posed.vertices_camera(face_model(self.photo))
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"{item.input_path}: the fit in it is of no use: {error}") from None
        side_px = fit.crop.size_px
        texture, normals = (torch.from_numpy(x).permute(2, 0, 1) for x in (header.source, header.normals))
        face = FaceTexture(texture, torch.from_numpy(header.seen), normals)
        whole = Crop(0.0, 0.0, float(side_px), side_px)
        return Canvas(vertices, whole, (side_px, side_px), face, None), {
            "error_iod": round(fit.error_iod, 5),
            "quality": fit.quality,
        }

    def _write_shots(
        self,
        item: Item,
        tag: str,
        canvas: Canvas | ImageCanvas,
        relit: "Callable[[slice], Tensor]",
        metadata: dict[str, Any],
    ) -> Iterator[tuple[Path, float]]:
        """All shots, as many at a time as fit the memory; one prediction serves those.

        Where they do not fit at once, automatic exposure costs a round of its own.
        """
        at_once = max(1, self.memory_bytes // (_HELD * 12 * canvas.seen.numel()))
        parts = [slice(first, first + at_once) for first in range(0, len(self.shots), at_once)]
        whole = relit(parts[0]) if len(parts) == 1 else None

        def textures_of(part: slice) -> "Tensor":
            return relit(part) if whole is None else whole

        exposures_ev = self._exposures_ev(parts, textures_of, canvas)
        for part in parts:
            for shot, texture in zip(self.shots[part], textures_of(part), strict=True):
                path = shot.output(item, tag, ".exr")
                canvas.write(path, texture, exposures_ev[shot.name], metadata)
                yield path, exposures_ev[shot.name]

    def _exposures_ev(
        self,
        parts: Iterable[slice],
        textures_of: "Callable[[slice], Tensor]",
        canvas: Canvas | ImageCanvas,
    ) -> dict[str, float]:
        """By name of the light: one for all its frames, so that a turning sky does not pump."""
        if self.exposure_ev is not None:
            return dict.fromkeys((shot.name for shot in self.shots), self.exposure_ev)
        found: dict[str, float] = {}
        for part in parts:
            for shot, texture in zip(self.shots[part], textures_of(part), strict=True):
                chosen_ev = round(canvas.auto_exposure_ev(texture), 2)
                found[shot.name] = min(chosen_ev, found.get(shot.name, chosen_ev))
        return found
