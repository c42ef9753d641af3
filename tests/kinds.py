"""Kinds of pytest's fixtures by short names, so that a test's signature stays in its line."""

import pytest

Said = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch
Log = pytest.LogCaptureFixture
Folders = pytest.TempPathFactory
