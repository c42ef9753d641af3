"""A node of a Ray cluster that is lost while a folder is processed on it.

    python -m benchmarks.faults.nodes [--verb convert-light] [--items 400] [--lost worker]

Two nodes on this machine, with a processor each, by `ray start`; the raylet of one is killed in the middle of
a run. A run that loses a worker's node must end well, with the bytes of a run without Ray and a row an item.
One that loses its own node must end with one error that says what to do, and leave whole files; the same
command without Ray must then finish it. Exits 1 if anything was wrong.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from benchmarks._common import ROOT, arguments, required_package
from benchmarks.faults.runs import VERBS, faults_of, fresh, outputs
from facerf_cli.batch.run import REPORT_NAME

_PATIENCE_S = 240
_PORT = 6391
# Workers as nice as others (Ray's own 15 starves them beside other programs); no page on the web.
_ENVIRONMENT = {"RAY_worker_niceness": "0", "RAY_AUTH_MODE": "token", "RAY_USAGE_STATS_ENABLED": "0"}
_OF_NODES = ("--num-cpus", "1", "--object-store-memory", "100000000")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--verb", choices=sorted(VERBS), default="convert-light")
    parser.add_argument("--items", type=int, default=400)
    parser.add_argument("--lost", choices=["worker", "own"], default="worker", help="whose node is lost")
    given = parser.parse_args()
    required_package("ray", "ray")
    verb = VERBS[given.verb]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        verb.fill(fresh(folder / "in"), given.items)
        assert _ended(verb.line(folder / "in", folder / "whole"))[0] == 0
        whole, line = outputs(folder / "whole"), verb.line(folder / "in", folder / "out")
        with _two_nodes() as address:
            process = subprocess.Popen(_command([*line, "--ray", address]), **_options())
            _wait_for(folder / "out" / REPORT_NAME, given.items // 4)
            rows = _rows(folder / "out" / REPORT_NAME)
            _kill(f"--node-name={given.lost}", b"/raylet")
            said, code = process.communicate(timeout=_PATIENCE_S)[1], process.returncode
        found = faults_of(folder / "out", whole, finished=given.lost == "worker")
        if given.lost == "own":
            one = said.count("facerf: error:") == 1 and "start it again, then run the same command" in said
            found += [] if code == 1 and one else [f"not one line, exit {code}"]
            code, again = _ended(line)
            found += [f"exit {code} of the last run: {again}"] if code else []
            found += faults_of(folder / "out", whole, finished=True)
    found += [f"said {said[:500]}"] if "Traceback" in said or "unexpected" in said else []
    print(
        f"{verb.name}, the {given.lost} node lost at {rows} rows: exit {code}; {'; '.join(found) or 'well'}"
    )
    print("".join(f"  {line}\n" for line in said.splitlines())[:900], end="")
    sys.exit(int(bool(found or code)))


@contextmanager
def _two_nodes() -> Iterator[str]:
    """The address of a cluster: the first node is that which a run on this machine joins."""
    environment = os.environ | _ENVIRONMENT
    head = ["--head", "--port", str(_PORT), "--include-dashboard=false", "--node-name", "own", *_OF_NODES]

    def start(*line: str) -> None:
        ray = Path(sys.executable).with_name("ray")
        subprocess.run([ray, "start", *line], env=environment, check=True, stdout=subprocess.DEVNULL)

    with tempfile.TemporaryDirectory(
        dir="/tmp", ignore_cleanup_errors=True
    ) as name:  # names of sockets are short
        try:
            start(*head, "--temp-dir", name)
            address = f"{_own_ip()}:{_PORT}"
            start("--address", address, "--node-name", "worker", *_OF_NODES)
            yield address
        finally:
            _kill(name)


def _own_ip() -> str:
    from ray.util import get_node_ip_address

    return str(get_node_ip_address())


def _kill(word: str, program: bytes = b"") -> None:
    """Kill the processes, of a program, with a word in their command line."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it has ended
            command = path.read_bytes()
            if command.split(b"\0")[0].endswith(program) and word.encode() in command:
                os.kill(int(path.parent.name), signal.SIGKILL)


def _options() -> dict[str, object]:
    return {
        "env": os.environ | _ENVIRONMENT | {"PYTHONPATH": str(ROOT)},
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.PIPE,
        "text": True,
    }


def _ended(line: list[str]) -> tuple[int, str]:
    """Run a command line: its exit code, and what it said."""
    ended = subprocess.run(_command(line), **_options())  # type: ignore[call-overload]
    return ended.returncode, ended.stderr


def _command(line: list[str]) -> list[str]:
    return [sys.executable, "-c", "from facerf_cli.main import run; run()", *line]


def _rows(report: Path) -> int:
    return report.read_bytes().count(b"\n") if report.exists() else 0


def _wait_for(report: Path, rows: int) -> None:
    end = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end and _rows(report) < rows:
        time.sleep(0.1)


if __name__ == "__main__":
    main()
