"""Networks and objectives of code that the user has installed."""

from pathlib import Path

import pytest

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.network import checkpoint
from facerf_cli.network.checkpoint import (
    form_of,
    load_networks,
    new_network,
    save_networks,
    use_form,
)
from tests.own_package import FORMS, NAME, write_own_package
from tests.refusals import refused


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an installed package."""
    write_own_package(tmp_path / "site", monkeypatch)
    return tmp_path / "site"


def test_an_own_network_is_saved_and_needs_its_name(package: Path, tmp_path: Path) -> None:
    use_form(NAME)
    network = new_network("reflectance", NAME, {})
    path = tmp_path / "own.safetensors"
    save_networks(path, {"reflectance": network}, {"layout_version": LAYOUT_VERSION})
    loaded = load_networks(path, LAYOUT_VERSION)[0]["reflectance"]
    assert type(loaded) is type(network) and type(loaded).__name__ == "Darker"
    del checkpoint._CLASSES["reflectance", NAME]
    refused(InputError, f"own.safetensors: ... --form {NAME}", load_networks, path, LAYOUT_VERSION)


def test_a_class_that_extends_a_form_is_made_like_it(package: Path) -> None:
    use_form(NAME)
    assert form_of("reflectance", NAME) == "default"
    for network, form in (("reflectance", "paper"), ("geometry", "paper"), ("reflectance", "my_lab:Other")):
        assert form_of(network, form) == form


def test_what_is_not_installed_is_one_line(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.chdir(package)  # nothing comes from the working directory
        refused(UsageError, "install its package ... working directory", use_form, NAME)
    for name, advice in (
        ("my_lab.networks:Nobody", "correct the name"),
        ("nobody.networks:Darker", "install its package"),
        ("my_lab.networks:number", "not a subclass of"),
        ("my_lab.networks:Doubled", "not a subclass of"),
    ):
        refused(UsageError, f"--form {name}: ... {advice}", use_form, name)
    for name in ("my_lab.networks.Darker", "Darker"):
        refused(UsageError, f"--form {name}: ... package.module:Class", use_form, name)
    assert checkpoint._CLASSES == FORMS


def test_facerfs_own_forms_import_nothing() -> None:
    use_form("paper")
    assert checkpoint._CLASSES == FORMS
    refused(UsageError, "no such Reflectance Network", new_network, "reflectance", "os:system", {})
