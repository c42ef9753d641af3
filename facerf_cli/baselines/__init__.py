"""Reflectance models that the paper compares with ('Light Estimation'); see docs/paper.md."""

from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from facerf_cli.baselines.base import Explained
    from facerf_cli.face.head import Head
    from facerf_cli.relighting.models import Models

Kind = Literal["field", "diffuse-sh", "specular-sh", "prt"]  # models of a face: neural field and baselines
RelightKind = Literal["portrait", "field", "diffuse-sh", "specular-sh", "prt"]  # models that relight a photo


def explain_by_baseline(models: "Models", head: "Head", kind: Kind) -> "Explained":
    """Estimate reflectance and light from a head's photo with a baseline."""
    if kind == "diffuse-sh":  # relighting with the neural fields imports no baseline
        from facerf_cli.baselines.diffuse_sh import explain_by_diffuse_sh as explain
    elif kind == "specular-sh":
        from facerf_cli.baselines.specular_sh import explain_by_specular_sh as explain
    else:
        from facerf_cli.baselines.prt import explain_by_prt as explain
    return explain(models, head.fit, head.face)
