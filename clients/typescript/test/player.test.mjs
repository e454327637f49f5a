// Chunks, played row by row.

import assert from "node:assert/strict";
import { test } from "node:test";

import { ChunkPlayer, InvalidInput, PolicyFailed } from "vlagents-ray";

import { thrown } from "./fake-server.mjs";

test("a player plays the rows of a chunk in order, and the next one is asked for in time", async () => {
  let asked = 0;
  const agent = {
    reset: async () => ({}),
    close: async () => undefined,
    act: async () => {
      const number = asked++;
      const rows = [0, 1, 2, 3].map((row) => Float32Array.of(number, row));
      return { rows, done: number === 2, info: {}, timing: {}, resumed: false };
    },
  };
  const player = new ChunkPlayer(agent, { ahead: 2 });
  await player.reset({});
  const played = [];
  for (let tick = 0; tick < 8; tick++) {
    const { action, chunk, row, ageTicks, done } = await player.act({});
    assert.deepEqual([chunk, row, ageTicks], [...action, action[1]]);
    played.push([...action, done]);
  }
  // The second chunk was asked for with two rows left, at the third tick: its first two rows had passed by then.
  const want = [[0, 0], [0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 2], [2, 3]];
  assert.deepEqual(played, want.map(([chunk, row]) => [chunk, row, chunk === 2 && row === 3]));
  assert.throws(() => new ChunkPlayer(agent, { ahead: -1 }), InvalidInput);
});

test("a player says what failed where the rows are over, and goes on after it", async () => {
  let fails = false;
  const agent = {
    act: async () => {
      if (fails) throw new PolicyFailed("no", "policy_failed");
      return { rows: [0, 1].map((row) => Float32Array.of(row)), done: false, info: {}, timing: {}, resumed: false };
    },
  };
  const player = new ChunkPlayer(agent, { ahead: 1 });
  await player.act({});
  fails = true;
  assert.equal((await player.act({})).row, 1);
  await thrown(player.act({}), PolicyFailed, "policy_failed");
  fails = false;
  assert.equal((await player.act({})).row, 0);
});

test("a player reports its ticks, those that the loop missed, and the age of its last action", async () => {
  const infos = [];
  const agent = {
    reset: async () => ({}),
    act: async ({ info }) => {
      infos.push(info);
      return { rows: [0, 1].map((row) => Float32Array.of(row)), done: false, info: {}, timing: {}, resumed: false };
    },
  };
  const player = new ChunkPlayer(agent);
  assert.deepEqual(player.ticks, { all: 0, starved: 0, share: undefined });
  for (let tick = 0; tick < 5; tick++) {
    await player.act({ info: { mine: tick } });
    if (tick === 0) player.countMissed(3); // it waited for the first chunk
  }
  assert.deepEqual(player.ticks, { all: 8, starved: 3, share: 0.625 });
  assert.deepEqual(infos.map(({ mine, ticks }) => [mine, ...ticks]), [[0, 0, 0], [2, 5, 3], [4, 2, 0]]);
  assert.equal(infos[0].executed_age_ms, undefined);
  assert.ok(infos[1].executed_age_ms >= 0);
  await player.reset({});
  assert.equal(player.ticks.all, 0);
});
