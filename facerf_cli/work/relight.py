"""One photo, or one OLAT stack, under every light setup: relit, exposed and written (`relight_scenes.py`)."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.made_from import recipe_of
from facerf_cli.batch.run import Outcome
from facerf_cli.errors import InputError
from facerf_cli.files.texts import file_sha256
from facerf_cli.image.colour import most_exposure_ev
from facerf_cli.image.strips import Empty, rows_of
from facerf_cli.relighting.relightable import RenderRequest
from facerf_cli.run.logs import LOGGER_NAME, json_line
from facerf_cli.run.memory import batches
from facerf_cli.work.light_setups import LightSetup
from facerf_cli.work.lights import with_room
from facerf_cli.work.outputs import OutputImage, write_output
from facerf_cli.work.photos import facts_of, load_models_once
from facerf_cli.work.plan import beside_people, image_canvas
from facerf_cli.work.relight_options import Relight
from facerf_cli.work.relight_scenes import LitScene, scenes_of
from facerf_cli.work.sequence import open_at

log = logging.getLogger(LOGGER_NAME)
_digest_once = lru_cache(maxsize=256)(file_sha256)


def relight_item(item: Item, work: Relight) -> Outcome:
    """Relight a photo or a stack under every setup."""
    written: dict[Path, dict[str, float]] = {}
    people: list[dict[str, Any]] = []
    facts: Mapping[str, Any] = {}
    shared_ev = _shared_exposures(item, work)
    for scene in scenes_of(item, work, together=work.composite == "photo"):
        with beside_people(len(scene.faces), scene.subject.size_px):
            written |= _write_setups(item, scene, work, shared_ev)
        people[:0] = [face.described() for face in scene.people]
        facts = facts_of(people, work.photo) if people else scene.facts
    outputs = [path.with_suffix(suffix) for path in written for suffix in work.output.suffixes]
    names = dict.fromkeys(name for one in written.values() for name in one)
    each = {name: {path.stem: one[name] for path, one in written.items()} for name in names}
    return Outcome(outputs, {**facts, **each})


def _leader_of(item: Item, work: Relight) -> Item | None:
    """The photo whose exposure an item shares; of a shot a frame of its middle."""
    place = open_at(work.shots, item, work.photo, work.white)
    if place is None:
        return work.leader_of(item)
    shot, number = place
    return shot.shot.frames[shot.take_of(number).middle]


def _shared_exposures(item: Item, work: Relight) -> dict[str, float] | None:
    """The exposures of an item's group; None where it has none, or is the one that it has them of."""
    leader = _leader_of(item, work)
    if leader is None or leader == item:
        return None
    known = work.exposures_of_leaders.setdefault(leader.output_base, {})
    if not {setup.name for setup in work.setups} <= set(known):
        if isinstance(work.exposure_rule, float):
            return dict.fromkeys((setup.name for setup in work.setups), work.exposure_rule)
        scene = next(scenes_of(leader, work, together=True))
        parts = batches(len(scene.setups), scene.subject.nbytes)
        known |= _exposures_ev(scene, parts, scene.relit, work)
    return known


def _write_setups(
    item: Item,
    scene: LitScene,
    work: Relight,
    shared_ev: Mapping[str, float] | None,
) -> dict[Path, dict[str, float]]:
    """Write the image of every setup, as many at a time as fit the memory; one prediction serves those.

    Where they do not fit at once, an exposure that is to be found needs a second prediction. Returns the EXR
    of each image, and facts of it for the report: the exposure of the PNG in its place, the identity.
    """
    parts = batches(len(scene.setups), scene.subject.nbytes)
    whole = scene.relit(parts[0]) if len(parts) == 1 else None

    def relit_by(part: slice) -> list[Any]:
        return scene.relit(part) if whole is None else whole

    exposures_ev = shared_ev or _exposures_ev(scene, parts, relit_by, work)
    written: dict[Path, dict[str, float]] = {}
    for part in parts:
        for setup, relit in zip(scene.setups[part], relit_by(part), strict=True):
            _require_finite(item, setup, relit)
            path, ev = setup.output(item, scene.tag, ".exr", work.name), exposures_ev[setup.name]
            with image_canvas(path, scene.subject.size_px, len(work.output.formats)) as empty:
                image = _rendered(scene, setup, relit, ev, work, empty)
                image = replace(image, header={**scene.plate, **_made_by(setup, work)})
                write_output(path, image, ev, work.output, {**scene.metadata, "facerf:exposure_ev": ev})
                written[path] = {"exposure_ev": ev}
                if scene.identity is not None:
                    written[path]["identity_distance"] = scene.identity(image.pixels * np.float32(2.0**ev))
                del image
            group = " of its group" if shared_ev else ""
            said = [f"exposure {ev:+.2f} EV{group}"] if work.output.shown_suffix else []
            said += [f"in a room that sends {setup.room:g} back"] if setup.room else []
            if said and not (shared_ev and work.shots):
                log.info("%s under %s: %s", item.input_path, setup.name + setup.frame, ", ".join(said))
            del relit  # of all of its part, beside the next
    return written


