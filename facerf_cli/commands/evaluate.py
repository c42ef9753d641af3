"""`facerf evaluate`: the paper's comparisons, a verb a protocol, on anybody's data."""

from collections.abc import Callable

import typer

app = typer.Typer(help="Measure on prepared data, photos or other methods' pictures.")

# Each takes the shared options of `evaluation_options.py` and ends in `evaluation_run.run_protocol`.
PROTOCOLS: tuple[Callable[..., None], ...] = ()

for _protocol in PROTOCOLS:
    app.command(epilog="Global options (see 'facerf --help') may stand before or after the verb.")(_protocol)
