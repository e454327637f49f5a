"""A policy in a child process behind an engine behaves like a policy in the engine's process."""

from __future__ import annotations

import inspect
import os
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import psutil
import pytest
from eval_fakes import wait_for
from gain_policies import gains, in_child
from in_flight import asked, checked, submit
from in_process_replicas import export
from pushed_weights import push
from python_env_agents import Dances, value_of
from shared_cpu_memory import GPU, SharedCpuMemory
from virtual_environments import ended

from vlagents_ray import Act, Obs, abilities
from vlagents_ray.abilities import (
    BeginsWithPlan,
    ContinuesPlans,
    HasWeightsId,
    InProcess,
    Observes,
    Prepares,
    ability,
    is_marked,
    members,
    observation_arguments,
)
from vlagents_ray.errors import (
    ConnectionLost,
    DeadlineExceeded,
    NotReset,
    NotTrainable,
    PolicyFailed,
    PolicyUnavailable,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.policies.base.program import SOFTWARE, software
from vlagents_ray.policies.compilation import CudaGraph
from vlagents_ray.policies.loading import loading_report
from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.engine.ability_call import is_method, name_of
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.local_agent import policy_metadata
from vlagents_ray.serve.models import served_model
from vlagents_ray.serve.models.loaded_model import PolicySource
from vlagents_ray.serve.python_env.child_agent import ChildAgent
from vlagents_ray.serve.python_env.child_connection import ChildConnection
from vlagents_ray.serve.python_env.child_main import Settings
from vlagents_ray.serve.python_env.child_process import ChildProgram
from vlagents_ray.serve.queue.call_limits import FAILED_BATCHES, CallLimits
from vlagents_ray.serve.requests import ReservedAct
from vlagents_ray.serve.weights import PushOptions
from vlagents_ray.weights import shared_values
from vlagents_ray.weights.shared_values import NotShared, shared

SUPPORT = Path(__file__).parents[2] / "support"
ROOT = Path(__file__).parents[3]


def agent(policy: str = "Telling", **config: Any) -> ChildAgent:
    settings = Settings(f"python_env_agents:{policy}", config, 16, "1")
    return ChildAgent(
        ChildProgram(
            sys.executable, settings, {"PYTHONPATH": f"{SUPPORT}:{ROOT}", "VARIABLE": "set"}
        )
    )


@pytest.fixture(scope="module")
def engine() -> Iterator[Engine]:
    engine = Engine(agent(), EngineSettings(session_limit=100))
    engine.start()
    yield engine
    engine.close()


@pytest.fixture(scope="module")
def other(engine: Engine) -> Iterator[Engine]:
    """Yield another replica of the same policy."""
    other = Engine(agent())
    other.start()
    yield other
    other.close()


def observation(value: float = 0.0, **info: Any) -> Obs:
    return Obs({"front": np.full((8, 8, 3), 7, np.uint8)}, info={"value": value, **info})


def ask(engine: Engine, session: str, op: Any, value: float = 0.0, **fields: Any) -> Reply:
    [reply] = ask_all(engine, [(session, Request(op, observation(value), **fields))])
    return reply


def ask_all(engine: Engine, requests: list[tuple[str, Request]]) -> list[Reply]:
    """Return the replies to requests that are queued at the same time."""
    replies: list[Reply] = []
    over = threading.Event()

    def done(reply: Reply) -> None:
        replies.append(reply)
        if len(replies) == len(requests):
            over.set()

    engine.queue.put(*[checked(engine, session, request, done) for session, request in requests])
    assert over.wait(30)
    return replies


def test_what_was_loaded_there_is_known_here(engine: Engine) -> None:
    told = engine.model.weights
    assert told["digest"]
    assert (ask(engine, "weights", "reset").info or {})["weights"] == told["digest"]
    assert engine.contract.action.dim == 1


def info(reply: Reply) -> dict[str, Any]:
    if reply.error is not None:
        raise reply.error
    found = reply.act.info if reply.act is not None else reply.info
    assert found is not None
    return found


def test_the_software_of_the_policy_is_that_of_its_process(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = {f"{SOFTWARE}python": "version 3.10.1", f"{SOFTWARE}torch": "version 9.0"}
    assert engine.model.software_elsewhere() == software()  # the same interpreter
    policy = replace(engine.model.loaded.agent.child.policy, software=there)
    monkeypatch.setattr(engine.model.loaded.agent.child, "policy", policy)
    here = {
        f"{SOFTWARE}python": "version 3.12.1",
        f"{SOFTWARE}ray": "version 2",
        "a.py": "sha256:1",
    }
    metadata = policy_metadata(ServerArgs(policy="noop"), engine, None, here)
    programs = {name: metadata["program"][name] for name in (*there, "a.py")}
    assert programs == {**there, "a.py": "sha256:1"}
    assert f"{SOFTWARE}ray" not in metadata["program"]


def test_the_steps_of_a_long_start_there_are_reported_here() -> None:
    one, steps = agent("Compiling"), list[str]()
    try:
        with loading_report(steps.append) as report:
            one.initialize()
        one.reset(observation(), "a task")
        assert isinstance(one.act(observation()), Act), "the same result as `Agent` itself"
    finally:
        one.close()
    assert steps == ["compiling 1 rows (1 of 2)", "compiling 2 rows (2 of 2)"]
    assert report.uncompiled == ["2 rows"]
    assert report.devices == [{"kind": "cuda", "name": "a GPU"}]


def test_the_policy_runs_in_another_process_with_its_variables_and_this_ones_devices(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    one = Engine(agent())
    one.start()
    told = info(ask(one, "a", "reset", instruction="a task"))
    assert (told["parent"], told["variable"], told["gpus"]) == (os.getpid(), "set", "3")
    one.close()
    assert ended(told["pid"])


def test_one_that_hangs_is_noticed_and_keeps_nobody_waiting() -> None:
    one = Engine(agent(), EngineSettings(limits=CallLimits(act_s=0.2, warm_up_s=0.2)))
    one.start()
    pid = info(ask(one, "a", "reset"))["pid"]
    assert one.health.ready
    os.kill(pid, signal.SIGSTOP)
    # Otherwise the child may answer once more.
    wait_for(lambda: psutil.Process(pid).status() == psutil.STATUS_STOPPED, 30)
    replies: list[Reply] = []
    submit(one, "a", Request("act", observation()), replies.append)
    wait_for(lambda: not one.health.ready, 30)
    one.notice_hung()
    assert isinstance(replies[0].error, DeadlineExceeded)
    os.kill(pid, signal.SIGKILL)
    one.close()


def test_a_batch_stays_a_batch_and_sessions_stay_apart(engine: Engine) -> None:
    names = [f"session {i}" for i in range(7)]
    for i, name in enumerate(names):
        assert (
            info(ask(engine, name, "reset", i, instruction=f"task {i}"))["instruction"]
            == f"task {i}"
        )
    for step in (1, 2, 3):
        replies = ask_all(
            engine,
            [(name, Request("act", observation(10 * step + i))) for i, name in enumerate(names)],
        )
        for i, told in enumerate(map(info, replies)):
            assert (told["batch"], told["acts"], told["instruction"]) == (7, step, f"task {i}")
            assert told["seen"] == [i, *(10 * s + i for s in range(1, step + 1))]


def test_a_session_that_begins_again_is_shown_its_history(engine: Engine) -> None:
    history = [observation(1), observation(2)]
    ask(engine, "again", "reset", instruction="a task", history=history)
    assert info(ask(engine, "again", "act", 3))["seen"] == [0, 1, 2, 3]


def test_a_policys_error_is_its_sessions_alone_and_its_text_stays_in_the_log(
    engine: Engine, capfd: pytest.CaptureFixture[str]
) -> None:
    ask(engine, "good", "reset", instruction="a task")
    error = ask(engine, "bad", "reset", instruction="fail").error
    assert isinstance(error, PolicyFailed)
    assert "RuntimeError" in str(error)
    assert "/no/path" not in str(error)
    assert isinstance(ask(engine, "bad", "act").error, NotReset)
    assert info(ask(engine, "good", "act"))["acts"] == 1
    wait_for(lambda: "/no/path/of/ours" in capfd.readouterr().err, 10)


@pytest.mark.slow
def test_what_the_replica_drops_the_child_forgets() -> None:
    child = agent()
    one = Engine(child)
    one.start()
    held = child.child.sessions
    for i in range(50):
        told = info(ask(one, f"short {i}", "reset", instruction="a task"))
    assert (told["alive"], len(held)) == (50, 50)
    for i in range(50):
        one.sessions.close(f"short {i}")
    wait_for(lambda: not held, 10)
    assert info(ask(one, "short", "reset", instruction="a task"))["alive"] == 1
    for _ in range(30):
        ask(one, "short", "reset", instruction="a task")
    wait_for(lambda: len(held) == 1, 10)
    one.close()


@pytest.fixture
def preparing() -> Iterator[Engine]:
    """Yield an engine with slow batches whose policy prepares observations in a child process; its
    sessions "a" to "d" have acted.
    """
    engine = Engine(agent("Preparing"), EngineSettings(max_batch_size=2))
    engine.start()
    for name in "abcd":
        assert ask(engine, name, "reset").error is None
    for _ in range(4):
        ask_all(engine, [(name, Request("act", observation())) for name in "abcd"])
    assert engine.queue.window.overlaps
    yield engine
    engine.close()


def while_acting(
    engine: Engine, requests: list[tuple[str, Request]]
) -> list[queue.SimpleQueue[Reply]]:
    """Queue requests during a long batch of another session, and return the queues of their
    replies.
    """
    first = asked(engine, "a", Request("act", observation(batch_s=0.5)))
    wait_for(lambda: engine.queue.depth() == 0)
    later = [asked(engine, name, request) for name, request in requests]
    assert first.get(timeout=30).error is None
    return later


@pytest.mark.slow
def test_the_child_prepares_observations_while_the_batch_before_runs(preparing: Engine) -> None:
    requests = [("b", Request("act", observation(2.0))), ("c", Request("act", observation(3.0)))]
    told = [info(reply.get(timeout=30)) for reply in while_acting(preparing, requests)]
    assert [(one["value"], one["prepared"], one["pixel"]) for one in told] == [
        (2.0, 2.0, 7),
        (3.0, 3.0, 7),
    ]
    assert min(one["ahead_s"] for one in told) > 0.1


@pytest.mark.slow
def test_an_observation_that_cannot_be_prepared_there_fails_its_own_request(
    preparing: Engine,
) -> None:
    requests = [
        ("b", Request("act", observation(2.0, wrong=True))),
        ("c", Request("act", observation(3.0))),
    ]
    wrong, right = [reply.get(timeout=30) for reply in while_acting(preparing, requests)]
    assert isinstance(wrong.error, PolicyFailed)
    assert info(right)["prepared"] == 3.0


@pytest.mark.slow
def test_an_observation_that_no_batch_takes_leaves_nothing_in_the_child(preparing: Engine) -> None:
    first = asked(preparing, "a", Request("act", observation(batch_s=0.5)))
    wait_for(lambda: preparing.queue.depth() == 0)
    for number in range(20):
        request = Request("act", observation(float(number)))
        late = submit(preparing, "b", request, lambda _: None)
        reserved = late.reserved
        assert isinstance(reserved, ReservedAct)
        assert reserved.preparation is not None
        assert reserved.preparation.future.result(30) is not None
        preparing.intake.withdraw(late)
        del late, reserved, request
    assert first.get(timeout=30).error is None

    def alive() -> int:
        return int(info(ask(preparing, "d", "reset"))["alive"])

    wait_for(lambda: alive() == 0, 10)


def test_a_session_that_ends_takes_its_stored_observations_along(preparing: Engine) -> None:
    session = preparing.sessions.get("b").agent
    assert isinstance(session, ChildAgent)
    prepares, child = ability(session, Prepares), session.child
    assert prepares is not None
    stored = prepares.prepare(observation(5.0))
    assert stored is not None
    assert info(ask(preparing, "d", "reset"))["alive"] == 1
    child.call([Request("close", session=stored.session)])
    wait_for(lambda: info(ask(preparing, "d", "reset"))["alive"] == 0, 10)
    del stored  # the child no longer has this value; this is no error
    wait_for(child._dropped.empty)
    assert info(ask(preparing, "c", "act"))["value"] == 0.0


def test_a_row_with_the_observation_of_another_session_sends_it(preparing: Engine) -> None:
    sessions = [preparing.sessions.get(name).agent for name in "bc"]
    prepares = ability(sessions[0], Prepares)
    obs = observation(5.0)
    obs.prepared = prepares.prepare(obs)
    acts = sessions[0].act_batch([obs, obs], sessions)  # like a row that pads a batch
    assert [act.info["value"] for act in acts] == [5.0, 5.0]


@pytest.mark.slow
def test_an_observation_that_is_acted_on_again_is_sent_again(
    preparing: Engine, able: Engine
) -> None:
    session = preparing.sessions.get("b").agent
    prepares = ability(session, Prepares)
    obs = observation(5.0)
    obs.prepared = prepares.prepare(obs)
    acts = [session.act_batch([obs], [session])[0] for _ in range(2)]
    assert [act.info["value"] for act in acts] == [5.0, 5.0]

    obs.prepared = prepares.prepare(obs)
    assert ask(able, "other child", "reset").error is None
    other = able.sessions.get("other child").agent
    [act] = other.act_batch([obs], [other])
    assert isinstance(act, Act)


@pytest.mark.slow
def test_the_memory_of_the_childs_gpu_is_the_replicas(
    preparing: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert preparing.model.gpu_memory() == {}, "the child has no GPU"
    both = Engine(agent())
    both.start()
    try:
        held = {"allocated": 5, "reserved": 7, "free": 9}
        monkeypatch.setattr(ChildAgent, "gpu_memory", lambda _: held)
        assert both.model.gpu_memory() == held
        here = {"allocated": 1, "reserved": 2, "free": 3}
        monkeypatch.setattr(served_model, "gpu_memory", lambda _: here)
        assert both.model.gpu_memory() == {"allocated": 6, "reserved": 9, "free": 3}
    finally:
        both.close()


def test_what_the_child_does_on_its_gpu_is_in_the_metrics_of_the_replica(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # An earlier engine of this process has replayed graphs.
    monkeypatch.setattr(CudaGraph, "replays", 7)
    engine = Engine(agent("OnGpu"))
    engine.start()
    try:
        ask(engine, "a", "reset")
        for took_ms, info in ((3.5, {}), (4.5, {"full": True})):
            request = Request("act", observation(took_ms, **info))
            [reply] = ask_all(engine, [("a", request)])
            assert reply.error is None
        collected = engine.collect_stats()
        assert collected.gpu_ms.values == [3.5, 4.5]
        assert (collected.out_of_memory, collected.replays) == (1, 4)
        assert engine.stats.gpu_ms == 4.5, "the live page must show the latest value"
        assert engine.stats.replays == 4

        nothing_new = engine.collect_stats()
        assert nothing_new.gpu_ms.values == []
        assert (nothing_new.out_of_memory, nothing_new.replays) == (0, 0)
    finally:
        engine.close()


def test_a_child_that_has_ended_leaves_the_other_metrics_of_the_replica() -> None:
    engine = Engine(agent("OnGpu"))
    engine.start()
    child = engine.model.loaded.agent.child
    child.process._process.kill()
    wait_for(lambda: child.process._process.poll() is not None, 10)
    engine.stats.out_of_memory()
    assert engine.collect_stats().out_of_memory == 1
    engine.close()


@pytest.mark.slow
def test_a_swap_ends_the_child_and_starts_one_with_the_next_settings(tmp_path: Path) -> None:
    notes = {name: str(tmp_path / name) for name in ("first", "second")}
    policy = PolicySource(lambda config: agent(**config), {"notes": notes["first"]})
    engine = Engine(policy)
    engine.start()
    assert ask(engine, "a", "reset", instruction="a task").error is None
    process = engine.model.require_loaded().agent.child.process  # type: ignore[attr-defined]

    engine.swap({"notes": notes["second"]})
    assert process._process.poll() is not None, "the old child must have ended"
    assert not Path(notes["second"]).exists()
    with pytest.raises(UnknownSession):
        ask(engine, "a", "act")
    assert ask(engine, "a", "reset", instruction="a task").error is None
    assert Path(notes["second"]).exists()
    engine.close()


@pytest.mark.slow
def test_a_child_whose_batches_all_fail_is_replaced_as_a_replica_is() -> None:
    one = Engine(agent())
    one.start()
    ask(one, "a", "reset", instruction="a task")
    process = one.model.loaded.agent.child.process
    for _ in range(FAILED_BATCHES):
        [reply] = ask_all(one, [("a", Request("act", observation(fails=True)))])
        assert isinstance(reply.error, PolicyFailed)
    wait_for(lambda: process._process.poll() is not None, 10)
    assert not one.health.ready
    one.close()


def test_a_session_moves_between_replicas_with_all_its_state(engine: Engine, other: Engine) -> None:
    first = info(ask(engine, "moving", "reset", 1, instruction="a task"))
    ask(engine, "moving", "act", 2)
    state = export(engine, "moving")
    assert state is not None
    assert "moving" not in engine.sessions
    other.moves.adopt("moving", state)
    told = info(ask(other, "moving", "act", 3))
    assert (told["seen"], told["acts"], told["pid"] != first["pid"]) == ([1, 2, 3], 2, True)


@pytest.mark.slow
def test_a_session_that_cannot_move_stays(other: Engine) -> None:
    one = Engine(agent("Unpicklable"))
    one.start()
    ask(one, "staying", "reset", instruction="a task")
    assert export(one, "staying") is None
    assert info(ask(one, "staying", "act"))["acts"] == 1
    one.close()


@pytest.mark.slow
@pytest.mark.parametrize(("ends", "status"), [("is killed", "-9"), ("exits in an act", "7")])
def test_a_child_that_dies_loses_the_connection_and_makes_the_replica_unhealthy(
    ends: str, status: str
) -> None:
    one = Engine(agent())
    one.start()
    told = info(ask(one, "a", "reset", instruction="a task"))
    one.health.check()
    if ends == "is killed":
        os.kill(told["pid"], signal.SIGKILL)
    [reply] = ask_all(one, [("a", Request("act", observation(exit=ends != "is killed")))])
    assert isinstance(reply.error, ConnectionLost)
    assert (
        str(reply.error)
        == f"the policy's process ended with exit status {status}; the replica is being replaced"
    )
    with pytest.raises(PolicyUnavailable, match=f"exit status {status}"):
        one.health.check()
    assert not one.health.ready
    one.close()


@pytest.mark.slow
def test_a_child_whose_accelerator_failed_ends_so_that_the_replica_is_replaced() -> None:
    one = Engine(agent())
    one.start()
    ask(one, "a", "reset", instruction="a task")
    [reply] = ask_all(one, [("a", Request("act", observation(broken=True)))])
    assert isinstance(reply.error, PolicyFailed)
    wait_for(lambda: not one.health.ready)
    with pytest.raises(PolicyUnavailable, match="exit status 1"):
        one.health.check()
    one.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "config", "said"),
    [
        ("Broken", {}, "FileNotFoundError: no checkpoint here"),
        ("Telling", {"nope": 1}, "ConfigError: policy Telling"),
        ("Telling", {"needs": "no_such_package"}, "No module named 'no_such_package'"),
        ("Nobody", {}, "no class 'Nobody'"),
        ("", {}, "'/no/such/python' cannot be started here"),
        ("Dying", {}, "exit status 3; last output:\n  the driver is too old"),
    ],
)
def test_why_a_policy_does_not_load_is_said(policy: str, config: dict[str, Any], said: str) -> None:
    gone = ChildAgent(ChildProgram("/no/such/python", Settings("noop", {}, 1, ""), {}))
    one = Engine(agent(policy, **config) if policy else gone)
    with pytest.raises(VLAgentsError) as error:
        one.start()
    assert said in str(error.value)
    with pytest.raises(PolicyFailed) as seen:  # the message for the operator
        one.health.check()
    assert said in str(seen.value)
    with pytest.raises(PolicyUnavailable) as told:  # the message for clients
        one.health.require_ready()
    assert said not in str(told.value)
    assert sys.executable not in str(told.value)
    one.close()


@pytest.mark.slow
def test_the_child_ends_with_its_replica_that_is_killed() -> None:
    code = (
        "import sys, time\n"
        "from vlagents_ray.serve.python_env.child_main import Settings\n"
        "from vlagents_ray.serve.python_env.child_process import ChildProcess, ChildProgram\n"
        "program = ChildProgram(sys.executable, Settings('noop', {}, 1, ''), {})\n"
        "child = ChildProcess(program); child.wait_until_loaded()\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(600)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment
    ) as replica:
        pid = int(replica.stdout.readline())
        assert not ended(pid)
        replica.send_signal(signal.SIGKILL)
        wait_for(lambda: ended(pid))


ABILITIES = [value for value in vars(abilities).values() if isinstance(value, type)]
# The abilities whose values can be sent, and one that is defined only in this test.
SENT = [
    protocol
    for protocol in (*ABILITIES, Dances)
    if Protocol in protocol.__mro__[1:]  # type: ignore[comparison-overlap]
    and members(protocol)
    and not is_marked(protocol, InProcess)
]


@pytest.fixture(scope="module")
def able() -> Iterator[Engine]:
    """Yield a policy in a child process with all abilities whose values can be sent."""
    engine = Engine(agent("Able", protocols=[name_of(protocol) for protocol in SENT]))
    engine.start()
    yield engine
    engine.close()


@pytest.mark.parametrize("protocol", SENT, ids=lambda protocol: protocol.__name__)
def test_an_ability_of_the_policy_is_used_through_its_process(able: Engine, protocol: type) -> None:
    assert (ask(able, protocol.__name__, "reset", instruction="go")).error is None
    session = able.sessions.get(protocol.__name__).agent
    assert session is not None
    found: Any = ability(session, protocol)
    assert found is not None
    for member in members(protocol):
        if not is_method(protocol, member):
            assert getattr(found, member) == value_of(member)
            continue
        parameters = inspect.signature(getattr(protocol, member)).parameters
        arguments: dict[str, Any] = {name: f"value of {name}" for name in [*parameters][1:]}
        observing = observation_arguments(protocol).get(member)
        expected = dict(arguments)
        if observing is not None:
            arguments[observing] = observation(3.0)
            expected[observing] = {"value": 3.0}
        named = {
            name: expected.pop(name)
            for name, parameter in parameters.items()
            if parameter.kind is parameter.KEYWORD_ONLY
        }
        answer = getattr(found, member)(**arguments)
        assert answer == [member, "go", list(expected.values()), named]


@pytest.mark.parametrize("protocol", SENT, ids=lambda protocol: protocol.__name__)
def test_a_policy_without_an_ability_has_none_in_its_process(
    engine: Engine, protocol: type
) -> None:
    assert ask(engine, "without", "reset").error is None
    session = engine.sessions.get("without").agent
    assert session is not None
    found = ability(session, protocol)
    assert (found is not None) == (protocol in (Observes, HasWeightsId))
    assert ability(session, Prepares) is None, "the policy prepares no observations"


def test_an_ability_of_the_loaded_policy_is_used_while_it_acts(able: Engine) -> None:
    loaded = able.model.loaded.agent
    found: Any = ability(loaded, Dances)
    assert found.rest(2.5) == ["rest", None, [2.5], {}]
    with pytest.raises(NotReset, match="dance before reset"):
        found.dance(observation(), 1)


@pytest.mark.slow
def test_a_call_of_the_loaded_policy_does_not_wait_for_a_running_act() -> None:
    one = Engine(agent("ActsAfterRest"))
    one.start()
    assert ask(one, "a", "reset").error is None
    replies: list[Reply] = []
    submit(one, "a", Request("act", observation()), replies.append)
    wait_for(lambda: one.calls.under_way, 10)
    loaded: Any = ability(one.model.loaded.agent, Dances)
    assert loaded.rest(0.0) == "rested"
    wait_for(lambda: replies, 10)
    assert replies[0].error is None
    one.close()


@pytest.mark.slow
def test_an_error_of_a_call_of_the_loaded_policy_arrives_with_its_code() -> None:
    one = Engine(agent("ActsAfterRest"))
    one.start()
    loaded: Any = ability(one.model.loaded.agent, Dances)
    for seconds, message in [(-1.0, "ValueError"), (1.0, "cannot be sent"), (2.0, "SystemExit")]:
        with pytest.raises(PolicyFailed, match=message) as error:
            loaded.rest(seconds)
        assert "/no/path" not in str(error.value)
    assert loaded.rest(0.0) == "rested", "the process still answers"
    one.close()


def test_a_policy_without_parameters_is_not_trainable_there_either(engine: Engine) -> None:
    with pytest.raises(NotTrainable, match="Telling: names no parameters to train"):
        engine.weights.stage(1, {"w": np.zeros(1)}, PushOptions())
    assert engine.weights.describe()["newest"]["version"] == 0


def learner(policy: str = "Gain", **config: Any) -> tuple[Engine, ChildConnection]:
    """Yield a trained policy in a child process."""
    one = in_child(policy, **config)
    served = Engine(one)
    served.start()
    return served, one.child


def test_a_push_to_a_child_that_dies_is_refused_and_leaves_nothing() -> None:
    served, child = learner("DyingInAPush")
    files = Path(f"/proc/{os.getpid()}/fd")
    before = len(list(files.iterdir()))
    with pytest.raises(
        PolicyUnavailable, match="exit status 9, so that nothing was changed; push again"
    ):
        push(served, gains(1))
    assert len(list(files.iterdir())) <= before
    assert served.weights.number == 0
    assert not served.health.ready
    with pytest.raises(PolicyUnavailable):
        child.call_for_weights("wake")
    served.close()


@pytest.mark.slow
def test_the_child_drops_versions_that_nobody_acts_with_and_gives_others_to_new_replicas() -> None:
    served, _ = learner("Counting")
    for number in range(1, 5):
        push(served, gains(number), pin=True)
        reply = ask(served, "a", "reset", priority="simulation")
        assert (info(reply)["gain"], info(ask(served, "a", "act"))["policy"]["version"]) == (
            number,
            number,
        )
    [held] = served.weights.pushed_versions()
    np.testing.assert_equal(held.values, gains(4))
    wait_for(lambda: info(ask(served, "a", "reset", priority="simulation"))["versions"] == 1)
    served.close()


@pytest.mark.torch
def test_handles_of_a_learners_gpu_are_opened_by_the_child(monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    monkeypatch.setattr(shared_values, "_MEMORY", memory := SharedCpuMemory())
    served, _ = learner("OnSharedMemory")
    assert served.weights.newest().gpus == (GPU,)
    with shared({"weight": torch.full((2, 2), 3.0).T, "bias": torch.ones(2)}) as handles:
        digest = served.weights.stage(1, handles, PushOptions())
        served.weights.commit(1, PushOptions())
    assert memory.handles == 0
    reply = info(ask(served, "a", "reset", priority="simulation"))
    assert (reply["weight"], digest) == (3.0, served.weights.describe()["newest"]["fingerprint"])
    monkeypatch.setattr(memory, "uuid", "another")
    with (
        shared({"weight": torch.ones(2, 2), "bias": torch.ones(2)}) as handles,
        pytest.raises(NotShared),
    ):
        served.weights.stage(2, handles, PushOptions())
    served.close()


@pytest.mark.slow
def test_a_policy_in_a_child_process_says_whether_its_chunks_go_on_from_a_plan() -> None:
    settings = Settings("mirror_policy:CountingPolicy", {}, 16, "1")
    policy = ChildAgent(ChildProgram(sys.executable, settings, {"PYTHONPATH": f"{SUPPORT}:{ROOT}"}))
    assert ability(policy, ContinuesPlans) is None
    policy.initialize()
    try:
        plans, prefixes = ability(policy, ContinuesPlans), ability(policy, BeginsWithPlan)
        assert plans is not None
        assert plans.continues_plans is True
        assert prefixes is not None
        assert prefixes.longest_prefix == 0
    finally:
        policy.close()
