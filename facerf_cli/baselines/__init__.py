"""The reflectance models with which the paper compares ('Light Estimation'); see docs/paper.md."""

from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from facerf_cli.baselines.base import Explained
    from facerf_cli.face.head import Head
    from facerf_cli.relighting.models import Models

# Models of a face: the paper's neural field, or one that it is compared with.
Kind = Literal["field", "diffuse-sh", "specular-sh", "prt"]
# Models that relight a photo: of the whole portrait, or of its face.
RelightKind = Literal["portrait", "field", "diffuse-sh", "specular-sh", "prt"]


def explain_by_baseline(models: "Models", head: "Head", kind: Kind) -> "Explained":
    """Estimate the reflectance and the light of a head's photo by one of these models."""
    if kind == "diffuse-sh":  # relighting by the fields loads none of these
        from facerf_cli.baselines.diffuse_sh import explain_by_diffuse_sh as explained
    elif kind == "specular-sh":
        from facerf_cli.baselines.specular_sh import explain_by_specular_sh as explained
    else:
        from facerf_cli.baselines.prt import explain_by_prt as explained
    return explained(models, head.fit, head.face)
