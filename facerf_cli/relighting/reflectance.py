"""The reflectance of the person in a photo: the portrait field, the face's field, or a baseline."""

from dataclasses import replace

import numpy as np

from facerf_cli.baselines import RelightKind, explain_by_baseline
from facerf_cli.baselines.base import Reflectance
from facerf_cli.errors import UsageError
from facerf_cli.face.head import Head
from facerf_cli.portrait.person import (
    SeenPerson,
    look_at_person,
    maps_with_normals,
    wider_square,
    with_normals,
)
from facerf_cli.relighting import White
from facerf_cli.relighting.field import Field, balance_of
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.photo_light import SourceLight, source_light
from facerf_cli.relighting.portrait_field import PortraitField, SteadyFrame, maps_of
from facerf_cli.run.logs import step
from facerf_cli.run.threads import both


@step("reflectance")
def reflectance_of(
    models: Models,
    head: Head,
    kind: RelightKind = "field",
    network_alone: bool = False,
    photo: np.ndarray | None = None,
    steady: SteadyFrame | None = None,
    matte: np.ndarray | None = None,
    white: White | None = None,
    normals: np.ndarray | None = None,
) -> Reflectance:
    """Read the reflectance of a head from its photo.

    Args:
        models: The networks and the face model.
        head: The head in the photo.
        kind: The portrait field, the face's, or a baseline of the paper, which has neither quotient nor
            white.
        network_alone: Leave out the correction by the photo's quotient image, by which the photo comes back
            under its own light.
        photo: Scene-linear [H, W, 3], which the portrait field needs itself.
        steady: What the frames around it steady, of a frame of a shot, which has the face's field alone where
            it shows nobody.
        matte: The person's share [H, W] of the photo, if it is given.
        white: Under even white light skin has the photo's colours, or those of skin (`white.py`); None leaves
            the network's.
        normals: Unit normals [H, W, 3] of the photo, which the portrait field takes for the networks'.
    """
    if kind != "field" and kind != "portrait":
        return explain_by_baseline(models, head, kind).reflectance
    if kind == "portrait" and photo is None:
        raise UsageError("--reflectance portrait: needs the whole photo; give --reflectance field")

    def of_face() -> tuple[SourceLight | None, Field]:
        found = None if network_alone else source_light(models, head.face, steady.light if steady else None)
        quotient = found.quotient if found else None
        field = Field(models, head.face, quotient, even_shade=found is not None)
        field = field.with_detail(found.even) if found else field
        if steady or white is None:
            return found, replace(field, balance=steady.balance if steady else None)
        even = found.even if found else field.small_under_even_light()
        return found, replace(field, balance=balance_of(white, [(head.face, even)]))

    def of_person() -> list[SeenPerson]:
        assert photo is not None
        people, others = models.networks.people, head.others
        person = look_at_person(people, models.face, photo, head.fit, matte=matte, others=others)
        if normals is not None:
            person = with_normals(person, normals)
        wide = wider_square(person.square, person.segmentation.matte)
        return [person] if wide is None else [person, person.within(wide, photo)]

    if photo is None or kind == "field" or (steady and not steady.portrait):
        return of_face()[1]
    if steady:
        source, field = of_face()
        return PortraitField.of(models.face, head, field, source, steady.portrait)
    (source, field), views = both(of_face, of_person)
    seen = [(one, maps_with_normals(maps_of(models.networks.portrait, one), one)) for one in views]
    return PortraitField.of(models.face, head, field, source, seen)
