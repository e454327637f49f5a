"""The chunk player with policies that give their chunks in parts."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from streaming_agents import ROWS, InParts

from vlagents_ray import Act, Agent, Obs, PolicyFailed
from vlagents_ray.chunking.buffer import Chunk, ChunkBuffer
from vlagents_ray.chunking.player import ChunkPlayer
from vlagents_ray.errors import InvalidAction
from vlagents_ray.interface import SAFE, SILENT

Make = Callable[..., tuple[ChunkPlayer, InParts]]


@pytest.fixture
def playing() -> Iterator[Make]:
    """A player in an episode, and its policy; with a deadline, it has the first chunk, of the value -1."""
    made: list[tuple[ChunkPlayer, InParts]] = []

    def play(*, check: Any = None, execute: int | None = None, **options: Any) -> tuple[ChunkPlayer, InParts]:
        policy = InParts(gated=True)
        assert policy.gate is not None
        safe = np.full(2, -7.0, np.float32)
        player = ChunkPlayer(policy, safe=safe, check=check, execute=execute, **options)
        made.append((player, policy))
        if options:
            policy.gate.release(ROWS)  # what `reset` may wait for
        player.reset(Obs(info={"value": -1.0}), "task")
        return player, policy

    yield play
    for player, policy in made:
        policy.gate.release(100 * ROWS)  # type: ignore[union-attr]
        player.close()


def tick(player: ChunkPlayer, value: float, **info: Any) -> Act:
    return player.act(Obs(info={"value": value, **info}))


def let(policy: InParts, parts: int) -> None:
    """Let the policy compute so many parts, and wait for them."""
    assert policy.gate is not None
    before = len(policy.record.computed)
    policy.gate.release(parts)
    wait_for(lambda: len(policy.record.computed) == before + parts)


def taken(player: ChunkPlayer) -> bool:
    """Whether the player's thread has an answer."""
    assert player._asker is not None
    return bool(player._asker._answers)


def test_without_a_deadline_each_part_is_waited_for_only_when_its_rows_are_due(playing: Make) -> None:
    player, policy = playing()
    assert policy.gate is not None
    for row in range(ROWS):
        policy.gate.release()
        act = tick(player, 10.0 * row, done=True)
        assert act.action.tolist() == [0.0, row]
        assert act.info["row"] == row
        assert act.done == (row == ROWS - 1)
        assert len(policy.record.computed) == row + 1


def test_rows_that_are_not_executed_are_read_before_the_next_request(playing: Make) -> None:
    player, policy = playing(execute=2)
    assert policy.gate is not None
    policy.gate.release(2 * ROWS)
    assert [tick(player, value).action.tolist() for value in (0.0, 1.0, 2.0, 3.0)] == [
        [0.0, 0.0],
        [0.0, 1.0],
        [2.0, 0.0],
        [2.0, 1.0],
    ]


def test_after_a_stop_the_rest_of_the_chunk_is_not_executed(playing: Make) -> None:
    player, policy = playing()
    assert policy.gate is not None
    policy.gate.release()
    assert tick(player, 0.0).action.tolist() == [0.0, 0.0]
    player.interrupt()
    policy.gate.release()
    assert tick(player, 5.0).action.tolist() == [5.0, 0.0]
    assert policy.record.computed == [0, 0]


def test_with_a_deadline_the_first_rows_are_executed_while_the_others_are_computed(playing: Make) -> None:
    player, policy = playing(deadline_s=60.0)
    for row in range(ROWS):
        assert tick(player, 99.0).action.tolist() == [-1.0, row]  # the chunk of `reset`
    assert policy.gate is not None
    for row in range(ROWS):
        policy.gate.release()
        act = tick(player, 10.0 + row)
        assert act.action.tolist() == [10.0, row]
        assert len(policy.record.computed) == ROWS + row + 1


def test_where_the_next_part_is_late_the_safe_action_holds_the_plan(playing: Make) -> None:
    player, policy = playing(deadline_s=0.0)
    for _ in range(ROWS):
        tick(player, 99.0)
    assert SAFE in tick(player, 10.0).info  # asks
    let(policy, 1)
    wait_for(lambda: taken(player))
    assert tick(player, 99.0).action.tolist() == [10.0, 0.0]
    late = tick(player, 99.0)
    assert late.action.tolist() == [-7.0, -7.0]
    assert late.info[SILENT] > 0.0
    let(policy, 2)
    wait_for(lambda: len(player._asker._answers) == 2)  # type: ignore[union-attr]
    assert [tick(player, 99.0).action.tolist() for _ in range(2)] == [[10.0, 1.0], [10.0, 2.0]]


