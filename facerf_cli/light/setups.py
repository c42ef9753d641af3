"""Light setups: the lights that shine together in one image. Imports neither numpy nor torch."""

from dataclasses import dataclass, replace
from typing import Self

from facerf_cli.light.entries import StudioLight

AMBIENT = "ambient"  # name of the ambient fill, and of its layer


@dataclass(frozen=True)
class LightSetup:
    """Lights of one image: maps, single lights, or both.

    Attributes:
        name: Part of the image's file name.
        frame: Frame number that ends the file name, such as '.0001'; '' for a still.
        lights: The lights, each of them with its own intensity.
        names: One name per light, if each light is also a layer of the image.
        ambient: Ambient fill as a fraction of the sum of the single lights.
        exposure_ev: Exposure of the image if the user does not choose one; None: chosen automatically.
    """

    name: str
    frame: str = ""
    lights: tuple[StudioLight, ...] = ()
    names: tuple[str, ...] = ()
    ambient: float = 0.0
    exposure_ev: float | None = None

    @property
    def envmap(self) -> StudioLight | None:
        """The first map among the lights."""
        return next((light for light in self.lights if light.envmap is not None), None)

    @property
    def has_single(self) -> bool:
        """True if a light is neither a map nor the photo's original light."""
        return any(light.envmap is None and not light.original for light in self.lights)

    @property
    def has_original(self) -> bool:
        """True if the photo's original light is one of the lights."""
        return any(light.original for light in self.lights)

    @property
    def by_photo(self) -> list[StudioLight]:
        """Lights whose brightness follows from the photo."""
        return [light for light in self.lights if light.original or light.delight]

    def on_person(self, face: int, uniform: float = 1.0) -> Self:
        """Return the setup as it lights one person.

        Lights of other faces become dark. `uniform` is the intensity at which uniform light makes the
        person's skin as bright as in the photo.
        """

        def lit(light: StudioLight) -> StudioLight:
            factor = 0.0 if light.face not in (None, face) else uniform if light.delight else 1.0
            red, green, blue = (factor * value for value in light.rgb)
            return replace(light, rgb=(red, green, blue), delight=False)

        return replace(self, lights=tuple(map(lit, self.lights)))
