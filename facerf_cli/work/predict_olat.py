"""Write the OLAT stack of a photo's person, and its contact sheet, for `facerf predict-olat`."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from facerf_cli.batch.inputs import Item
from facerf_cli.face.fit import fit_to_arrays
from facerf_cli.face.head import shrunk_photo
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.face.view import render_face, see_face
from facerf_cli.files.olat_stack import StackHeader, write_olat_stack
from facerf_cli.files.read import LinearImage
from facerf_cli.files.sheets import contact_sheet, mark_light
from facerf_cli.files.write import write_display
from facerf_cli.image.strips import resized
from facerf_cli.light.light import Light, rig_by_text
from facerf_cli.person import Target, fit, olat_images
from facerf_cli.raster.camera import crop_camera
from facerf_cli.relighting.field import Field
from facerf_cli.relighting.fitting import reflectance_of
from facerf_cli.relighting.memory import require_face
from facerf_cli.relighting.relightable import RenderRequest
from facerf_cli.run.threads import one_ahead
from facerf_cli.work.photo_work import PredictOlat, Written
from facerf_cli.work.photos import (
    FittedFace,
    load_models_once,
    naming,
    provenance,
    read_normals,
    read_photo,
    rotation_of,
    write_each,
)
from facerf_cli.work.view import write_page

_TILE_PX, _SHEET_PX = 128, 1 << 22  # longer side of a contact sheet's tile; most pixels of all tiles


def write_stacks(item: Item, work: PredictOlat) -> Written:
    """Predict and write the stack of each chosen face of a photo."""
    directions = rig_by_text(work.lights)
    image = read_photo(item, work.photo)

    def write(face: FittedFace) -> dict[str, Any]:
        stack, sheet, *pages = work.files_of(item, face.tag)
        tiles: list[np.ndarray] = []
        if work.frame == "photo":
            header, olats = _of_person(item, image, face, directions, work, tiles)
        else:
            header, olats = _of_face(item, face, directions, work, tiles)
        write_olat_stack(stack, header, olats)
        images = np.concatenate(tiles)
        white = float(np.percentile(images, 99.5))
        for thumbnail, direction in zip(images, header.directions, strict=True):
            mark_light(thumbnail, direction, white)
        write_display(sheet, contact_sheet(images), "auto", metadata=header.metadata)
        for path in pages:
            write_page(path, item, image.pixels, face, work)
        return {}

    tags, facts = write_each(item, image, work.photo, write)
    return tags, facts | {"lights": len(directions)}


def _of_person(
    item: Item,
    image: LinearImage,
    face: FittedFace,
    directions: Tensor,
    work: PredictOlat,
    tiles: list[np.ndarray],
) -> tuple[StackHeader, Iterator[Tensor]]:
    """Return the header and OLATs [l, 3, H, W] of the person over black; add thumbnails to `tiles`."""
    models = load_models_once(work.photo)
    photo, head = shrunk_photo(image.pixels, face.head, work.size_px)
    size_px = photo.shape[:2]
    require_face(models.face, head.fit, size_px)
    alpha, matte = (None if part is None else resized(part, *size_px) for part in (image.alpha, face.matte))
    normals = read_normals(item, work.normals_from, size_px)
    choices: dict[str, Any] = {"network_alone": work.network_alone, "white_balance": work.white_balance}
    with naming(item.input_path):
        found = face.found if photo is image.pixels else None  # its eyes are in pixels of the whole photo
        person = fit(models, photo, matte=matte, face=found, head=head, normals=normals, **choices)
    face.see(person.segmentation)
    subject = person.prepare(Target(alpha=alpha, background="none"))

    def olats() -> Iterator[Tensor]:
        for images in olat_images(subject, directions):
            batch = torch.from_numpy(images).permute(0, 3, 1, 2)
            scale = _tile_px(len(directions)) / max(batch.shape[-2:])
            small = interpolate(batch, scale_factor=scale, mode="area") if scale < 1 else batch
            tiles.append(small.permute(0, 2, 3, 1).numpy())
            yield batch

    first = next(subject.relit(Light.each(directions[:1])))
    header = StackHeader(
        kind="photo",
        rotation=head.fit.rotation.numpy(),
        source=photo,
        seen=subject.matte,
        normals=subject.rendered(RenderRequest(first, layers=("normal",)))["normal"],
        fit=fit_to_arrays(head.fit),
        **_common_header(item, directions, work),
    )
    return header, one_ahead(olats())


def _of_face(
    item: Item, face: FittedFace, directions: Tensor, work: PredictOlat, tiles: list[np.ndarray]
) -> tuple[StackHeader, Iterator[Tensor]]:
    """Return the header and OLATs [l, 3, H, W] of only the face, as images or textures; see `_of_person`."""
    models, maps, rotation = load_models_once(work.photo), face.head.face, rotation_of(work.pose)
    posed = face.fit if rotation is None else replace(face.fit, rotation=rotation)
    vertices, side_px = posed.vertices_camera(models.face), face.fit.crop.size_px
    large, small = (
        see_face(vertices, crop_camera(px)) for px in (side_px, 2 * _tile_px(len(directions)))
    )  # (u, v) and coverage
    source, normals, seen = maps.texture, maps.normals, maps.visible
    if work.frame == "face":
        turned = torch.einsum("dc,cij->dij", face.fit.turn_to(posed.rotation), normals)
        source, normals = render_face(torch.stack([source, turned]), *large)
        seen = large[1]

    def olats() -> Iterator[Tensor]:
        field = reflectance_of(
            models, face.head, "field", work.network_alone, white_balance=work.white_balance
        )
        assert isinstance(field, Field)
        turn = None if rotation is None else face.fit.turn_to(rotation)
        for textures in replace(field, bf16=work.precision == "bf16").olats(directions, turn):
            tiles.append(avg_pool2d(render_face(textures, *small), 2).permute(0, 2, 3, 1).numpy())
            yield render_face(textures, *large) if work.frame == "face" else textures

    header = StackHeader(
        kind="image" if work.frame == "face" else "texture",
        rotation=posed.rotation.numpy(),
        source=source.permute(1, 2, 0).numpy(),
        seen=seen.numpy(),
        normals=normals.permute(1, 2, 0).numpy(),
        fit=fit_to_arrays(face.fit),
        **_common_header(item, directions, work),
    )
    return header, olats()


def _common_header(item: Item, directions: Tensor, work: PredictOlat) -> dict[str, Any]:
    metadata = provenance(item, work.photo, load_models_once(work.photo).checkpoint_name())
    metadata |= {"facerf:network_alone": 1} if work.network_alone else {}
    return {"directions": directions.numpy(), "layout_version": LAYOUT_VERSION, "metadata": metadata}


def _tile_px(lights: int) -> int:
    """Return the longer side of a contact sheet's tiles, whose total size is independent of the lights."""
    return min(_TILE_PX, math.isqrt(_SHEET_PX // lights))
