"""A node of a Ray cluster that is lost while a folder is processed on it.

    python -m benchmarks.faults.nodes [--verb convert-light] [--items 40]

Two nodes on this machine, with a processor each; the one without the head is ended in the middle of a run.
The run must end well, with the bytes of a run without Ray and a row an item. Exits 1 if anything was wrong.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks._common import ROOT, arguments, required_package
from benchmarks.faults.runs import VERBS, faults_of, fresh, outputs
from facerf_cli.cli.batch import REPORT_NAME

_PATIENCE_S = 300


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--verb", choices=sorted(VERBS), default="convert-light")
    parser.add_argument("--items", type=int, default=40)
    given = parser.parse_args()
    required_package("ray", "ray")
    from ray.cluster_utils import Cluster

    verb = VERBS[given.verb]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        verb.fill(fresh(folder / "in"), given.items)
        subprocess.run(_command(verb.line(folder / "in", folder / "whole")), env=_environment(), check=True)
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
        lost = cluster.add_node(num_cpus=1)
        line = [*verb.line(folder / "in", folder / "out"), "--ray", cluster.address]
        process = subprocess.Popen(
            _command(line), env=_environment(), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        _wait_for(folder / "out" / REPORT_NAME, given.items // 4)
        cluster.remove_node(lost, allow_graceful=False)
        said = process.communicate(timeout=_PATIENCE_S)[1]
        cluster.shutdown()
        found = faults_of(folder / "out", outputs(folder / "whole"), finished=True)
    found += [f"said {said[:500]}"] if "Traceback" in said or "unexpected" in said else []
    print(f"{verb.name}, a node of two lost: exit {process.returncode}; {'; '.join(found) or 'well'}")
    print("".join(f"  {line}\n" for line in said.splitlines() if "lost" in line)[:600], end="")
    sys.exit(int(bool(found or process.returncode)))


def _environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(ROOT)}


def _command(line: list[str]) -> list[str]:
    return [sys.executable, "-c", "from facerf_cli.main import run; run()", *line]


def _wait_for(report: Path, rows: int) -> None:
    end = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end and not (report.exists() and report.read_bytes().count(b"\n") >= rows):
        time.sleep(0.2)


if __name__ == "__main__":
    main()
