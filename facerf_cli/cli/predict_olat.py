"""`facerf predict-olat`: a photo's person under every light of a rig, as an OLAT stack."""

from dataclasses import dataclass

import typer

from facerf_cli.batch.inputs import Item
from facerf_cli.cli.options import InputsArgument
from facerf_cli.work.photo_work import FileOrFolder, PredictOlat, Written


@dataclass(frozen=True, kw_only=True)
class PredictStacks(PredictOlat):
    """`facerf predict-olat`."""

    def write(self, item: Item) -> Written:
        """Write the stack of every chosen face."""
        from facerf_cli.work.predict_olat import write_stacks

        return write_stacks(item, self)


def predict_olat(inputs: InputsArgument, work: PredictStacks, batch: FileOrFolder) -> None:
    """Predict a photo's person under every single light of a rig (OLAT, one light at a time).

    Each photo gets an OLAT stack and a contact sheet. The stack is an OpenEXR file with one part per light,
    with the person over black; `facerf relight` accepts it instead of a photo, except for UV textures. Lights
    are fixed to the camera and have unit intensity: AZ > 0 lights the image's right side, EL > 0 comes from
    above.
    """
    raise typer.Exit(work.run(inputs, batch))
