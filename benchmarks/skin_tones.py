"""Exposure of six skins: how bright a face is shown, relit, beside how bright it is in its photo.

    python benchmarks/skin_tones.py --bank DIR [--drawn 24]

One person of a bank of people (`facerf train --stage portrait`) in six appearances, from the darkest to
the lightest skin of those that are drawn, is photographed in one natural light by one exposure, and relit
to a lamp at the side and to another natural light. Printed: the true albedo of the skin, and the mean
luminance of the face and that which a tenth of it exceeds, in the photo and as shown by `--exposure auto`
and `face`. Faces keep their order, and the ratios of their tones, where shown over photo is alike for all;
its spread is the figure.
"""

from pathlib import Path

import numpy as np
import torch
from _common import arguments, required

from facerf_cli.image.colour import ExposureRule, luminance
from facerf_cli.light.light import Light
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.person import Target, fit
from facerf_cli.portrait.find import find_faces
from facerf_cli.portrait.parse import class_index
from facerf_cli.relighting.models import Models, load_models
from facerf_cli.synth.appearance.materials import draw_appearance
from facerf_cli.synth.bank.portrait_samples import StoredView, load_view
from facerf_cli.synth.bank.texture_samples import draw_light
from facerf_cli.synth.renderer import albedo_of, images_under, materials_of
from facerf_cli.synth.shading import Material
from facerf_cli.training.objective import seeded

SEED, SKINS, LOOK_PX = 17, 6, 128
LAMP_AZEL_DEG = (60.0, 20.0)
GAIN = 2.0  # of the photos: white that faces all of the light is this bright
RULES: tuple[ExposureRule, ...] = ("auto", "face")


def main() -> None:
    """Print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--bank", type=Path)
    parser.add_argument("--drawn", type=int, default=24)
    options = parser.parse_args()
    bank = required(options.bank, "a bank of people", "--bank")
    view = load_view(min((bank / "people").glob("[0-9]*_0.safetensors")))
    models = load_models()
    looks = [
        materials_of(view.baked, draw_appearance(LOOK_PX, seeded(SEED, number)))
        for number in range(options.drawn)
    ]
    looks.sort(key=lambda look: albedo_of_skin(view, look))
    with torch.no_grad():
        rows = [measured(models, view, looks[round(k)]) for k in np.linspace(0, len(looks) - 1, SKINS)]
    print(
        "skin albedo; the face's mean, and what a tenth of it exceeds, in the photo; as shown: "
        + ", ".join(rows[0][2])
    )
    for albedo, plate, shown in rows:
        print(
            f"{albedo:.3f}  {plate.round(3)}  " + "  ".join(str(values.round(3)) for values in shown.values())
        )
    for name in rows[0][2]:
        ratios = np.array([shown[name] / plate for _, plate, shown in rows])
        spread = 100 * (ratios.max(0) / ratios.min(0) - 1)
        print(f"{name}: shown over photo {ratios.mean(0).round(2)}, spread {spread.round(1)} %")


def skin_of(view: StoredView) -> np.ndarray:
    """True where the person's skin is seen [S, S]."""
    return np.asarray(view.baked.classes.numpy()[..., class_index("skin")] > 0.5)


def albedo_of_skin(view: StoredView, look: Material) -> float:
    """Mean luminance of the skin's true albedo."""
    albedo = albedo_of(view.baked, look)[0].permute(1, 2, 0).numpy()
    return float(luminance(albedo)[skin_of(view)].mean())


def measured(
    models: Models, view: StoredView, look: Material
) -> tuple[float, np.ndarray, dict[str, np.ndarray]]:
    """Albedo of the skin, and the face's luminances in the photo and as shown."""
    rig, skin = view.baked.directions, skin_of(view)
    natural = torch.stack([draw_light(rig, seeded(SEED, number)) for number in range(2)])
    lamp = torch.zeros_like(natural[:1])
    lamp[0, (rig @ azel_to_direction(*torch.tensor(LAMP_AZEL_DEG)).float()).argmax()] = 1
    source = images_under(view.baked, look, natural[:1])[0]
    wall = MEAN_RADIANCE / 2 * (1 - view.baked.alpha)
    gain = GAIN / float(natural[0].sum(0).mean())
    photo = (gain * source + wall).permute(1, 2, 0).clamp(0, 1).numpy()
    person = fit(
        models, photo, white_balance=None, face=find_faces(models.networks.people, photo, "the photo")[0]
    )
    composition = person.prepare(Target(background="none"))
    shown = {}
    lit = composition.relit(Light(rig, torch.cat([lamp, natural[1:]])))
    for light, relit in zip(("lamp", "daylight"), lit, strict=True):
        face = tones(composition.image(relit), skin)
        for rule in RULES:
            shown[f"{light} {rule}"] = face * 2 ** composition.exposure_ev(relit, rule)
    return albedo_of_skin(view, look), tones(photo, skin), shown


def tones(pixels: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """Mean luminance of the skin in pixels [S, S, 3], and the luminance that a tenth of it exceeds."""
    values = luminance(pixels)[skin]
    return np.array([values.mean(), np.percentile(values, 90)])


if __name__ == "__main__":
    main()
