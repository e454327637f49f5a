"""An evaluation is of one program: whatever file of it changes, results are not mixed."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from in_process_evaluation import flat_config

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results, compare
from vlagents_ray.evaluate.episode.records import EnvInfo, EpisodeResult
from vlagents_ray.evaluate.exports.tables import rows
from vlagents_ray.evaluate.merge import merge
from vlagents_ray.evaluate.plan.cases import cells
from vlagents_ray.evaluate.plan.jobs import plan
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.results.summary import summarize
from vlagents_ray.policies.base.program import code_of_class, digest_of, files_named

FILES = {
    "prog_env.py": "from prog_parts.sea import CURRENT\nfrom eval_fakes import Line\nclass Sea(Line):\n    pass\n",
    "prog_parts/__init__.py": "",
    "prog_parts/sea.py": "from . import wind\nCURRENT = 0.03\n",
    "prog_parts/wind.py": "WIND = 1\n",
    "prog_pilot.py": "def act():\n    import prog_helm\n",
    "prog_helm.py": "SIGN = -1\n",
    "chart.txt": "three buoys",
    "gains.yaml": "gain: 1\n",
    "w.npz": "weights",
}
ENV_FILES = {"prog_env.py", "prog_parts/sea.py", "prog_parts/wind.py", "chart.txt"}
Play = Callable[..., EvalConfig]


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with an own environment, an own policy, and files that their settings name."""
    folder = tmp_path / "work"
    for name, text in FILES.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.chdir(folder)
    yield folder
    for name in [name for name in sys.modules if name.startswith("prog_")]:
        del sys.modules[name]


def edit(name: str) -> None:
    path = Path(name)
    path.write_text(path.read_text() + "# edited\n")


def served(own_weights: str | None) -> dict[str, Any]:
    """The metadata of a server of the policy, as a replica makes it."""
    files = files_named({"checkpoint": "w.npz", "gains": "gains.yaml"})
    weights = {"digest": own_weights or digest_of(files), "revision": None}
    program = code_of_class("prog_pilot:Pilot") | files
    return {"policy": "prog_pilot:Pilot", "checkpoint": "w.npz", "weights": weights, "program": program}


def played(out: Path, *, episodes: int = 2, own_weights: str | None = None, **changes: Any) -> EvalConfig:
    """Play the episodes of a plan that have no result, without a simulator."""
    settings = {"envs": ["prog_env:Sea"], "episodes": episodes, "env_options": {"folder": "chart.txt"}, "policy": "own"}
    config = flat_config(**{**settings, "out": out, **changes})
    said = served(own_weights)
    with Store(config) as store:
        store.begin_run(config, {})
        for job in plan(store.cells):
            if str(job.key) in store.finished():
                continue
            store.note_policy(job.cell.policy.name, said)
            store.note_env(job.cell.place, EnvInfo({}, {}, program=dict(job.cell.program), host="here"))
            result = EpisodeResult(job.key, "done", True, True, steps=4, ending="truncated", checkpoint="w.npz")
            store.record(replace(result, weights=said["weights"]["digest"]), attempts=1)
        store.end_run("complete")
    return config


def resumed(tmp_path: Path, change: Callable[[], Any], **options: Any) -> Results:
    played(tmp_path / "out")
    again: dict[str, Any] = change() or {}
    return Results.load(played(tmp_path / "out", resume=True, **{"episodes": 4, **again, **options}).out)


def merged(tmp_path: Path, change: Callable[[], Any], **options: Any) -> Results:
    played(tmp_path / "a")
    again: dict[str, Any] = change() or {}
    played(tmp_path / "b", **{"seed": 100, **again})
    return merge(tmp_path / "c", [tmp_path / "a", tmp_path / "b"], **options).results


def watched(tmp_path: Path, change: Callable[[], Any], **options: Any) -> Results:
    """One step of a training, then the same step with more episodes, and the next one."""
    played(tmp_path / "out", steps=[1])
    again: dict[str, Any] = change() or {}
    settings = {"steps": [1, 2], "episodes": 3, **again, **options}
    return Results.load(played(tmp_path / "out", resume=True, **settings).out)


WAYS = [resumed, merged, watched]
NAMED = [name for name in FILES if not name.endswith("__init__.py")]


@pytest.mark.parametrize("way", WAYS)
def test_unchanged_files_are_gone_on_with(work: Path, tmp_path: Path, way: Callable[..., Results]) -> None:
    found = way(tmp_path, lambda: Path("unrelated.py").write_text("1") and None)
    assert found.accepted_changes == []
    assert len({row["env_program"] for row in rows(found)}) == 1
    assert set(found.cells[0].program) >= {"prog_env.py", "prog_parts/sea.py", "prog_parts/wind.py"}


