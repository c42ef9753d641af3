"""A light as lighters set it, at a place or from a direction; settings only, without torch."""

from dataclasses import dataclass

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class StudioLight:
    """A light from a direction (azimuth, elevation), or near, at a place in metres from the face's centre.

    A light that has neither comes from all around, as of a room or a dull sky: every surface that nothing
    shades receives the same.

    Camera axes. At the face's centre its irradiance is that of a far light of its colour: `rgb` times the
    colour of a blackbody of `kelvin`, times 2 to `stops`. `size_m` is the side of the square of a near light,
    which faces the face; `size_deg` that of a far one, as seen from there. `spot_deg` is the full angle of a
    near light's cone, which is aimed at the face.
    """

    azel_deg: tuple[float, float] | None = None
    at_m: Triple | None = None
    rgb: Triple = (1.0, 1.0, 1.0)
    kelvin: float | None = None
    stops: float = 0.0
    size_m: float = 0.0
    size_deg: float = 0.0
    spot_deg: float | None = None