def test_in_the_background_rows_replace_those_of_the_older_chunk_as_they_come(playing: Make) -> None:
    player, policy = playing(mode="async")
    assert tick(player, 99.0).action.tolist() == [-1.0, 0.0]
    assert tick(player, 20.0).action.tolist() == [-1.0, 1.0]  # asks, after one executed action
    let(policy, 2)  # rows for steps 1 and 2 of the plan
    wait_for(lambda: len(player._asker._answers) == 2)  # type: ignore[union-attr]
    assert tick(player, 99.0).action.tolist() == [20.0, 1.0]
    assert tick(player, 99.0).action.tolist() == [-1.0, 3.0]  # the new chunk does not reach that far yet
    let(policy, 2)
    wait_for(lambda: len(player._asker._answers) == 2)  # type: ignore[union-attr]
    act = tick(player, 99.0)
    assert act.action.tolist() == [20.0, 3.0]
    assert act.info["chunk"] == 1


def test_an_answer_that_breaks_off_leaves_its_rows_and_the_next_one_is_another_chunk(playing: Make) -> None:
    player, policy = playing(deadline_s=60.0)
    assert policy.gate is not None
    for _ in range(ROWS):
        tick(player, 99.0)
    policy.gate.release(2)
    numbers = []
    assert tick(player, 10.0, fail_at=1).action.tolist() == [10.0, 0.0]
    with pytest.raises(RuntimeError):  # the policy's own error is not cured by asking again
        tick(player, 99.0)
    policy.gate.release(ROWS)
    for row in range(ROWS):
        act = tick(player, 11.0)
        numbers.append(act.info["chunk"])
        assert act.action.tolist() == [11.0, row]
    assert numbers == [2] * ROWS


def test_each_row_passes_the_guard(playing: Make) -> None:
    def check(action: np.ndarray, last: np.ndarray | None) -> np.ndarray:
        if action[1] == 2.0:
            raise InvalidAction("row 2 is not allowed")
        return action

    player, policy = playing(check=check)
    assert policy.gate is not None
    policy.gate.release(ROWS)
    assert [tick(player, 0.0).action.tolist() for _ in range(2)] == [[0.0, 0.0], [0.0, 1.0]]
    with pytest.raises(InvalidAction, match="row 2"):
        tick(player, 0.0)


def refuses(forbidden: list[float]) -> Callable[[np.ndarray, np.ndarray | None], np.ndarray]:
    """A guard that refuses one action."""

    def check(action: np.ndarray, last: np.ndarray | None) -> np.ndarray:
        if action.tolist() == forbidden:
            raise InvalidAction("not there")
        return action

    return check


def test_rows_that_come_after_the_guard_has_refused_one_are_not_executed(playing: Make) -> None:
    """They were planned from where the refused action would have led."""
    player, policy = playing(check=refuses([0.0, 1.0]))
    assert policy.gate is not None
    policy.gate.release(2 * ROWS)
    assert tick(player, 0.0).action.tolist() == [0.0, 0.0]
    with pytest.raises(InvalidAction, match="not there"):
        tick(player, 1.0)
    assert tick(player, 5.0).action.tolist() == [5.0, 0.0]


def test_with_a_deadline_rows_that_come_after_a_refused_one_are_not_executed(playing: Make) -> None:
    player, policy = playing(deadline_s=0.0, check=refuses([10.0, 1.0]))
    for _ in range(ROWS):
        tick(player, 99.0)
    tick(player, 10.0)  # asks
    let(policy, 2)
    wait_for(lambda: len(player._asker._answers) == 2)  # type: ignore[union-attr]
    assert tick(player, 99.0).action.tolist() == [10.0, 0.0]
    assert tick(player, 99.0).info[SAFE] == "not there"
    let(policy, ROWS - 2)
    wait_for(lambda: len(player._asker._answers) == ROWS - 2)  # type: ignore[union-attr]
    assert SAFE in tick(player, 20.0).info  # asks again
    let(policy, ROWS)
    wait_for(lambda: len(player._asker._answers) == ROWS)  # type: ignore[union-attr]
    assert [tick(player, 99.0).action.tolist() for _ in range(ROWS)] == [[20.0, row] for row in range(ROWS)]