@pytest.mark.parametrize(
    ("way", "name"),
    [
        *((resumed, name) for name in NAMED),
        *((way, name) for way in WAYS[1:] for name in ("prog_parts/wind.py", "w.npz")),
    ],
)
def test_a_changed_file_is_refused_by_its_name_and_an_accepted_change_is_in_the_report(
    work: Path, tmp_path: Path, way: Callable[..., Results], name: str
) -> None:
    with pytest.raises(ConfigError, match=rf"(?s){name} was .*sha256:\w+, is .*sha256:\w+.*--accept-changes"):
        way(tmp_path / "refused", lambda: edit(name))
    found = way(tmp_path / "accepted", lambda: edit(name), accept_changes=True)
    assert any(change.name.endswith(name) for change in found.accepted_changes)
    assert summarize(found).to_json()["accepted_changes"]
    column = "env_program" if name in ENV_FILES else "policy_program"
    swept = way is watched and name == "w.npz"  # each step has its weights, which are in the results of its episodes
    assert len({row["weights" if swept else column] for row in rows(found)}) == 2


@pytest.mark.parametrize("way", WAYS)
def test_other_weights_of_a_class_that_names_them_are_refused(
    work: Path, tmp_path: Path, way: Callable[..., Results]
) -> None:
    with pytest.raises(ConfigError, match=r"(weights|w\.npz) was .*, is mine|several weights under one name"):
        way(tmp_path, lambda: {"own_weights": "mine"})


@pytest.mark.parametrize("change", [{"envs": ["eval_fakes:Line"], "env_options": {}}, {"policy": "another"}])
def test_another_plan_is_not_added_to_results(work: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"own prog_env:Sea was in it.*\n.*--out.*--accept-changes"):
        resumed(tmp_path, lambda: change)


def test_a_worker_that_has_other_files_is_refused_also_if_changes_are_accepted(work: Path, tmp_path: Path) -> None:
    config = flat_config(envs=["prog_env:Sea"], out=tmp_path / "out", resume=True, accept_changes=True)
    with Store(config) as store:
        store.begin_run(config, {})
        program = store.cells[0].program | {"prog_env.py": "sha256:0"}
        with pytest.raises(ConfigError, match=r"(?s)worker on far has other files.*prog_env.py was .*, is sha256:0"):
            store.note_env(store.cells[0].place, EnvInfo({}, {}, program=program, host="far"))


def test_two_policies_are_not_compared_in_different_environments(work: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    played(out, policy="a")
    edit("prog_parts/sea.py")
    played(out, policy="b", resume=True, accept_changes=True)
    with pytest.raises(ConfigError, match=r"(?s)not played in the same environment.*prog_parts/sea.py was"):
        compare(Results.load(out), "a", "b")


def test_a_cell_of_two_programs_is_not_compared(work: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    both = {"policies": [{"name": "a"}, {"name": "b"}]}
    settings = {"suites": [{"envs": ["prog_env:Sea"], "episodes": 2}], "out": out, **both}
    for resume in (False, True):
        config = EvalConfig.model_validate({**settings, "resume": resume, "accept_changes": resume})
        with Store(config) as store:
            store.begin_run(config, {})
            for job in plan(store.cells):
                if job.key.episode == resume:
                    store.record(EpisodeResult(job.key, "done", True, True), attempts=1)
        edit("prog_env.py")
    with pytest.raises(ConfigError, match="2 versions of its files"):
        compare(Results.load(out), "a", "b")


def test_installed_and_own_code_are_told_apart(work: Path) -> None:
    assert set(code_of_class("prog_pilot:Pilot")) == {"prog_pilot.py", "prog_helm.py"}
    assert code_of_class("vlagents_ray.policies.noop:Noop") == {}
    assert code_of_class("json:JSONDecoder") == {}
    assert code_of_class("no_such_module:Policy") == {}
    [(name, version)] = code_of_class("pydantic:BaseModel").items()
    assert (name, version.startswith("version ")) == ("pydantic", True)


@pytest.mark.parametrize("env", ["gymnasium/prog_env/Sea-v0", "gymnasium/prog_env:Sea-v0"])
def test_the_module_that_registers_an_env_of_gymnasium_is_part_of_the_program(work: Path, env: str) -> None:
    config = flat_config(envs=[env], episodes=1, policy="own", out=work / "out")
    assert {name for cell in cells(config) for name in cell.program} >= ENV_FILES - {"chart.txt"}


def test_a_checkpoint_is_found_at_its_step_and_the_working_folder_is_none(work: Path) -> None:
    Path("7").mkdir()
    Path("7/w.bin").write_text("7")
    assert set(files_named({"checkpoint": "{step}", "checkpoint_step": 7})) == {"checkpoint: 7/w.bin"}
    assert files_named({"checkpoint": "{step}", "checkpoint_step": 7}, folders=False) == {}
    assert files_named({"a": ".", "b": "no such file", "c": 3, "d": {"e": ["", "\0"]}}) == {}
