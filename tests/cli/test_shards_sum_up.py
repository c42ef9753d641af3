"""Verbs that end with something of all items: shards leave what one run leaves; the last writes the sum.

Those of synth-stage are in `test_synth_stage.py`.
"""

from pathlib import Path

import pytest

from facerf_cli.batch.settings import Shard
from facerf_cli.main import main
from facerf_cli.run.logs import configure_logging
from tests.dataset.dataset_fixture import write_small_dataset
from tests.evaluation.toy_protocol import evaluate
from tests.folders import tree
from tests.kinds import Said
from tests.worlds import write_capture


def test_evaluate(tmp_path: Path) -> None:
    configure_logging()
    assert evaluate(tmp_path / "whole") == 0
    output = tmp_path / "shards"
    for number in (2, 1):
        assert not (output / "summary.json").exists()
        assert evaluate(output, shard=Shard(number, 2)) == 0
    assert tree(output) == tree(tmp_path / "whole")
    assert (output / "report.html").exists()


def test_relight_dataset(tmp_path: Path, capsys: Said) -> None:
    for name in ("whole", "shards"):
        write_small_dataset(tmp_path / name, counts=(1, 1, 1), lights=12, crop_px=32)
    line = ["--envmaps", "procedural:2", "--per-subject", "3"]
    whole = ["relight-dataset", str(tmp_path / "whole"), *line]
    shards = ["relight-dataset", str(tmp_path / "shards"), *line]
    assert main(whole) == 0
    assert main([*shards, "--shard", "1/2"]) == 2
    assert "run once with --lazy and without --shard" in capsys.readouterr().err
    assert main([*shards, "--lazy"]) == 0
    assert main([*shards, "--shard", "2/2"]) == 0 and main([*shards, "--shard", "1/2"]) == 0
    assert tree(tmp_path / "shards/relit") == tree(tmp_path / "whole/relit")
    before = tree(tmp_path / "shards")
    assert main([*shards, "--shard", "1/2", "--overwrite", "always"]) == 2, "it would take the other's away"
    assert tree(tmp_path / "shards") == before


@pytest.mark.slow
def test_prepare_dataset(tmp_path: Path) -> None:
    write_capture(tmp_path / "capture", subjects=2, lights=12)
    line = ["prepare-dataset", str(tmp_path / "capture"), "--crop", "96", "--checks", "off", "-o"]
    assert main([*line, str(tmp_path / "whole")]) == 0
    for shard in ("2/2", "1/2"):
        assert not (tmp_path / "shards" / "dataset.json").exists()
        assert main([*line, str(tmp_path / "shards"), "--shard", shard]) == 0
    assert tree(tmp_path / "shards") == tree(tmp_path / "whole")
    assert (tmp_path / "whole" / "dataset.json").exists()
