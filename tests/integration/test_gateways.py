"""Real clients of vlagents, GR00T and LeRobot on one replica with batches."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from gr00t_client import PolicyClient
from lerobot_messages import AsyncClient, robot_saw
from peer_environment import package, peers_python
from virtual_environments import ended

from benchmarks.line_process import LineProcess
from tests.integration.conftest import SUPPORT, serving
from vlagents_ray.serve.ports import free_port

ANSWER_S = 120.0  # includes the imports of the client


@dataclass
class Ports:
    vlagents: int
    gr00t: int
    lerobot: int
    url: str = ""


@pytest.fixture(scope="module")
def ports(shared_ray: None) -> Iterator[Ports]:
    """Serve one replica and a gateway with all three dialects, and yield the ports."""
    ports = Ports(free_port(), free_port(), free_port())
    dialects = {name: {"port": getattr(ports, name)} for name in ("vlagents", "gr00t", "lerobot")}
    with serving("served_agents:Witness", batch={"max_size": 8}, dialects=dialects) as server:
        ports.url = server.url
        yield ports


class Robot:
    """A process with the real client of vlagents."""

    def __init__(self, port: int, mode: str, version: Sequence[Path] = ()) -> None:
        script = str(SUPPORT / "vlagents_robot.py")
        alone = {"PYTHONPATH": os.pathsep.join(map(str, version)), "WANDB_MODE": "offline"}
        words = [str(peers_python()), script, "127.0.0.1", str(port), "Witness", mode]
        self.child = LineProcess(f"vlagents {mode}", words, alone)

    def say(self, **wish: Any) -> Any:
        return self.child.request(json.dumps(wish), ANSWER_S)

    def act(self, pixel: int, instruction: str = "abc", **more: Any) -> list:
        """Return the action rows of each call."""
        answer = self.say(pixel=pixel, joints=0.5, gripper=0.25, instruction=instruction, **more)
        if isinstance(answer, dict):
            raise RuntimeError(answer["error"])  # noqa: TRY004 - the robot's own error
        return [[step[1] for step in act] for act in answer]


@contextlib.contextmanager
def robots(port: int, *modes: str, version: Sequence[Path] = ()) -> Iterator[list[Robot]]:
    with contextlib.ExitStack() as stack:
        found = [Robot(port, mode, version) for mode in modes]
        for robot in found:
            stack.enter_context(robot.child)
        yield found


def at_once(*calls: Callable[[], object]) -> list[object]:
    """Run each call in a separate thread, and return their results."""
    results: dict[int, object] = {}

    def run(number: int) -> None:
        try:
            results[number] = calls[number]()
        except Exception as error:  # noqa: BLE001 - the test compares it
            results[number] = error

    threads = [threading.Thread(target=run, args=(number,)) for number in range(len(calls))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(300)
    return [results[number] for number in range(len(calls))]


def close_to(rows: list, pixel: int, acts: int, text: int = 3) -> bool:
    want = [[pixel, 0.5, 0.25, text, acts], [pixel, 0.5, 0.25, text, acts + 1]]
    # JPEG changes a pixel slightly
    return bool(np.allclose(rows, want, atol=[2, 1e-6, 1e-6, 0, 0]))


def test_the_metadata_say_where_the_gateways_listen(ports: Ports) -> None:
    def told() -> dict[str, str]:
        with urllib.request.urlopen(f"{ports.url}/v1/metadata") as answer:
            return {name: one["address"] for name, one in json.load(answer)["dialects"].items()}

    schemes = {"gr00t": "tcp", "vlagents": "rpyc", "lerobot": "grpc"}
    wait_for(
        lambda: (
            told()
            == {
                name: f"{scheme}://127.0.0.1:{getattr(ports, name)}"
                for name, scheme in schemes.items()
            }
        )
    )


@pytest.mark.program("vlagents")
def test_vlagents_0_3_raw_jpeg_and_shared_memory_at_once(ports: Ports) -> None:
    """Each client gets its own answers, and the end of one client does not affect the others'
    memory.
    """
    with robots(ports.vlagents, "raw", "jpeg", "shm", "shm") as fleet:
        assert (
            at_once(*(lambda r=robot: r.say(say="is_initialized") for robot in fleet)) == [True] * 4
        )  # type: ignore[misc]
        assert fleet[0].say(say="git_status").keys() == {"vlagents_ray"}
        answers = at_once(*(lambda r=r, i=i: r.act(50 * i, calls=40) for i, r in enumerate(fleet)))  # type: ignore[misc]
        for i, acts in enumerate(answers):
            assert isinstance(acts, list), acts
            assert len(acts) == 40
            assert all(close_to(rows, 50 * i, number + 1) for number, rows in enumerate(acts))
        segments = fleet[3].say(say="segments")
        assert fleet[2].say(say="close") == "closed"
        assert segments
        assert all((Path("/dev/shm") / name).exists() for name in segments)
        assert close_to(fleet[3].act(99)[0], 99, 41)
        assert close_to(fleet[0].act(98, "other words")[0], 98, 1, text=11)
    assert not any((Path("/dev/shm") / name).exists() for name in segments)


def test_vlagents_0_2_resets_and_acts(ports: Ports) -> None:
    with robots(ports.vlagents, "raw", "shm", version=[package("vlagents==0.2.0")]) as fleet:
        for i, robot in enumerate(fleet):
            with pytest.raises(RuntimeError, match="not_reset"):
                robot.act(10)
            wish = {"pixel": 10 + i, "joints": 0.5, "gripper": 0.25, "kwargs": {"seed": 3}}
            assert robot.say(reset="pick it", **wish) == {
                "instruction": "pick it",
                "options": {"seed": 3},
            }
            [[rows]] = robot.act(20 + i)
            assert close_to(rows, 20 + i, 1, text=7)


def test_gr00t_clients_at_once_beside_vlagents(ports: Ports) -> None:
    def observation(pixel: int) -> dict[str, Any]:
        return {
            "video": {"ego": np.full((1, 1, 32, 32, 3), pixel, np.uint8)},
            "state": {"arm": np.full((1, 1, 3), 0.5, np.float32)},
            "language": {"task": [["abc"]]},
        }

    def episode(pixel: int) -> list[list[float]]:
        with PolicyClient(ports.gr00t) as client:
            return [
                client.get_action(observation(pixel))[0]["action"][0, 0].tolist() for _ in range(60)
            ]

    with robots(ports.vlagents, "raw") as [robot]:
        *episodes, acts = at_once(
            *(lambda p=pixel: episode(p) for pixel in range(10, 70, 10)),  # type: ignore[misc]
            lambda: robot.act(5, calls=20),
        )
    assert episodes == [
        [[pixel, 0.5, -1, 3, i + 1] for i in range(60)] for pixel in range(10, 70, 10)
    ]
    assert isinstance(acts, list), acts
    assert all(close_to(rows, 5, number + 1) for number, rows in enumerate(acts))


def test_clients_of_lerobots_asynchronous_inference_at_once(ports: Ports) -> None:
    def episode(pixel: int) -> list[list[float]]:
        with AsyncClient(ports.lerobot).begin() as client:
            return [client.act(robot_saw(i, pixel))[0].action.tolist() for i in range(60)]

    episodes = at_once(*(lambda p=pixel: episode(p) for pixel in (10, 20, 30)))  # type: ignore[misc]
    assert episodes == [[[pixel, 0.5, -1, 3, i + 1] for i in range(60)] for pixel in (10, 20, 30)]


def test_clients_go_on_when_the_replica_behind_the_gateway_dies(ports: Ports) -> None:
    """This is the last test of the server, since it kills the replica, which Serve replaces."""
    with (
        robots(ports.vlagents, "shm") as [robot],
        PolicyClient(ports.gr00t) as client,
        AsyncClient(ports.lerobot).begin() as arm,
    ):
        arm.act(robot_saw(0, 8))
        wish = {"pixel": 7, "joints": 0.5, "gripper": 0.25, "instruction": "abc"}
        [before] = robot.say(**wish)
        pid = before[0][4]["pid"]
        client.ping()
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda: ended(pid))
        [after] = robot.say(**wish)
        assert after[0][4]["pid"] != pid
        assert after[0][4]["resumed"] is True
        assert close_to([step[1] for step in after], 7, 1)
        assert client.ping()["status"] == "ok"
        assert arm.act(robot_saw(1, 9))[0].action[0] == 9