def _made_by(setup: LightSetup, work: Relight) -> dict[str, str]:
    """The lights, the options and the networks of an image, as JSON for its header; files by digests."""
    served = load_models_once(work.photo).networks.served()
    networks = {name: {**file, "file": Path(file["file"]).name} for name, file in served.items()}
    lights = json_line(recipe_of(setup, _digest_once))
    options = json_line(recipe_of(work, _digest_once))
    return {"facerf:lights": lights, "facerf:options": options, "facerf:networks": json_line(networks)}


def _rendered(
    scene: LitScene, setup: LightSetup, relit: Any, ev: float, work: Relight, empty: Empty
) -> OutputImage:
    """The image of a setup, with its layers and those of its named lights, as arrays that `empty` makes.

    A soft view leaves what was photographed, and a given background, as it looks; in the photo's own light it
    bends what other lights add.
    """
    subject, lit = scene.subject, with_room(setup)
    behind = scene.behind(setup, ev) if scene.behind else None
    parts = batches(len(lit.names), subject.nbytes)
    arrays: dict[str, np.ndarray] = {}
    for part in parts or [slice(0)]:
        each = scene.relit_by_each(setup, part) if lit.names else ()
        lights = dict(zip(lit.names[part], each, strict=True))
        request = RenderRequest(None if arrays else relit, lights, work.aov, ev, behind)
        arrays |= subject.rendered(request, empty)
        del lights, request  # before others are relit
    pixels, alpha = arrays.pop("rgb"), subject.alpha(behind)
    matte = subject.person_matte
    layers = arrays if matte is None else {"person.A": matte, **arrays}
    keeps = alpha is None and work.background.kind != "envmap"
    added = None
    if setup.has_own:
        others = [layers[name] for name, light in zip(lit.names, lit.lights, strict=True) if not light.own]
        added = SumOf(others, subject.size_px[1], alpha)
    share = matte if keeps else None
    return OutputImage(pixels, scene.alpha if alpha is None else alpha, layers, share, added)


@dataclass(frozen=True, eq=False)
class SumOf:
    """The sum [H, W, 3] of layers over black, by rows, not multiplied by alpha [H, W]."""

    layers: Sequence[np.ndarray]
    width_px: int
    alpha: np.ndarray | None

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        """Some rows [h, W, 3]."""
        total = np.zeros((rows.stop - rows.start, self.width_px, 3), np.float32)
        for layer in self.layers:
            total += rows_of(layer, rows)
        return total if self.alpha is None else total / np.maximum(self.alpha[rows], 1e-3)[..., None]


def _require_finite(item: Item, setup: LightSetup, relit: Any) -> None:
    """Raise InputError, before anything is written, where a light gives values that are no numbers."""
    for one in relit if isinstance(relit, Sequence) else [relit]:
        if not all(tensor.isfinite().all() for tensor in one.tensors):
            raise InputError(
                f"{item.input_path}: relit by {setup.name} it has values that are NaN or infinite; check the "
                "photo, its landmarks and the light"
            )


def _exposures_ev(
    scene: LitScene, parts: Iterable[slice], relit_by: Callable[[slice], list[Any]], work: Relight
) -> dict[str, float]:
    """Exposure by the name of the setup: one for all frames of a map, so that a rotation does not flicker."""
    if isinstance(rule := work.exposure_rule, float):
        return dict.fromkeys((setup.name for setup in work.setups), rule)
    found: dict[str, float] = {}
    strengths = scene.lights[0].strengths()
    for part in parts:
        for setup, light, relit in zip(scene.setups[part], strengths[part], relit_by(part), strict=True):
            chosen_ev = setup.exposure_ev
            if chosen_ev is None:
                most_ev = most_exposure_ev(rule, light)
                chosen_ev = round(min(scene.subject.exposure_ev(relit, rule), most_ev), 2)
            found[setup.name] = min(chosen_ev, found.get(setup.name, chosen_ev))
            del relit  # a view of one holds all of its part, beside the next
    return found
