"""A photo explained by the reflectance model of one's choice."""

from facerf_cli.baselines import Kind
from facerf_cli.baselines.base import Explained
from facerf_cli.baselines.diffuse_sh import explain_by_diffuse_sh
from facerf_cli.baselines.field import explain_by_field
from facerf_cli.baselines.prt import explain_by_prt
from facerf_cli.baselines.specular_sh import explain_by_specular_sh
from facerf_cli.face.fit import FaceFit
from facerf_cli.pipeline import FaceTexture, Models


def explain(
    kind: Kind, models: Models, fit: FaceFit, face: FaceTexture, held_to_photo: bool = False
) -> Explained:
    """Reflectance and light of a fitted photo.

    `held_to_photo` is for the field alone: it is then exact under the photo's own light by construction
    (`light/quotient.py`), so leave it off where reconstruction is what is measured.
    """
    if kind == "field":
        return explain_by_field(models, face, held_to_photo)
    if kind == "specular-sh":
        return explain_by_specular_sh(models, fit, face)
    if kind == "prt":
        return explain_by_prt(models, fit, face)
    return explain_by_diffuse_sh(models, fit, face)
