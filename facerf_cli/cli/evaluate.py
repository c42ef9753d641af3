"""`facerf evaluate`: the paper's comparisons, a verb a protocol, on anybody's data."""

from collections.abc import Callable

import typer

from facerf_cli.cli.evaluate_geometry import geometry
from facerf_cli.cli.evaluate_olat import olat
from facerf_cli.cli.evaluate_pairs import WITHOUT as NOT_OF_PAIRS
from facerf_cli.cli.evaluate_pairs import pairs
from facerf_cli.cli.evaluate_reconstruction import reconstruction
from facerf_cli.cli.evaluate_transfer import transfer
from facerf_cli.cli.evaluate_yale_b import WITHOUT as NOT_OF_YALE_B
from facerf_cli.cli.evaluate_yale_b import yale_b
from facerf_cli.cli.evaluation_options import with_shared_options
from facerf_cli.cli.options import with_machines

app = typer.Typer(help="Measure the paper's tables on prepared data and photos, and other methods' pictures.")

# Each protocol's function, which takes `options: EvaluateOptions`, and the shared options that it has no use
# for; all end in `evaluation_run.run_protocol`.
PROTOCOLS: tuple[tuple[Callable[..., int], tuple[str, ...]], ...] = (
    (olat, ()),
    (reconstruction, ()),
    (transfer, ()),
    (geometry, ()),
    (yale_b, NOT_OF_YALE_B),
    (pairs, NOT_OF_PAIRS),
)
_EPILOG = "Global options (see 'facerf --help') may stand before or after the verb."

for _function, _left_out in PROTOCOLS:
    _command = with_machines(with_shared_options(_function, _left_out))
    app.command(epilog=_EPILOG, context_settings={"help_option_names": ["-h", "--help"]})(_command)
