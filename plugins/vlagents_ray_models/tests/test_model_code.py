"""The source of a model's code: an installation, or a checkout that a setting or an environment
variable names.
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray_models.model_code import use_source

NAME, VARIABLE = "model_of_somebody", "MODEL_OF_SOMEBODY_SRC"


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, NAME, raising=False)
    monkeypatch.delenv(VARIABLE, raising=False)
    (tmp_path / "src" / NAME).mkdir(parents=True)
    (tmp_path / "src" / NAME / "__init__.py").write_text("")
    importlib.invalidate_caches()
    return tmp_path


@pytest.mark.parametrize("by", ["setting", "variable"])
def test_a_checkout_is_imported_from(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    if by == "variable":
        monkeypatch.setenv(VARIABLE, str(checkout))
    use_source(NAME, VARIABLE, str(checkout) if by == "setting" else None, within=["src"])
    assert importlib.import_module(NAME).__file__ == str(checkout / "src" / NAME / "__init__.py")
    length = len(sys.path)
    use_source(NAME, VARIABLE, str(checkout), within=["src"])
    assert len(sys.path) == length


def test_a_checkout_that_is_named_is_taken_though_a_folder_elsewhere_has_the_packages_name(
    checkout: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The checkout's own folder may have the package's name, and Python imports any folder as a
    package.
    """
    (checkout / "here" / NAME).mkdir(parents=True)
    monkeypatch.syspath_prepend(str(checkout / "here"))
    monkeypatch.setenv(VARIABLE, str(checkout))
    use_source(NAME, VARIABLE, within=["src"])
    assert importlib.import_module(NAME).__file__ == str(checkout / "src" / NAME / "__init__.py")


def test_an_installed_package_needs_no_checkout() -> None:
    before = list(sys.path)
    use_source("json", VARIABLE)
    assert sys.path == before


def test_a_missing_package_is_an_error_with_both_ways_to_name_a_checkout(checkout: Path) -> None:
    with pytest.raises(
        ConfigError, match=rf"\${VARIABLE}, which is not set.*source_dir or in {VARIABLE}"
    ):
        use_source(NAME, VARIABLE)
    with pytest.raises(ConfigError, match=r"neither installed nor in .*source_dir"):
        use_source(NAME, VARIABLE, str(checkout))
