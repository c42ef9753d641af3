"""The track file of a shot."""

from pathlib import Path

from facerf_cli.relighting.shot_track import ShotTrack


def test_a_track_is_read_whole_or_not_at_all(tmp_path: Path) -> None:
    """It is facerf's as long as its rows are; a last line break does not matter."""
    rows = [{"frame": number, "cut": number in (2, 4), "landmarks": None} for number in range(5)]
    path, track = tmp_path / "me_track.jsonl", ShotTrack({"frames": 5}, rows)
    assert track.takes == [range(2), range(2, 4), range(4, 5)]
    track.write(path)
    path.write_text(path.read_text().removesuffix("\n"))
    assert ShotTrack.read(path) == track
    path.write_text(path.read_text().replace("true", "false", 1))
    assert ShotTrack.read(path).takes == [range(4), range(4, 5)] and not ShotTrack.read(path).is_own
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:2]))
    assert ShotTrack.read(path) == ShotTrack(None, (), False)
