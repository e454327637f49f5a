"""The settings that result from the options of `eval`, and the output of `--dry-run`."""

from __future__ import annotations

import contextlib
import inspect
import logging
import socket
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import pytest
from eval_fakes import LINE, OTHER_LINE, ToZero
from in_process_evaluation import flat_config, play
from typer.testing import CliRunner

from vlagents_ray import registry
from vlagents_ray.cli import evaluate as command
from vlagents_ray.cli import evaluation as run
from vlagents_ray.cli import policies
from vlagents_ray.cli.evaluation import forecasts, live_address, print_plan
from vlagents_ray.cli.main import app
from vlagents_ray.cli.policies import Served
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.evaluate import (
    EvalConfig,
    OutOfTime,
    PolicyConfig,
    Results,
    SuiteConfig,
    WorkerConfig,
)
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan import cases
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.jobs import plan_jobs
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan, require_installed, resolve
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.results.summary import summarize
from vlagents_ray.policies.noop import Noop
from vlagents_ray.registry import CORE, pip_install

WORDS = ["eval", "tabletop", "--policy", "http://127.0.0.1:9"]


def said(*words: str) -> str:
    """Return the output of a command that is rejected before anything starts."""
    done = CliRunner().invoke(app, words, env={"COLUMNS": "200"})
    assert done.exit_code == 2, done.output
    return " ".join(done.stderr.split())


@pytest.fixture
def no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "vlagents_ray.serve.launch.server.running_server",
        lambda *_, **__: pytest.fail("the command started a server"),
    )


def test_a_zero_is_a_number_of_retries_steps_and_seconds(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(
        run, "run_evaluation", lambda config, _address, **_: seen.append(config.retries)
    )
    monkeypatch.setattr(run, "watch_training", lambda *_args, **options: seen.append(options))
    for options in (
        ["--retries", "0"],
        ["--watch", str(tmp_path), "--settle-s", "0", "--until", "0"],
    ):
        done = CliRunner().invoke(app, [*WORDS, "--out", str(tmp_path / "out"), *options])
        assert done.exit_code == 0, done.output
    assert seen == [0, {"settle_s": 0.0, "until": 0, "marker": None, "live": None}]


def test_workers_take_the_resources_that_are_said_unless_the_file_says_more(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[EvalConfig] = []
    monkeypatch.setattr(run, "run_evaluation", lambda config, _address, **_: seen.append(config))
    file = tmp_path / "runs.yaml"
    suites = "{envs: [tabletop]}, {name: b, envs: [tabletop], worker: {threads: 2}}"
    more = "{name: c, envs: [tabletop], worker: {cpus: 3}}"
    file.write_text(f"policies: [{{url: 'http://127.0.0.1:9'}}]\nsuites: [{suites}, {more}]\n")
    done = CliRunner().invoke(
        app, ["eval", str(file), "--worker-cpus", "1", "--worker-gpus", "0.25"]
    )
    assert done.exit_code == 0, done.output
    [config] = seen
    kinds = [suite.worker or config.worker for suite in config.suites]
    assert [(worker.cpus, worker.gpus) for worker in kinds] == [
        (1.0, 0.25),
        (1.0, 0.25),
        (3.0, 0.25),
    ]


def test_out_of_time_has_an_exit_status_of_its_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    ends: list[float] = []

    def evaluate(_plan: ResolvedPlan, *, end_at: float, **_: Any) -> NoReturn:
        ends.append(end_at)
        raise OutOfTime(SimpleNamespace(total=SimpleNamespace(episodes=3, planned=9), out=tmp_path))  # type: ignore[arg-type]

    monkeypatch.setattr(run, "evaluate_plan", evaluate)
    monkeypatch.setattr(run, "print_summary", lambda *_: None)
    monkeypatch.setattr(
        run, "served", lambda config, *_, **__: contextlib.nullcontext(Served(resolve(config)))
    )
    words = [*WORDS, "--out", str(tmp_path / "out"), "--end-at", "2027-01-31T18:30+00:00"]
    done = CliRunner().invoke(app, words, env={"COLUMNS": "200"})
    assert done.exit_code == 75, done.output
    assert ends == [1_801_420_200.0]
    assert "out of time after 3 of 9 episodes; continue with --resume" in " ".join(
        done.stderr.split()
    )


@pytest.mark.usefixtures("no_server")
def test_a_policy_that_does_not_fit_is_refused_before_anything_starts(tmp_path: Path) -> None:
    words = ["eval", "libero/libero_spatial/0", "--policy", "noop", "--set", "action_dim=4"]
    done = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "out")], env={"COLUMNS": "200"})
    assert done.exit_code == 1, done.output
    fits_not = (
        "'noop' in 'libero/libero_spatial/0': policy and env do not fit: - action.dim: the "
        "policy returns 4, the"
    )
    assert fits_not in " ".join(done.stderr.split())
    assert not (tmp_path / "out").exists()


