"""Where compiled programs are kept, and that a later start finds them."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from vlagents_ray.policies.compilation import Compilation, keep_jax_programs, keep_torch_programs

pytestmark = pytest.mark.torch

TORCH = "TORCHINDUCTOR_CACHE_DIR"


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's cache, in which nothing is yet."""
    monkeypatch.setenv(TORCH, "")  # so that its old value comes back: torch and the tested function set it
    monkeypatch.delenv(TORCH)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def jax_with(folder: str | None) -> Any:
    config = SimpleNamespace(jax_compilation_cache_dir=folder)
    config.update = lambda name, value: setattr(config, name, value)
    return SimpleNamespace(config=config)


@pytest.mark.parametrize("chosen", [None, "/tmp/torchinductor_me"])  # unset, or torch's own choice
def test_programs_are_kept_where_only_the_user_may_write(
    cache: Path, monkeypatch: pytest.MonkeyPatch, chosen: str | None
) -> None:
    if chosen is not None:
        monkeypatch.setenv(TORCH, chosen)
    keep_torch_programs()
    keep_jax_programs(jax := jax_with(None), "gpu")
    for folder in (Path(os.environ[TORCH]), Path(jax.config.jax_compilation_cache_dir)):
        assert folder.is_relative_to(cache)
        assert folder.stat().st_mode & 0o777 == 0o700


def test_programs_of_jax_for_a_cpu_are_not_kept(cache: Path) -> None:
    """JAX 0.5.3 computes something else with one that it has read."""
    keep_jax_programs(jax := jax_with(None), "cpu")
    assert jax.config.jax_compilation_cache_dir is None
    assert not cache.exists()


def test_a_folder_that_the_user_named_is_kept(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TORCH, "/mine")
    keep_torch_programs()
    keep_jax_programs(jax := jax_with("/mine"), "gpu")
    assert os.environ[TORCH] == jax.config.jax_compilation_cache_dir == "/mine"
    assert not cache.exists()


def test_a_cache_that_cannot_be_written_is_no_error(
    cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    cache.write_text("a file in the folder's place")
    keep_torch_programs()
    assert TORCH not in os.environ
    assert "compiled programs are not kept" in caplog.text


@pytest.mark.filterwarnings("ignore:`torch.jit.:DeprecationWarning")  # of torch's own compiler
@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_a_program_is_compiled_once_and_found_at_the_next_start(cache: Path) -> None:
    def start() -> tuple[int, int]:
        """Compile, as a new process would; returns how many programs were found, and how many were not."""
        torch._dynamo.reset()
        torch._dynamo.utils.counters.clear()
        compilation = Compilation("require")
        core = compilation.core("core", lambda numbers: (numbers * 2).sin().sum(-1, keepdim=True))
        compilation.add_size(2, lambda: core(torch.ones(2, 3)))
        torch.testing.assert_close(core(torch.ones(1, 3)), torch.full((1, 1), 3.0) * torch.tensor(2.0).sin())
        counters = torch._dynamo.utils.counters
        found = counters["aot_autograd"]["autograd_cache_hit"] + counters["inductor"]["fxgraph_cache_hit"]
        return min(found, 1), counters["inductor"]["fxgraph_cache_miss"]

    assert start() == (0, 1)
    assert list(cache.rglob("*.so"))
    assert start() == (1, 0)
    torch._dynamo.reset()
