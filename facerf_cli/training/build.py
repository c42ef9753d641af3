"""Provide what a stage's `build` needs: options, networks of a preset's sizes, and data."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.faces import DatasetFaces, open_faces
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.morphable import load_face_model, save_face_model
from facerf_cli.light.transport import BakeSettings
from facerf_cli.network.checkpoint import form_of, installed_class, new_network
from facerf_cli.relighting.models import Networks
from facerf_cli.synth.bank.backgrounds import BACKGROUND_HEAPS, BACKGROUND_MAPS, load_backgrounds
from facerf_cli.synth.bank.heads import HeadBakeSettings, add_views, bake_heads, load_bank
from facerf_cli.synth.bank.people import PHOTO_BANK, TINY_BANK, PeopleBankSettings, add_people
from facerf_cli.synth.bank.texture_samples import SampleSource
from facerf_cli.synth.head.mesh import MAKEHUMAN_LICENCE
from facerf_cli.training.losses import load_features
from facerf_cli.training.objective import Objective
from facerf_cli.training.options import TrainOptions
from facerf_cli.training.settings import Sizes, TrainSettings, network_settings_of, sizes_of


@dataclass(frozen=True, eq=False)
class Run:
    """Run of `facerf train`.

    Attributes:
        training: Settings of the loop.
        trained: Networks of --start-from that the stage trains, by name.
        people: Networks that find and parse people in photos.
    """

    options: TrainOptions
    training: TrainSettings
    trained: dict[str, Any]
    people: Networks

    @property
    def sizes(self) -> Sizes:
        """Sizes of the preset, with --heads and --views if given."""
        options, sizes = self.options, sizes_of(self.options.preset)
        return replace(sizes, heads=options.heads or sizes.heads, views=options.views or sizes.views)

    @property
    def is_tiny(self) -> bool:
        return self.options.preset == "tiny"

    @property
    def bank(self) -> Path:
        """Folder of baked heads and people."""
        return self.options.bank or self.options.output / "bank"

    def dataset(self) -> Dataset:
        """Read the dataset of --dataset."""
        if self.options.dataset is None:
            raise UsageError(f"--stage {self.options.stage}: needs a prepared dataset; pass --dataset")
        return read_dataset(self.options.dataset)

    @property
    def texture_side(self) -> int:
        """Side of the textures of a dataset, or of baked heads."""
        if self.options.dataset:
            return self.options.texture_size or self.sizes.texture_side
        return self.sizes.bake_side

    def crop_side(self, dataset: Dataset) -> int:
        """Return the side of the crops of the stages that read crops; `tiny` accepts any dataset's."""
        side = min(self.sizes.joint_side, dataset.crop_px) if self.is_tiny else self.sizes.joint_side
        return self.options.texture_size or side

    def objective(self, kind: type[Objective]) -> Any:
        """Return the class of the stage's objective, or the subclass of --objective."""
        name = self.options.objective
        if name is None:
            return kind
        own = installed_class(name, "--objective")
        if not issubclass(own, kind):
            needed = f"{kind.__module__}:{kind.__name__}"
            raise UsageError(f"--objective {name}: not a subclass of {needed}, the stage's own; use one")
        return own

    def network(self, name: str, form: str = "default", **settings: Any) -> Any:
        """Return the network of --start-from, or an untrained one of the preset's sizes."""
        settings |= network_settings_of(self.options.preset, name, form_of(name, form))
        return self.trained.get(name) or new_network(name, form, settings)

    def reflectance(self, side: int) -> Any:
        """Make the Reflectance Network of the options' form; the paper's works at the textures' side."""
        form, without_normals = self.options.form, self.options.without_normals
        settings: dict[str, Any] = {"side": side} if form_of("reflectance", form) == "paper" else {}
        if without_normals:
            settings["normals"] = False
        try:
            return self.network("reflectance", form, **settings)
        except TypeError:
            if not without_normals:
                raise
            raise UsageError(
                f"--without-normals: the form {form} has no setting normals; remove the option"
            ) from None

    def geometry(self, mean_translation_m: tuple[float, float, float]) -> Any:
        """Make the Geometry Network; with --mean-face it regresses only poses (paper, 'Ablative Study')."""
        form = "paper" if self.options.preset == "paper" else "default"
        shapes = {"identity": 0, "expression": 0} if self.options.mean_face else {}
        return self.network("geometry", form, mean_translation_m=mean_translation_m, **shapes)

    def features(self, name: str, side: int, **settings: Any) -> Any:
        """Make S_f or V_f; InputError if --start-from was trained on images of another side."""
        network = self.network(name, "vgg", width=self.sizes.light_width, side=side, **settings)
        if network.settings.side != side:
            trained = network.settings.side
            raise InputError(
                f"{self.options.start_from}: trained on images of {trained} px, here they have {side}; "
                f"pass --texture-size {trained}"
            )
        return network

    def light_features(self, side: int) -> Any:
        """Load the frozen S_f of --light-features, for textures of a side; None without one."""
        path = self.options.light_features
        return load_features(path, "light_features", side) if path else None

    def faces(self) -> SampleSource | DatasetFaces:
        """Open the dataset, or the bank of synthetic heads, whose missing heads and views are made first."""
        options, folder, sizes = self.options, self.bank, self.sizes
        if options.dataset:
            return open_faces(options.dataset, options.fit_with, self.texture_side, sizes.rig_lights)
        provenance, fitted_with = self.bake_heads(), options.fit_with
        if options.mean_face:  # a model without shapes fits only the pose
            still = load_face_model(fitted_with).pose_only()
            fitted_with = str(folder / f"{still.name}.npz")
            save_face_model(Path(fitted_with), still)
        fitted = load_face_model(fitted_with)
        views, seed = folder / f"views-{fitted.name}", options.settings.seed
        add_views(folder / "heads", views, fitted_with, sizes.views, options.jobs, seed)
        fit = {"fitted_with": fitted.credit, "skin": "procedural (facerf)"}
        return load_bank(folder / "heads", views, provenance | fit)

    def bake_heads(self) -> dict[str, Any]:
        """Bake the heads that are missing; return their provenance."""
        options, folder, sizes = self.options, self.bank / "heads", self.sizes
        if sizes.heads < sizes.held_out_heads + 2:
            held_out = f"the mean face and {sizes.held_out_heads} heads are held out"
            raise UsageError(f"--heads {sizes.heads}: {held_out}; use more")
        drawn = load_face_model(options.heads_from)
        load_face_model(options.fit_with)  # raises for an invalid model before anything is baked
        settings = HeadBakeSettings(sizes.bake_side, sizes.rig_lights)
        if self.is_tiny:
            settings = replace(settings, bake=BakeSettings(light_samples=1, bounce_samples=2))
        bake_heads(folder, options.heads_from, sizes.heads, options.jobs, options.settings.seed, settings)
        return {
            "heads": f"{len(list(folder.glob('*.safetensors')))} synthetic heads drawn from {drawn.credit}",
            "licence": f"MIT; the heads' shapes: {drawn.licence}",
        }

    def bake_people(self, held_out: int, with_squares: bool) -> tuple[Path, dict[str, Any]]:
        """Bake the synthetic people that are missing; return their folder and their provenance.

        The stage portrait needs the transport in the person's square (`with_squares`).
        """
        options, heads = self.options, self.sizes.heads
        if heads <= held_out:
            raise UsageError(f"--heads {heads}: {held_out} people are held out; use more")
        folder, models = self.bank / "people", options.heads_from.split(",")
        drawn = [load_face_model(model) for model in models]
        full = PeopleBankSettings() if with_squares else PHOTO_BANK
        settings = replace(TINY_BANK if self.is_tiny else full, with_squares=with_squares)
        add_people(folder, models, range(heads), options.jobs, options.settings.seed, settings)
        shapes = [f"the heads' shapes: {model.licence}" for model in drawn]
        return folder, {
            "heads": f"synthetic people drawn from {' and '.join(model.credit for model in drawn)}",
            "licence": "; ".join(["MIT", *shapes, MAKEHUMAN_LICENCE]),
        }

    def backgrounds(self, folder: Path) -> Tensor:
        """Load the backgrounds of photos; draw them if the folder lacks their file."""
        maps, shapes = (1, 4) if self.is_tiny else (BACKGROUND_MAPS, BACKGROUND_HEAPS)
        return load_backgrounds(folder / "backgrounds.safetensors", maps, shapes, self.options.settings.seed)