@pytest.mark.parametrize("broken", range(ROWS))
def test_the_rows_after_a_part_that_is_refused_do_not_take_its_place(broken: int, playing: Make) -> None:
    player, policy = playing(deadline_s=0.0)
    for _ in range(ROWS):
        tick(player, 99.0)
    tick(player, 10.0, broken_at=broken)  # asks
    let(policy, ROWS)
    wait_for(lambda: len(player._asker._answers) == ROWS)  # type: ignore[union-attr]
    assert [tick(player, 99.0).action.tolist() for _ in range(broken)] == [[10.0, row] for row in range(broken)]
    assert "NaN" in tick(player, 20.0).info[SAFE]  # and asks again
    let(policy, ROWS)
    wait_for(lambda: len(player._asker._answers) == ROWS)  # type: ignore[union-attr]
    assert tick(player, 99.0).action.tolist() == [20.0, 0.0]


def test_without_a_deadline_a_refused_part_is_raised_and_the_policy_is_asked_again(playing: Make) -> None:
    player, policy = playing()
    assert policy.gate is not None
    policy.gate.release(3 * ROWS)
    assert tick(player, 10.0, broken_at=1).action.tolist() == [10.0, 0.0]
    with pytest.raises(InvalidAction, match="NaN"):
        tick(player, 99.0)
    assert [tick(player, 20.0).action.tolist() for _ in range(2)] == [[20.0, 0.0], [20.0, 1.0]]


def test_the_task_is_done_with_the_last_action_although_more_rows_are_known_by_then(playing: Make) -> None:
    """Only the last part says that the task is done, and it is read when the rows before it were executed."""
    player, policy = playing(execute=2)
    assert policy.gate is not None
    policy.gate.release(ROWS)
    acts = [tick(player, 0.0, done=True) for _ in range(3)]
    assert [act.action.tolist() for act in acts] == [[0.0, row] for row in range(3)]
    assert [act.done for act in acts] == [False, False, True]


class Sudden(InParts):
    """Says in each part that the task is done."""

    def act_stream(self, obs: Obs) -> Generator[Act, None, None]:
        for part in super().act_stream(obs):
            yield replace(part, done=True)


def test_a_part_that_others_follow_does_not_end_the_task() -> None:
    player = ChunkPlayer(Sudden())
    player.reset(Obs(), "task")
    assert [tick(player, 0.0).done for _ in range(ROWS)] == [False] * (ROWS - 1) + [True]


class Unending(Agent):
    """Has no parts, but says that further ones follow."""

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        return Act(np.full((2, 2), obs.info["value"], np.float32), more=True)


@pytest.mark.parametrize("deadline_s", [None, 60.0])
def test_what_act_returns_is_a_whole_chunk_whatever_it_says(deadline_s: float | None) -> None:
    player = ChunkPlayer(Unending(), deadline_s=deadline_s, safe=np.zeros(2, np.float32))
    player.reset(Obs(info={"value": 1.0}), "task")
    first = 1.0 if deadline_s else 2.0  # the chunk of `reset`
    assert [tick(player, 2.0).action[0] for _ in range(4)] == [first, first, 2.0, 2.0]
    player.close()


class Marked(InParts):
    """Says something in its first part alone."""

    def act_stream(self, obs: Obs) -> Generator[Act, None, None]:
        for number, part in enumerate(super().act_stream(obs)):
            yield replace(part, info={**part.info, **({} if number else {"resumed": True})})


def test_what_the_first_part_says_holds_for_all_rows() -> None:
    player = ChunkPlayer(Marked())
    player.reset(Obs(), "task")
    assert all(tick(player, 0.0).info["resumed"] for _ in range(ROWS))


def test_a_stream_in_progress_is_closed_before_the_policy() -> None:
    class Closing(InParts):
        def close(self) -> None:
            assert self.record.closed == [0]  # the caller has read one part, and was given none after it

    player = ChunkPlayer(Closing())
    player.reset(Obs(), "task")
    tick(player, 0.0)
    player.close()


def test_a_stream_without_a_last_part_is_the_policys_failure(playing: Make) -> None:
    player, policy = playing()
    assert policy.gate is not None
    policy.gate.release(ROWS)
    assert tick(player, 0.0, ends_at=1).action.tolist() == [0.0, 0.0]
    with pytest.raises(PolicyFailed, match="last part"):
        tick(player, 0.0, ends_at=1)


def test_a_first_part_that_comes_late_is_not_executed_late() -> None:
    """Unlike an answer of a single action, it has further rows."""
    rows = np.arange(8, dtype=np.float32).reshape(4, 2)
    buffer = ChunkBuffer()
    buffer.replace(rows[:1])
    buffer.advance()
    assert not buffer.add(Chunk(1, 0, rows[:1], more=True))
    assert buffer.next is None
    assert buffer.extend(Chunk(1, 0, rows[:2], more=True))
    assert buffer.extend(Chunk(1, 0, rows))
    found = []
    while (step := buffer.next) is not None:
        found.append(step.row)
        buffer.advance()
    assert found == [1, 2, 3]
