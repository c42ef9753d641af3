"""Whole synthetic people under other lights, by class: the portrait field against the face's field alone.

    python benchmarks/portrait_field.py --bank DIR [--people 16] [--sheet FILE]

Held-out people (a folder of portraits that `facerf train --stage portrait` baked of another seed, or the
first ones of a run's own bank, which are held out) are photographed in natural light, found and fitted as a
user's photo is, and relit to lamps and to natural lights. Relative error: squared error over the truth's, by
the true class, under one scale of the whole person; SSIM over the person. *Copy* leaves the photo as it is.
With `--sheet` an image of photos, truths and predictions is written. Also the time of 150 lights, in forward
passes of the network, and how well the photo comes back under its own light.
"""

from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from _common import ASTRONAUT, arguments, best_s, required
from skimage.metrics import structural_similarity

from facerf_cli.errors import InputError
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_display
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.studio_points import Lights
from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.person import Person, Target, fit
from facerf_cli.pipeline import find_for, head_of, reflectance_of
from facerf_cli.portrait.classes import class_index
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models, load_models
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.relighting.source_light import source_light
from facerf_cli.synth.bank.portrait_samples import load_view
from facerf_cli.synth.bank.texture_samples import draw_light, draw_target_lights
from facerf_cli.synth.portraits import images_under
from facerf_cli.training.objective import seeded

SEED = 16
LAMPS, NATURAL = 3, 2
REGIONS = {
    "face": ("skin", "brows", "eyes", "lips", "mouth"),
    "hair": ("hair",),
    "ears": ("ears",),
    "neck": ("neck",),
    "garment": ("garment",),
}
KINDS = ("copy", "field", "portrait")


def main() -> None:
    """Print the tables."""
    parser = arguments(__doc__)
    parser.add_argument("--bank", type=Path)
    parser.add_argument("--people", type=int, default=16)
    parser.add_argument("--sheet", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    models = load_models()
    print_speed(models)
    bank = required(options.bank, "a bank of portraits", "--bank")
    with torch.no_grad():
        measure(models, sorted(bank.glob("[0-9]*_0.safetensors"))[: options.people], options.sheet)


def measure(models: Models, paths: list[Path], sheet: Path | None) -> None:
    """Print errors by region and kind of light."""
    squared: dict[tuple[str, str, str], list[float]] = defaultdict(lambda: [0.0, 0.0])
    ssim: dict[tuple[str, str], list[float]] = defaultdict(list)
    rows, lost = [], 0
    for number, path in enumerate(paths):
        view = load_view(path)
        generator = seeded(SEED, number)
        rig = view.portrait.directions
        lamps = torch.eye(len(rig))[draw_target_lights(rig, LAMPS, generator), :, None].expand(-1, -1, 3)
        natural = torch.stack([draw_light(rig, generator) for _ in range(1 + NATURAL)])
        weights = torch.cat([lamps, natural[1:]])
        truths = images_under(view.portrait, view.looks[0], torch.cat([natural[:1], weights]))
        source = truths[0] / truths[0].mean().clamp_min(1e-6) * (MEAN_RADIANCE * float(view.alpha.mean()))
        wall = MEAN_RADIANCE / 2 * (1 - view.alpha)
        photo = (source + wall).permute(1, 2, 0).clamp(0, 1).numpy()
        try:
            head = head_of(models, photo, find_for(models.networks.people, "landmarks", photo, path.name)[0])
        except InputError:
            lost += 1
            continue
        found = {"copy": np.repeat(photo[None], len(weights), 0)}
        for kind in ("field", "portrait"):
            person = Person(models, photo, head, reflectance_of(models, head, kind, photo=photo))
            composition = person.composed(Target(background="none"))
            relit = composition.relit(Lights(rig, weights))
            found[kind] = np.stack([composition.image(one).pixels for one in relit])
        classes = view.portrait.classes.numpy() / 255
        alpha = view.alpha.numpy()
        for index, truth in enumerate(truths[1:].permute(0, 2, 3, 1).numpy()):
            light = "lamps" if index < LAMPS else "natural"
            for kind in KINDS:
                image = found[kind][index] * alpha[..., None]
                scaled = image * (image * truth).sum() / max((image**2).sum(), 1e-9)
                error, power = ((scaled - truth) ** 2).mean(-1), (truth**2).mean(-1)
                for region, names in REGIONS.items():
                    share = classes[..., [class_index(name) for name in names]].sum(-1)
                    squared[light, kind, region][0] += float((error * share).sum())
                    squared[light, kind, region][1] += float((power * share).sum())
                ssim[light, kind].append(_ssim(scaled, truth, alpha))
        shown = [photo]
        for index in (0, NATURAL + 1):
            shown += [truths[1 + index].permute(1, 2, 0).numpy(), found["portrait"][index]]
        rows.append(np.concatenate(shown, 1))
    print(f"{len(rows)} people, {lost} not found")
    for light in ("lamps", "natural"):
        for kind in KINDS:
            parts = []
            for region in REGIONS:
                error, power = squared[light, kind, region]
                parts.append(f"{region} {error / max(power, 1e-9):.3f}")
            errors, similar = "  ".join(parts), np.mean(ssim[light, kind])
            print(f"{light:8} {kind:9} relative error: {errors}   SSIM {similar:.3f}")
    if sheet and rows:
        write_display(sheet, np.concatenate(rows, 0), 1.0)


def _ssim(image: np.ndarray, truth: np.ndarray, alpha: np.ndarray) -> float:
    """SSIM of grey roots, over the person."""
    roots = [np.sqrt((x.mean(-1) / max(truth.max(), 1e-6)).clip(0, 1)) for x in (image, truth)]
    full = structural_similarity(*roots, data_range=1, gaussian_weights=True, sigma=1.5, full=True)[1]
    return float((full * alpha).sum() / alpha.sum())


@torch.no_grad()
def print_speed(models: Models) -> None:
    """Print times in forward passes, and how well a photo comes back under its own light."""
    photo = read_image(ASTRONAUT).pixels
    found = fit(
        models, photo, white=None, face=find_for(models.networks.people, "landmarks", photo, "astronaut")[0]
    )
    field = found.reflectance
    assert isinstance(field, PortraitField)
    rig = rig_directions(150)
    summary = rig_directions(48)
    inputs = field.person.inputs(summary, field.person.visibility(summary))
    network, weights = SHIPPED_NETWORKS.portrait, torch.ones(1, 150, 3)
    ways = {"a forward pass": lambda: network(inputs), "150 lights": lambda: field.lit(rig, weights)}
    times, _ = best_s(ways, 3)
    print(", ".join(f"{name} {seconds:.3f} s" for name, seconds in times.items()), end="; ")
    print(f"ratio {times['150 lights'] / times['a forward pass']:.1f}")
    image = found.image(source_light(models, found.head.face).light).pixels
    inside = field.person.segmentation.matte > 0.9
    error = float(((image - photo)[inside] ** 2).mean())
    print(f"the photo under its own light: {10 * np.log10(1 / error):.1f} dB inside the matte")


if __name__ == "__main__":
    main()