def test_a_file_of_several_policies_is_refused_with_its_cure(tmp_path: Path) -> None:
    app_of = (
        "{{name: {0}, route_prefix: /{0}, import_path: 'vlagents_ray.serve.app:build', args: "
        "{{policy: noop}}}}"
    )
    file = tmp_path / "two.yaml"
    file.write_text(f"applications: [{app_of.format('a')}, {app_of.format('b')}]")
    assert "expected one application" in said(
        "eval", "tabletop", "--policy", str(file), "--out", str(tmp_path / "out")
    )


def lost(out: Path, **changes: Any) -> EvalConfig:
    """Record all episodes of two cases except one, which is lost for an infrastructure error."""
    of_a = [{"name": "a", "url": "http://127.0.0.1:9"}]
    suites = [{"envs": ["tabletop"], "episodes": 4}]
    config = EvalConfig.model_validate({"policies": of_a, "suites": suites, "out": out, **changes})
    with Store(resolve(config)) as store:
        store.begin_run({})
        first, *others = plan_jobs(store.cases)
        failure = Failure(
            "worker", "env_failed", "env step: RuntimeError: it exploded\nand more", ""
        )
        store.record_attempt(first, failure, retried=False)
        store.record(EpisodeResult(first.key, "infra_failed", error="env_failed: it exploded"), 4)
        for job in others:
            store.record(EpisodeResult(job.key, "done", True, True, 3), 1)
        store.end_run("complete")
    return config


def end_of(config: EvalConfig, monkeypatch: pytest.MonkeyPatch) -> tuple[int, str]:
    """Return the exit status of `eval` and the end of its output, after an evaluation with these
    results.
    """
    summary = summarize(Results.load(config.out))
    monkeypatch.setattr(run, "evaluate_plan", lambda *_args, **_options: summary)
    monkeypatch.setattr(command, "config_from_options", lambda *_: config)
    monkeypatch.setattr(
        run, "served", lambda config, *_, **__: contextlib.nullcontext(Served(resolve(config)))
    )
    done = CliRunner().invoke(app, [*WORDS, "--out", str(config.out)], env={"COLUMNS": "200"})
    assert "Traceback" not in done.output
    return done.exit_code, " ".join(done.stderr.split())


