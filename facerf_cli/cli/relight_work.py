"""The work of `facerf relight` on one item: its settings, outputs and recipes."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from facerf_cli.baselines import RelightKind
from facerf_cli.batch.inputs import Item, NamePattern, split_frame
from facerf_cli.batch.made_from import DigestOf, Recipe, recipe_of
from facerf_cli.batch.run import Outcome
from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.cli.backgrounds import BackgroundChoice
from facerf_cli.cli.lights import LightSetup, PhotoLight, Sampling
from facerf_cli.cli.output_options import OutputOptions
from facerf_cli.cli.photo_options import PhotoOptions, networks_of
from facerf_cli.cli.shots import Shot, follow_all, recipe_of_shots
from facerf_cli.cli.values import Exposure
from facerf_cli.errors import FacerfError, UsageError

Composite = Literal["photo", "face"]
ExposureGroup = Literal["photo", "folder", "sequence"]


@dataclass(frozen=True)
class Relight:
    """Relights one item under every light setup; settings only."""

    photo: PhotoOptions
    setups: tuple[LightSetup, ...] = field(metadata=NOT_IN_RECIPE)  # each is in that of its own images
    rig: str
    sampling: Sampling
    pose: str | None
    composite: Composite
    background: BackgroundChoice
    background_blur: float
    aov: tuple[str, ...]
    matte: Path | None
    exposure: Exposure
    asked_for_photo: bool = field(metadata=NOT_IN_RECIPE)  # --composite photo is on the command line
    output: OutputOptions
    reflectance: RelightKind = "portrait"
    network_alone: bool = False
    name: NamePattern | None = field(default=None, metadata=NOT_IN_RECIPE)
    exposure_group: ExposureGroup = "photo"
    photo_of_stack: Path | None = None
    leaders: tuple[Item, ...] = field(default=(), metadata=NOT_IN_RECIPE)  # the first photo of each group
    shots: tuple[Shot, ...] = field(default=(), metadata=NOT_IN_RECIPE)

    @property
    def maps(self) -> list[LightSetup]:
        """The setups that are maps."""
        return [setup for setup in self.setups if setup.envmap is not None]

    def outputs_of(self, item: Item) -> list[Path]:
        """A file of each format for each setup."""
        tag = "" if self.composite == "photo" else self.photo.first_tag
        suffixes = self.output.suffixes
        return [setup.output(item, tag, suffix, self.name) for setup in self.setups for suffix in suffixes]

    def for_stale(self, item: Item) -> "Relight":
        """These settings with the lights of the item's stale images; a light has all of its frames."""
        tag = "" if self.composite == "photo" else self.photo.first_tag
        stale = {
            setup.name
            for setup in self.setups
            for suffix in self.output.suffixes
            if not item.stale or setup.output(item, tag, suffix, self.name) in item.stale
        }
        return replace(self, setups=tuple(setup for setup in self.setups if setup.name in stale))

    def with_leaders(self, items: Sequence[Item]) -> "Relight":
        """These settings with the first photo of each group of --exposure-group."""
        groups = {self._group(item): item for item in reversed(items)}
        return replace(self, leaders=tuple(groups.values())) if self.exposure_group != "photo" else self

    def leader_of(self, item: Item) -> Item | None:
        """The photo whose exposure an item shares; None without groups."""
        own = self._group(item)
        return next((leader for leader in self.leaders if self._group(leader) == own), None)

    def _group(self, item: Item) -> Path:
        if self.exposure_group == "folder":
            return item.output_base.parent
        return item.output_base.with_name(split_frame(item.output_base.name)[0])

    def refuse_meeting(self, items: Sequence[Item]) -> None:
        """Raise UsageError where two images would have one path, as a --name may make them."""
        seen: set[Path] = set()
        for item in items:
            for path in self.outputs_of(item):
                if path in seen:
                    raise UsageError(
                        f"{item.input_path}: {path} would be the name of two images; give --name more fields"
                    )
                seen.add(path)

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of every output, which holds the light of its own setup alone."""
        shared = recipe_of(self, digest_of)
        if self.leaders:
            shared["leaders"] = [digest_of(leader.input_path) for leader in self.leaders]
        shared |= recipe_of_shots(self.shots, digest_of)
        lit = [recipe_of(setup, digest_of) | shared for setup in self.setups]
        return [recipe | {"format": name} for recipe in lit for name in self.output.formats]

    @property
    def _networks(self) -> frozenset[str]:
        """Names of the networks that these options use."""
        lights = [setup.envmap.options for setup in self.setups if isinstance(setup.envmap, PhotoLight)]
        return networks_of([self.reflectance]).union(*(light.networks for light in lights))

    def readable(self, dry_run: bool) -> "Relight":
        """Load the models, and keep the setups whose maps can be read.

        A dry run loads no networks, and so estimates no light of a photo.
        """
        from facerf_cli.work.lights import readable
        from facerf_cli.work.outputs import check_output

        check_output(self.output)
        self.photo.preparation(dry_run, self._networks)()
        follow_all(self.shots, self.photo, dry_run)
        if dry_run and any(isinstance(setup.envmap, PhotoLight) for setup in self.setups):
            return self
        setups = readable(self.setups)
        if not setups:
            raise FacerfError("no map can be read; give others")
        return replace(self, setups=setups)

    def __call__(self, item: Item) -> Outcome:
        """Relight a photo, a frame or a stack."""
        from facerf_cli.work.relight import relight_item

        written, facts = relight_item(item, self.for_stale(item))
        outputs = [path.with_suffix(suffix) for path in written for suffix in self.output.suffixes]
        exposures_ev = {path.stem: exposure_ev for path, exposure_ev in written.items()}
        return Outcome(outputs, facts | {"exposure_ev": exposures_ev})
