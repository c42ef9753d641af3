"""The scenes of `facerf relight`: people of a photo, or an OLAT stack, and what is behind them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import accumulate, islice, pairwise
from typing import Any

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.errors import InputError
from facerf_cli.files.read import read_image
from facerf_cli.image.strips import Rows, Scaled, covering
from facerf_cli.light.envmap import Backdrop
from facerf_cli.light.studio_points import Lights, intensity_of
from facerf_cli.raster.camera import Camera, rays_of_rows
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.relightable import Relightable
from facerf_cli.run.logs import step
from facerf_cli.run.memory import batches
from facerf_cli.work.light_setups import LightSetup
from facerf_cli.work.lights import as_in_photo, each_alone, on_face, read_map, with_room
from facerf_cli.work.photos import FittedFace, companion
from facerf_cli.work.plan import beside
from facerf_cli.work.relight_options import BackgroundChoice, RelightPlan

Behind = Callable[[LightSetup, float], Rows | None]  # the image behind a person, for a setup and an exposure


@dataclass(frozen=True, eq=False)
class LitScene:
    """People of a photo in one image, a face alone, or a stack; the lights of setups, and what is behind.

    Attributes:
        subject: What is relit.
        setups: The lights of each image.
        lights_of: Gives setups as sums of far and near lights.
        metadata: Of all images.
        people: Of a photo, from left to right.
        faces: Their numbers, from the left, the nearest first.
        evens: Brightness of even light on each.
        tag: What follows the photo's name in those of its images.
        alpha: The photo's [H, W].
        behind: Gives the image behind the person.
        plate: Metadata of the photo that results keep.
        identity: Distance of an exposed image to the photo.
        facts: Of a stack's fit, for the report.
    """

    subject: Relightable
    setups: tuple[LightSetup, ...]
    lights_of: Callable[[tuple[LightSetup, ...]], Lights]
    metadata: Mapping[str, Any]
    people: Sequence[FittedFace] = ()
    faces: tuple[int, ...] = (0,)
    evens: tuple[float, ...] = (1.0,)
    tag: str = ""
    alpha: np.ndarray | None = None
    behind: Behind | None = None
    plate: Mapping[str, Any] = field(default_factory=dict)
    identity: Callable[[np.ndarray], float] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def lights(self) -> list[Lights]:
        """The lights of all setups, as `as_lit` lists them, on each of the people."""
        people = zip(self.faces, self.evens, strict=True)
        return [self.lights_of(as_lit(self.setups, *one)) for one in people]

    @property
    def ends(self) -> list[int]:
        """The end of each setup among the sums of `lights`, after a first 0."""
        alone = (len(with_room(setup).names) if setup.names else 0 for setup in self.setups)
        return list(accumulate((1 + lights for lights in alone), initial=0))

    @property
    def parts(self) -> list[slice]:
        """As many of the setups at a time as fit the memory."""
        most = max(last - first for first, last in pairwise(self.ends))
        return batches(len(self.setups), most * self.subject.nbytes)

    @step("render")
    def relit(self, part: slice) -> list[list[Any]]:
        """The people under some of the setups: under all of its lights, and under each that has a name."""
        ends = self.ends[part.start : part.stop + 1]
        lights = [of_one[ends[0] : ends[-1]] for of_one in self.lights]
        found = self.subject.relit(lights if isinstance(self.subject, PeopleInPhoto) else lights[0])
        return [list(islice(found, last - first)) for first, last in pairwise(ends)]


def as_lit(setups: Sequence[LightSetup], face: int, even: float = 1.0) -> tuple[LightSetup, ...]:
    """Setups as they shine on one of the people, with the light of their rooms.

    After one whose lights have names comes each of these alone.
    """
    lit = [with_room(as_in_photo(on_face(setup, face), even)) for setup in setups]
    return tuple(one for setup in lit for one in (setup, *(each_alone(setup) if setup.names else ())))


def with_background(plan: RelightPlan, item: Item) -> RelightPlan:
    """Choose the image of `--background` that goes with an item: by its place in its shot, or by its name."""
    choice = plan.options.background
    path = choice.path and companion(item, choice.path, "--background")
    if choice.frames:
        path = choice.frames[plan.shots.places[item.output_base][1]]
    return replace(plan, options=replace(plan.options, background=replace(choice, path=path, frames=())))


def backdrop(choice: BackgroundChoice, blur: float, camera: Camera) -> Behind:
    """Images [H, W, 3] behind a person, scene-linear; None for the photo's own, or for nothing.

    A file and a colour look as they are at the exposure, in EV. A map is as bright as its light; single
    lights have a black surrounding.
    """
    fixed, size_px = None, (camera.height_px, camera.width_px)
    if choice.colour is not None:
        fixed = np.broadcast_to(np.array(choice.colour, np.float32), (*size_px, 3))
    elif choice.path is not None:
        with beside(size_px, images=3):
            fixed = covering(read_image(choice.path, with_alpha=False).pixels, *size_px)

    def behind(setup: LightSetup, ev: float) -> Rows | None:
        if choice.kind != "envmap":
            return None if fixed is None else Scaled(fixed, np.float32(2.0**-ev))
        if (light := setup.envmap) is None or light.envmap is None:
            return np.broadcast_to(np.float32(0), (*size_px, 3))
        with beside(size_px, images=2):
            envmap = read_map(light.envmap)
        rays, colour = partial(rays_of_rows, camera), intensity_of(light).numpy()
        around = Backdrop(envmap, size_px, rays, light.rotate_deg, blur)
        return Scaled(around, colour)

    return behind


def check_faces(item: Item, relit: Sequence[int], plan: RelightPlan) -> None:
    """Raise InputError if a light is for a face that is not among the relit ones, given by their numbers."""
    if others := plan.lit_faces.difference(relit):
        numbers = ", ".join(map(str, relit))
        raise InputError(
            f"{item.input_path}: a light is for face {min(others)}, but only face {numbers} is relit; "
            "add --face all, or remove that light"
        )
