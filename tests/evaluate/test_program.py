"""An evaluation belongs to one version of the program: after a change of any of its files, results
are not mixed.
"""

from __future__ import annotations

import functools
import importlib
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from in_process_evaluation import flat_config

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results, compare, evaluate
from vlagents_ray.evaluate.episode.records import EnvInfo, EpisodeResult
from vlagents_ray.evaluate.exports import rows
from vlagents_ray.evaluate.plan import cases
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.jobs import plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.report.page import write_report
from vlagents_ray.evaluate.report.success import compare_all, families_json
from vlagents_ray.evaluate.results.combination import combined
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.results.summary import summarize
from vlagents_ray.policies.base.program import (
    SOFTWARE,
    code_of_class,
    digest_of,
    files_named,
    software,
)
from vlagents_ray_results.merge import merge

FILES = {
    "prog_env.py": (
        "from prog_parts.sea import CURRENT\nfrom eval_fakes import Line\nclass "
        "Sea(Line):\n    pass\n"
    ),
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
    """Create a folder with an environment, a policy, and files that their settings name."""
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
    """Return the metadata of a server of the policy, as a replica creates them."""
    files = files_named({"checkpoint": "w.npz", "gains": "gains.yaml"})
    weights = {"digest": own_weights or digest_of(files), "revision": None}
    program = code_of_class("prog_pilot:Pilot") | files
    return {
        "policy": "prog_pilot:Pilot",
        "checkpoint": "w.npz",
        "weights": weights,
        "program": program,
    }


def played(
    out: Path,
    *,
    episodes: int = 2,
    own_weights: str | None = None,
    stated: dict[str, Any] | None = None,
    description: dict[str, Any] | None = None,
    contract: dict[str, Any] | None = None,
    versions: dict[str, Any] | None = None,
    **changes: Any,
) -> EvalConfig:
    """Run the episodes of a plan that have no result, without a simulator."""
    settings = {
        "envs": ["prog_env:Sea"],
        "episodes": episodes,
        "env_options": {"folder": "chart.txt"},
        "policy": "own",
    }
    config = flat_config(**{**settings, "out": out, **changes})
    said = served(own_weights) | (stated or {})
    with Store(resolve(config)) as store:
        store.begin_run(versions or {})
        for job in plan_jobs(store.cases):
            if str(job.key) in store.finished():
                continue
            store.note_policy(job.case.policy.name, said)
            made = EnvInfo(
                description or {}, contract or {}, program=dict(job.case.program), host="here"
            )
            store.note_env(job.case.place, made)
            result = EpisodeResult(
                job.key, "done", True, True, steps=4, ending="truncated", checkpoint="w.npz"
            )
            store.record(replace(result, weights=said["weights"]["digest"]), attempts=1)
        store.end_run("complete")
    return config


def resumed(tmp_path: Path, change: Callable[[], Any], **options: Any) -> Results:
    played(tmp_path / "out")
    again: dict[str, Any] = change() or {}
    return Results.load(
        played(tmp_path / "out", resume=True, **{"episodes": 4, **again, **options}).out
    )


def merged(tmp_path: Path, change: Callable[[], Any], **options: Any) -> Results:
    played(tmp_path / "a")
    again: dict[str, Any] = change() or {}
    played(tmp_path / "b", **{"seed": 100, **again})
    return merge(tmp_path / "c", [tmp_path / "a", tmp_path / "b"], **options).results


def watched(tmp_path: Path, change: Callable[[], Any], **options: Any) -> Results:
    """Run one step of a training, make a change, and then run the same step with more episodes and
    the next step.
    """
    played(tmp_path / "out", steps=[1])
    again: dict[str, Any] = change() or {}
    settings = {"steps": [1, 2], "episodes": 3, **again, **options}
    return Results.load(played(tmp_path / "out", resume=True, **settings).out)


# Each function begins an evaluation, makes a change, and continues the evaluation.
CONTINUATIONS = [resumed, merged, watched]
NAMED = [name for name in FILES if not name.endswith("__init__.py")]


@pytest.mark.parametrize("continuation", CONTINUATIONS)
def test_unchanged_files_are_gone_on_with(
    work: Path, tmp_path: Path, continuation: Callable[..., Results]
) -> None:
    found = continuation(tmp_path, lambda: Path("unrelated.py").write_text("1") and None)
    assert all(change.is_of_plan for change in found.accepted_changes)
    assert len({row["env_program"] for row in rows(found)}) == 1
    assert set(found.cases[0].program) >= {"prog_env.py", "prog_parts/sea.py", "prog_parts/wind.py"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("continuation", "name"),
    [
        *((resumed, name) for name in NAMED),
        *(
            (continuation, name)
            for continuation in CONTINUATIONS[1:]
            for name in ("prog_parts/wind.py", "w.npz")
        ),
    ],
)
def test_a_changed_file_is_refused_by_its_name_and_an_accepted_change_is_in_the_report(
    work: Path, tmp_path: Path, continuation: Callable[..., Results], name: str
) -> None:
    with pytest.raises(
        ConfigError, match=rf"(?s){name} was .*sha256:\w+, is .*sha256:\w+.*--accept-changes"
    ):
        continuation(tmp_path / "refused", lambda: edit(name))
    found = continuation(tmp_path / "accepted", lambda: edit(name), accept_changes=True)
    assert any(change.name.endswith(name) for change in found.accepted_changes)
    assert summarize(found).to_json()["accepted_changes"]
    column = "env_program" if name in ENV_FILES else "policy_program"
    # Each step has its own weights, which are recorded in the results of its episodes.
    swept = continuation is watched and name == "w.npz"
    assert len({row["weights" if swept else column] for row in rows(found)}) == 2


@pytest.mark.parametrize("continuation", CONTINUATIONS)
def test_other_weights_of_a_class_that_names_them_are_refused(
    work: Path, tmp_path: Path, continuation: Callable[..., Results]
) -> None:
    with pytest.raises(
        ConfigError, match=r"(weights|w\.npz) was .*, is mine|several weights under one name"
    ):
        continuation(tmp_path, lambda: {"own_weights": "mine"})


@pytest.mark.parametrize(
    "change", [{"envs": ["eval_fakes:Line"], "env_options": {}}, {"policy": "another"}]
)
def test_another_plan_is_not_added_to_results(
    work: Path, tmp_path: Path, change: dict[str, Any]
) -> None:
    with pytest.raises(
        ConfigError, match=r"own prog_env:Sea was in it.*\n.*--out.*--accept-changes"
    ):
        resumed(tmp_path, lambda: change)


def test_a_worker_that_has_other_files_is_refused_also_if_changes_are_accepted(
    work: Path, tmp_path: Path
) -> None:
    config = flat_config(
        envs=["prog_env:Sea"], out=tmp_path / "out", resume=True, accept_changes=True
    )
    with Store(resolve(config)) as store:
        store.begin_run({})
        program = store.cases[0].program | {"prog_env.py": "sha256:0"}
        with pytest.raises(
            ConfigError,
            match=r"(?s)expected the files of this process on the worker at far, got other files.*prog_env.py was .*, is sha256:0",
        ):
            store.note_env(store.cases[0].place, EnvInfo({}, {}, program=program, host="far"))


def test_two_policies_are_not_compared_in_different_environments(
    work: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    played(out, policy="a")
    edit("prog_parts/sea.py")
    played(out, policy="b", resume=True, accept_changes=True)
    with pytest.raises(
        ConfigError, match=r"(?s)in the same environment, got different ones.*prog_parts/sea.py was"
    ):
        compare(Results.load(out), "a", "b")


def compared(tmp_path: Path, change: Callable[[], Any], **options: Any) -> Results:
    """Compare two policies in two folders, with a change between the two evaluations."""
    played(tmp_path / "a", **STATED)
    again: dict[str, Any] = change() or {}
    played(tmp_path / "b", **{**STATED, **again, "policy": "another"})
    results = combined([Results.load(tmp_path / name) for name in ("a", "b")])
    found = compare(results, "own", "another", **options)
    return replace(results, runs=(replace(results.runs[0], changes=found.changes),))


def reported(tmp_path: Path, change: Callable[[], Any], **options: Any) -> Results:
    """Compare as `compared` does, but through the page and the JSON of `report`, both of which name
    the pairs that are not compared.
    """
    played(tmp_path / "a", **STATED)
    again: dict[str, Any] = change() or {}
    played(tmp_path / "b", **{**STATED, **again, "policy": "another"})
    results = combined([Results.load(tmp_path / name) for name in ("a", "b")])
    view = compare_all(summarize(results), **options)
    assert view is not None
    of_json = families_json(summarize(results), **options)
    assert len(of_json) == sum(len(part.shown) for part in view.parts)
    if view.reasons:
        assert not of_json
        raise ConfigError("\n".join(view.reasons))
    assert (
        "allowed" in write_report(results, tmp_path / "page.html", **options).read_text()
    ) == bool(view.changes)
    return replace(results, runs=(replace(results.runs[0], changes=tuple(view.changes)),))


def resumed_as_stated(tmp_path: Path, change: Callable[[], Any], **options: Any) -> Results:
    played(tmp_path / "out", **STATED)
    again: dict[str, Any] = change() or {}
    return Results.load(
        played(tmp_path / "out", resume=True, **{**STATED, "episodes": 4, **again, **options}).out
    )


def merged_as_stated(tmp_path: Path, change: Callable[[], Any], **options: Any) -> Results:
    played(tmp_path / "a", **STATED)
    again: dict[str, Any] = change() or {}
    played(tmp_path / "b", **{**STATED, "seed": 100, **again})
    return merge(tmp_path / "c", [tmp_path / "a", tmp_path / "b"], **options).results


STATED: dict[str, Any] = {
    "description": {"mujoco": "3.3.0", "assets": "a1"},
    "contract": {"control_hz": 20},
}
COMMANDS = [resumed_as_stated, merged_as_stated, compared, reported]
# Changes of an environment that `--resume` rejects: the change, and its name in the message.
OF_THE_ENV: dict[str, tuple[Callable[[], Any], str]] = {
    "its code": (lambda: edit("prog_parts/sea.py"), "prog_parts/sea.py was"),
    "a file of its settings": (lambda: edit("chart.txt"), "chart.txt was"),
    "its simulator's version": (
        lambda: {"description": {"mujoco": "2.3.7", "assets": "a1"}},
        "its description 'mujoco' was '3.3.0', is '2.3.7'",
    ),
    "a part of its description that is gone": (
        lambda: {"description": {"mujoco": "3.3.0"}},
        "its description 'assets' was 'a1', is None",
    ),
    "its contract": (
        lambda: {"contract": {"control_hz": 10}},
        "its contract 'control_hz' was 20, is 10",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("identity", OF_THE_ENV)
def test_every_command_refuses_another_environment_unless_the_change_is_accepted(
    work: Path, tmp_path: Path, command: Callable[..., Results], identity: str
) -> None:
    change, told = OF_THE_ENV[identity]
    with pytest.raises(ConfigError, match=rf"(?s){re.escape(told)}.*--accept-changes"):
        command(tmp_path / "refused", change)
    found = command(tmp_path / "accepted", change, accept_changes=True)
    assert any(told.partition(" was")[0] in str(one) for one in found.accepted_changes)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("name", sorted(software()))
def test_every_command_refuses_other_software_unless_the_change_is_accepted(
    work: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: Callable[..., Results],
    name: str,
) -> None:
    def change() -> None:
        monkeypatch.setattr(cases, "software", lambda: {**software(), name: "version 0"})

    told = f"software: {name.removeprefix(SOFTWARE)} was "
    with pytest.raises(
        ConfigError, match=rf"(?s){re.escape(told)}.*is version 0.*--accept-changes"
    ):
        command(tmp_path / "refused", change)
    monkeypatch.undo()
    monkeypatch.syspath_prepend(str(work))
    monkeypatch.chdir(work)
    found = command(tmp_path / "accepted", change, accept_changes=True)
    changes = [str(one) for one in found.accepted_changes if not one.is_of_plan]
    assert [one.startswith(told) for one in changes] == [True]


def test_summary_and_page_show_the_versions_of_all_runs(work: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for number, version in enumerate(("0.0.8", "0.0.9", "0.0.9"), 1):
        versions = {"vlagents-ray": version}
        played(out, episodes=number, versions=versions, resume=number > 1)
    assert summarize(Results.load(out)).to_json()["versions"] == [
        {"runs": [1], "vlagents-ray": "0.0.8"},
        {"runs": [2, 3], "vlagents-ray": "0.0.9"},
    ]
    page = write_report(Results.load(out), tmp_path / "page.html").read_text()
    assert "Run 1<" in page
    assert "Run 2, 3<" in page
    assert "0.0.8" in page


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_refuses_the_same_environment(
    work: Path, tmp_path: Path, command: Callable[..., Results]
) -> None:
    assert all(change.is_of_plan for change in command(tmp_path, lambda: None).accepted_changes)


# Policy settings in a deployment file that no plan contains: before, after, and the name of the
# change.
OF_THE_POLICY: dict[str, tuple[dict[str, Any], dict[str, Any], str]] = {
    "a setting": (
        {"config": {"steps": 4}},
        {"config": {"steps": 8}},
        "its setting 'steps' was 4, is 8",
    ),
    "a setting more": (
        {"config": {}},
        {"config": {"steps": 8}},
        "its setting 'steps' was None, is 8",
    ),
    "a wrapper": ({"wrappers": []}, {"wrappers": ["arro"]}, 'its wrappers was [], is ["arro"]'),
    "a wrapper's setting": (
        {"wrappers": [{"half": {"scale": 0.5}}]},
        {"wrappers": [{"half": {"scale": 0.9}}]},
        'its wrappers was [{"half":{"scale":0.5}}], is [{"half":{"scale":0.9}}]',
    ),
    "the order of wrappers": (
        {"wrappers": ["a", "b"]},
        {"wrappers": ["b", "a"]},
        "its wrappers was",
    ),
}


@pytest.mark.parametrize("identity", OF_THE_POLICY)
def test_other_settings_of_a_policy_in_its_file_are_refused_unless_they_are_accepted(
    work: Path, tmp_path: Path, identity: str
) -> None:
    before, after, message = OF_THE_POLICY[identity]

    def folders(name: str) -> list[Path]:
        return [tmp_path / name / folder for folder in ("a", "b", "c")]

    first, second, merged_into = folders("merged")
    played(first, stated=before)
    played(second, stated=after, seed=100)
    with pytest.raises(ConfigError, match=rf"(?s){re.escape(message)}.*--accept-changes"):
        merge(merged_into, [first, second])
    with pytest.raises(ConfigError, match=rf"(?s){re.escape(message)}.*--accept-changes"):
        played(first, stated=after, episodes=4, resume=True)
    played(first, stated=after, episodes=4, resume=True, accept_changes=True)
    assert any(
        message.partition(" was")[0] in str(change)
        for change in Results.load(first).accepted_changes
    )
    played(tmp_path / "other", policy="another")
    both = combined([Results.load(first), Results.load(tmp_path / "other")])
    with pytest.raises(
        ConfigError,
        match=r"(?s)with the same files, got .*settings of 'own'.*as --accept-changes allowed",
    ):
        compare(both, "own", "another")


def test_settings_of_the_checkpoint_and_of_the_machine_are_no_change(
    work: Path, tmp_path: Path
) -> None:
    """Checkpoints are compared separately, and a server without these fields declares nothing."""
    played(tmp_path, stated={"config": {"checkpoint": "a/1", "steps": 4}})
    played(
        tmp_path, stated={"config": {"checkpoint": "w.npz", "steps": 4}}, episodes=3, resume=True
    )
    played(tmp_path, episodes=4, resume=True)
    assert all(change.is_of_plan for change in Results.load(tmp_path).accepted_changes)


@pytest.mark.parametrize(
    "identity", ["its simulator's version", "its contract", "its policy's code", "its weights"]
)
def test_a_case_in_which_a_change_was_accepted_is_not_compared_unless_that_is_accepted_again(
    work: Path, tmp_path: Path, identity: str
) -> None:
    of_the_policy = {
        "its policy's code": lambda: edit("prog_helm.py"),
        "its weights": lambda: {"own_weights": "x"},
    }
    change = of_the_policy[identity] if identity in of_the_policy else OF_THE_ENV[identity][0]
    resumed_as_stated(tmp_path, change, accept_changes=True)
    changed_again: dict[str, Any] = {} if identity in of_the_policy else change()
    played(tmp_path / "other", **{**STATED, **changed_again, "policy": "another"})
    both = combined([Results.load(tmp_path / name) for name in ("out", "other")])
    with pytest.raises(
        ConfigError, match=r"(?s)with the same files, got .*as --accept-changes allowed"
    ):
        compare(both, "own", "another")
    assert compare(both, "own", "another", accept_changes=True).total.pairs.total == 2


@pytest.mark.parametrize("change", [lambda: edit("prog_helm.py"), lambda: {"own_weights": "mine"}])
def test_a_report_of_two_folders_keeps_a_policy_apart_that_is_not_the_same_in_both(
    work: Path, tmp_path: Path, change: Callable[[], Any]
) -> None:
    played(tmp_path / "a")
    again: dict[str, Any] = change() or {}
    played(tmp_path / "b", envs=["eval_fakes:Line"], env_options={}, **again)
    results = combined([Results.load(tmp_path / name) for name in ("a", "b")])
    assert results.policy_ids == ["own (a)", "own (b)"]


@pytest.mark.slow
@pytest.mark.parametrize("form", ["a class", "a partial", "a mapping", "a mapping of partials"])
def test_the_code_of_an_own_policy_is_part_of_the_program_however_it_is_given(
    work: Path, tmp_path: Path, form: str
) -> None:
    Path("prog_own.py").write_text("from eval_fakes import ToZero\nclass Own(ToZero):\n    pass\n")

    def run(episodes: int, **options: Any) -> None:
        make: Any = importlib.import_module("prog_own").Own
        if "partial" in form:
            make = functools.partial(make, chunk=1)
        config = flat_config(
            envs=["eval_fakes:Line"],
            policy="own",
            episodes=episodes,
            out=tmp_path / "out",
            workers=0,
            video="none",
            **options,
        )
        evaluate(config, agent_factory={"own": make} if "mapping" in form else make)

    run(1)
    run(2, resume=True)
    edit("prog_own.py")
    with pytest.raises(ConfigError, match=r"policy own: .*prog_own.py was sha256"):
        run(3, resume=True)


def test_a_case_of_two_programs_is_not_compared(work: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    both = {"policies": [{"name": "a"}, {"name": "b"}]}
    settings = {"suites": [{"envs": ["prog_env:Sea"], "episodes": 2}], "out": out, **both}
    for resume in (False, True):
        config = EvalConfig.model_validate({**settings, "resume": resume, "accept_changes": resume})
        with Store(resolve(config)) as store:
            store.begin_run({})
            for job in plan_jobs(store.cases):
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
def test_the_module_that_registers_an_env_of_gymnasium_is_part_of_the_program(
    work: Path, env: str
) -> None:
    config = flat_config(envs=[env], episodes=1, policy="own", out=work / "out")
    assert {name for case in plan_cases(config) for name in case.program} >= ENV_FILES - {
        "chart.txt"
    }


def test_a_checkpoint_is_found_at_its_step_and_the_working_folder_is_none(work: Path) -> None:
    Path("7").mkdir()
    Path("7/w.bin").write_text("7")
    assert set(files_named({"checkpoint": "{step}", "checkpoint_step": 7})) == {
        "checkpoint: 7/w.bin"
    }
    assert files_named({"checkpoint": "{step}", "checkpoint_step": 7}, folders=False) == {}
    assert files_named({"a": ".", "b": "no such file", "c": 3, "d": {"e": ["", "\0"]}}) == {}
