"""A policy measured alone, by batch size."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from benchmarks.policy import PolicyPlan, main, measure_policy
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError, InvalidObservation
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.launch.deployment_file import policy_application


class Picky(Noop):
    """A policy that checks its observations. Its contract leaves the length of a part of the state
    open.
    """

    seen: list[int] = []  # noqa: RUF012 - a class attribute, which tests read

    @property
    def contract(self) -> Contract:
        cameras = {"front": CameraSpec(20, 30), "wrist": CameraSpec()}
        return Contract(
            cameras=cameras, state={"pose": StateSpec()}, action=ActionSpec(dim=7), chunk=1
        )

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        for one in obs:
            if one.cameras["front"].shape != (20, 30, 3) or one.cameras["wrist"].shape != (
                48,
                48,
                3,
            ):
                raise InvalidObservation("images")
            if one.state["pose"].shape != (9,):
                raise InvalidObservation("pose: expected shape (9,)")
        self.seen.append(len(obs))
        return super().act_batch(obs, sessions)


def plan(**changed: Any) -> PolicyPlan:
    args = ServerArgs(policy="noop", config={"base_ms": 10, "per_item_ms": 1})
    return PolicyPlan(**{"args": args, "batches": (1, 4), "seconds": 0.1, "rounds": 2, **changed})


@pytest.mark.slow
def test_larger_batches_give_more_actions_bare_and_behind_the_queue() -> None:
    found = measure_policy(plan(rounds=5))
    one, four = found["batches"]
    assert (one["batch"], four["batch"]) == (1, 4)
    for way in ("bare", "queued"):
        best_of_one, best_of_four = (
            max(r["actions_per_s"] for r in size["rounds"][way]) for size in (one, four)
        )
        # The best round counts, since a busy machine slows down some rounds.
        assert best_of_four > 1.5 * best_of_one
        assert len(one["rounds"][way]) == 5
    # A sleep is never shorter than its argument.
    assert one["bare"]["actions_per_s"] < 1000 / 11
    assert one["queued"]["round_trip_ms"] > 11
    assert one["queued"]["mean_batch"] == pytest.approx(1)
    assert 1 < four["queued"]["mean_batch"] <= 4
    assert one["peak_mib"] > 0


@pytest.mark.slow
def test_observations_fit_the_contract_and_what_it_leaves_open_can_be_said() -> None:
    args = ServerArgs(policy=f"{__name__}:Picky")
    found = measure_policy(plan(args=args, side=48, dims={"pose": 9}))
    assert max(Picky.seen) == 4
    assert found["device"] == "cpu"
    with pytest.raises(InvalidObservation, match="pose"):
        measure_policy(plan(args=args, side=48))


def test_no_batch_is_larger_than_those_of_a_compiled_model() -> None:
    args = ServerArgs(policy="noop", batch={"sizes": [1, 2]})
    with pytest.raises(ConfigError, match=r"batch\.sizes is 2"):
        measure_policy(plan(args=args))


def test_one_policy_of_a_file_is_named(tmp_path: Path) -> None:
    file = tmp_path / "two.yaml"
    app = (
        "  - {{name: {0}, route_prefix: /{0}, import_path: vlagents_ray.serve.app:build, args: "
        "{{policy: {0}}}}}\n"
    )
    file.write_text("applications:\n" + app.format("noop") + app.format("random"))
    assert policy_application(str(file), "random").args["policy"] == "random"
    with pytest.raises(ConfigError, match=r"noop.*random"):
        policy_application(str(file))
    assert policy_application("noop").args["policy"] == "noop"


def test_a_policy_is_measured_with_other_settings_than_its_files(tmp_path: Path) -> None:
    command = typer.Typer()
    command.command()(main)
    words = ["noop", "--set", "base_ms=20", "--batch", "1", "--seconds", "0.1", "--rounds", "1"]
    done = CliRunner().invoke(command, [*words, "--out", str(tmp_path / "found.json")])
    assert done.exit_code == 0, done.output
    [row] = json.loads((tmp_path / "found.json").read_text())["batches"]
    assert row["bare"]["batch_ms"] >= 20
    assert row["queued_share"] == pytest.approx(
        row["queued"]["actions_per_s"] / row["bare"]["actions_per_s"]
    )