def test_an_episode_without_a_result_ends_the_command_with_status_1(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    status, stated = end_of(lost(tmp_path), monkeypatch)
    assert status == 1
    assert stated == (
        "Error: 1 of 4 episodes have no result: lost to infrastructure, the last one to env_failed: "
        "env step: RuntimeError: it exploded; the report lists every attempt under Errors, "
        "--resume tries them again"
    )


def test_a_case_that_stopped_early_misses_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config = lost(tmp_path, stop={"target": 0.01, "at_least": 1})
    with Store(resolve(config.model_copy(update={"resume": True}))) as store:
        store.record(EpisodeResult(plan_jobs(store.cases)[0].key, "done", True, True, 3), 1)
    [case] = Results.load(tmp_path).cases
    assert case.stopped_at is not None
    with closing(sqlite3.connect(tmp_path / "results.db")) as db, db:
        db.execute("DELETE FROM episodes WHERE episode >= ?", (case.stopped_at,))
    assert end_of(config, monkeypatch) == (0, "")


def test_only_what_was_asked_for_now_is_missed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config = lost(tmp_path)
    suite = SuiteConfig(envs=["tabletop"], name="b", seeds=[9])
    other = config.model_copy(update={"resume": True, "accept_changes": True, "suites": [suite]})
    with Store(resolve(other)) as store:
        store.begin_run({})
        for job in plan_jobs(store.cases):
            store.record(EpisodeResult(job.key, "done", True, True, 3), 1)
    assert end_of(other, monkeypatch) == (0, "")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--end-at", "soon"], "2027-01-31T18:30"),
        (["--end-at", "1", "--watch", "."], "exclude each other"),
        (["--replica-per-gpu", "--policy", "http://127.0.0.1:9"], "--address"),
        (["--live-at", "8050"], "expected HOST:PORT"),
        (["--live-at", "127.0.0.1:many"], "expected HOST:PORT"),
        (["--live-at", "0.0.0.0:8050"], "without keys all cameras would be public"),
        (["--live", "--dry-run"], "a dry run has no episodes to watch"),
    ],
)
@pytest.mark.usefixtures("no_server")
def test_options_that_cannot_hold_are_refused_before_anything_starts(
    words: list[str], text: str, tmp_path: Path
) -> None:
    assert text in said(
        "eval", "tabletop", "--policy", "scripted", "--out", str(tmp_path / "out"), *words
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [["--live"], ["--live-at", "127.0.0.1:8050"]])
@pytest.mark.usefixtures("no_server")
def test_a_page_whose_plugin_is_not_installed_is_named_before_anything_starts(
    monkeypatch: pytest.MonkeyPatch, words: list[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(registry, "_is_installed", lambda entry: entry.distribution == CORE)
    message = said(
        "eval", "tabletop", "--policy", "scripted", "--out", str(tmp_path / "out"), *words
    )
    assert "page of evaluations is in vlagents-ray-live, which is not installed" in message
    assert pip_install(distribution="vlagents-ray-live") in message
    assert not (tmp_path / "out").exists()


def test_each_option_that_is_a_setting_is_one_of_a_single_model() -> None:
    models = (EvalConfig, PolicyConfig, SuiteConfig, WorkerConfig)
    places = {
        option: [model.__name__ for model in models if option in model.model_fields]
        for option in inspect.signature(command.evaluate_command).parameters
    }
    of_the_run_itself = {
        "targets",
        "config_dir",
        "watch",
        "until",
        "settle_s",
        "marker",
        "dry_run",
        "end_at",
        "replica_per_gpu",
        "address",
        "live",
        "live_at",
        "arm",
        "operator",
        "unblind",
    }
    assert {option for option, found in places.items() if len(found) != 1} == of_the_run_itself
    assert all(not places[option] for option in of_the_run_itself)


def test_a_dry_run_keeps_warnings_of_what_is_meant_off_the_terminal(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    warnings = ("Token authentication is enabled for this Ray cluster", "the disk is almost full")

    def measure(_config: EvalConfig, _address: str | None) -> None:
        for line in warnings:
            logging.getLogger("ray._private.worker").warning(line)

    monkeypatch.setattr(run, "print_plan", measure)
    done = CliRunner().invoke(app, [*WORDS, "--out", str(tmp_path / "out"), "--dry-run"])
    assert done.exit_code == 0, done.output
    assert [
        record.getMessage() for record in caplog.records if record.getMessage() in warnings
    ] == [warnings[1]]


def test_a_page_has_a_port_of_its_own_if_another_has_the_usual_one() -> None:
    assert live_address("[::1]:9000") == ("::1", 9000)
    with closing(socket.socket()) as taken:
        with contextlib.suppress(OSError):  # the port may already be in use
            taken.bind(("127.0.0.1", 8050))
        assert live_address(None) == ("127.0.0.1", 0)


@pytest.fixture
def config(tmp_path: Path) -> Callable[..., EvalConfig]:
    def make(**changes: Any) -> EvalConfig:
        return flat_config(**{"envs": [LINE], "out": tmp_path / "out", **changes})

    return make


def test_what_was_played_is_not_planned_again_and_tells_the_time(
    config: Callable[..., EvalConfig],
) -> None:
    results = play(config(episodes=3))
    [played, other] = forecasts(plan_cases(config(envs=[LINE, OTHER_LINE], episodes=9)), results)
    assert (played.finished, played.remaining) == (3, 6)
    assert played.seconds == pytest.approx(sum(one.seconds for one in results.cases[0].counted) / 3)
    assert (other.finished, other.remaining, other.seconds) == (0, 9, None)


def test_nothing_is_left_of_a_case_that_stopped(config: Callable[..., EvalConfig]) -> None:
    settings = config(episodes=30, stop={"target": 0.3})
    play(settings, left_out=range(20, 30))
    [found] = forecasts(plan_cases(settings), Results.load(settings.out))
    assert (found.finished, found.remaining) == (20, 0)


class Swept(ToZero):
    """A policy with checkpoints."""

    def __init__(self, checkpoint_step: int = 0) -> None:
        super().__init__()


def test_the_plan_is_printed_without_asking_any_policy(
    config: Callable[..., EvalConfig],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "150")
    settings = config(episodes=5, envs=[LINE, OTHER_LINE])
    policies = [PolicyConfig(name="policy", source=f"{__name__}:Swept", steps=[10, 20])]
    settings = settings.model_copy(update={"policies": policies})
    print_plan(settings)
    text = capsys.readouterr().out
    assert "4 cases" in text
    assert "20 episodes: 0 finished" in text
    assert "policy@20" in text
    assert ": unknown" in text
    assert "(no earlier episodes of 4 of 4 cases)" in " ".join(text.split())
    assert not settings.out.exists(), "nothing must be written"


def test_a_time_that_leaves_out_some_cases_is_a_lower_bound(
    config: Callable[..., EvalConfig],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "150")
    url = "http://127.0.0.1:9"
    play(config(episodes=3, policy_url=url))
    print_plan(config(envs=[LINE, OTHER_LINE], episodes=9, policy_url=url, resume=True))
    assert ": at least 0:00:0" in " ".join(capsys.readouterr().out.split())


REFUSED = {
    "no --resume": {"resume": False},
    "fewer episodes": {"episodes": 2},
    "other settings": {"execute": 2},
    "another rule of early stopping": {"stop": {"target": 0.5}},
    "other seeds": {"seed": 100},
    "changed code": {},
}


@pytest.mark.parametrize("change", REFUSED)
def test_a_dry_run_refuses_what_the_run_refuses_and_writes_nothing(
    config: Callable[..., EvalConfig], monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    url = "http://127.0.0.1:9"
    out = play(config(episodes=3, policy_url=url)).out
    if change == "changed code":
        monkeypatch.setattr(cases, "software", lambda: {"software: numpy": "version 0"})
    planned = config(**{"episodes": 3, "policy_url": url, "resume": True, **REFUSED[change]})
    before = (out / "results.db").read_bytes()
    with pytest.raises(ConfigError) as of_dry_run:
        print_plan(planned)
    assert (out / "results.db").read_bytes() == before
    with pytest.raises(ConfigError) as of_run:
        play(planned)
    assert str(of_dry_run.value) == str(of_run.value)


class NeedsPackage(Tabletop):
    """A simulator whose package is not installed in this Python."""

    @classmethod
    def not_installed(cls) -> str | None:
        return "physics is not installed; run `vlagents-ray venv create physics`"


NEEDS_PACKAGE = f"{__name__}:NeedsPackage"


@pytest.mark.parametrize("workers", ["0", "1"])
def test_a_simulator_that_is_not_installed_is_an_error_before_ray_and_the_policy_start(
    workers: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """On a loaded machine, Ray and the policy took two minutes to start for this error."""
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    started = []
    monkeypatch.setattr(policies, "_enter_ray", lambda *_: started.append("ray"))
    monkeypatch.setattr(Noop, "initialize", lambda *_: started.append("policy"))
    options = ["--policy", "noop", "--set", "action_dim=4", "--workers", workers]
    words = ["eval", NEEDS_PACKAGE, *options, "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, words, env={"COLUMNS": "200"})
    assert done.exit_code == 1
    assert "physics is not installed; run `vlagents-ray venv create physics`" in done.output
    assert started == []


@pytest.mark.parametrize(
    ("runtime_env", "is_checked"),
    [
        ({}, True),
        ({"env_vars": {"MUJOCO_GL": "egl"}}, True),
        ({"py_executable": "/envs/physics/bin/python"}, False),
        ({"env_vars": {"PYTHONPATH": "/physics"}}, False),
    ],
)
def test_simulators_of_workers_with_other_packages_are_not_looked_for_here(
    runtime_env: dict[str, Any], tmp_path: Path, *, is_checked: bool
) -> None:
    config = EvalConfig(
        policies=[PolicyConfig(source="noop")],
        suites=[SuiteConfig(envs=[NEEDS_PACKAGE], worker=WorkerConfig(runtime_env=runtime_env))],
        out=tmp_path,
    )
    expected = pytest.raises(MissingDependency, match="venv create physics")
    with expected if is_checked else contextlib.nullcontext():
        require_installed(plan_cases(config))


def test_a_cluster_may_have_the_simulator_that_this_machine_lacks(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class ReachedRayError(Exception):
        pass

    def enter_ray(*_: object) -> NoReturn:
        raise ReachedRayError

    monkeypatch.setattr(policies, "_enter_ray", enter_ray)
    config = EvalConfig(
        policies=[PolicyConfig(source="noop")],
        suites=[SuiteConfig(envs=[NEEDS_PACKAGE])],
        out=tmp_path,
        workers=1,
    )
    with pytest.raises(ReachedRayError), policies.served(config, "ray://head:10001"):
        pass
    monkeypatch.setenv("RAY_ADDRESS", "head:6379")
    with pytest.raises(ReachedRayError), policies.served(config):
        pass
