// The client with real servers of vlagents_ray, whose addresses are in the environment (tests/clients/test_typescript.py).

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { connect, createServer } from "node:net";
import { test } from "node:test";

import {
  ChunkPlayer, DeadlineExceeded, ImageFile, InvalidObservation, NdArray, PolicyFailed, RemoteAgent, Unauthorized,
} from "vlagents-ray";

const { VLAGENTS_TEST_URL: URL_, VLAGENTS_TEST_PROXIED_URL: PROXIED, VLAGENTS_TEST_KEYED_URL: KEYED } = process.env;
const KEY = process.env.VLAGENTS_TEST_KEY;
const JPEG = new Uint8Array(readFileSync(new URL("../../golden/gray.jpg", import.meta.url)));
const pixels = { height: 2, width: 3, data: new Uint8Array(18).fill(10) };

async function using(agent, body) {
  try {
    return await body(agent);
  } finally {
    await agent.close();
  }
}

for (const [name, url, options] of [
  ["stream", URL_, {}],
  ["websocket", PROXIED, {}],
  ["http", URL_, { transport: "http" }],
  ["websocket", KEYED, { key: KEY }],
  ["http", KEYED, { key: KEY, transport: "http" }],
]) {
  test(`an episode over ${name}${options.key ? ", with a key" : ""}`, async () => {
    await using(new RemoteAgent(url, options), async (agent) => {
      const first = { cameras: { front: pixels }, gripper: 1, state: { joints: [0.5, 0] } };
      const info = await agent.reset(first, "push", { seed: 3, goal: new NdArray("<f4", [2], Float32Array.of(1, 2)) });
      assert.equal(agent.transport, name);
      assert.deepEqual([info.instruction, info.cameras, info.kwargs.seed], ["push", ["front"], 3]);
      assert.deepEqual(info.kwargs.goal.numbers(), [1, 2]);
      const act = await agent.act(first);
      assert.deepEqual(act.rows.map((row) => [...row]), [0, 1, 2, 3].map((row) => [0, row, 1, 10, 0.5]));
      assert.ok(act.timing.total_ms > 0);
      const told = { text: "方块", list: [1, null, true], raw: Uint8Array.of(0, 255), nan: NaN };
      const seen = await agent.act({ cameras: { front: new ImageFile(JPEG) }, info: { tell: told } });
      assert.deepEqual([...seen.rows[0]].slice(0, 3), [1, 0, -1]);
      assert.ok(Math.abs(seen.rows[0][3] - 128) < 2);
      assert.deepEqual(seen.info.told, told);
      assert.deepEqual([seen.done, seen.resumed, seen.info.observed], [false, false, 0]);
      await agent.reset({}, "again");
      assert.equal((await agent.act({})).rows[0][0], 0);
    });
  });

  test(`errors over ${name}${options.key ? ", with a key" : ""} are told, and the session goes on`, async () => {
    await using(new RemoteAgent(url, options), async (agent) => {
      await agent.reset({});
      await assert.rejects(agent.act({ info: { fail: true } }), PolicyFailed);
      await assert.rejects(agent.act({ gripper: 7 }), InvalidObservation);
      await assert.rejects(agent.act({ state: { joints: [NaN] } }), InvalidObservation);
      await assert.rejects(agent.act({ info: { sleep_s: 0.6 } }, 100), DeadlineExceeded);
      // The policy is still at work, or has been: the session goes on from whatever step it has.
      const act = await agent.act({});
      assert.equal(act.resumed, false);
    });
  });
}

test("without a key, or with a wrong one, nothing is answered", async () => {
  for (const key of [undefined, "vlr_wrong"]) {
    for (const transport of ["websocket", "http"]) {
      await using(new RemoteAgent(KEYED, { key, transport }), (agent) => assert.rejects(agent.reset({}), Unauthorized));
    }
  }
});

test("robots with names of their own do not meet", async () => {
  await using(new RemoteAgent(URL_), (one) => using(new RemoteAgent(URL_, { transport: "http" }), async (other) => {
    await one.reset({});
    await other.reset({});
    await one.act({});
    assert.equal((await one.act({})).rows[0][0], 1);
    assert.equal((await other.act({})).rows[0][0], 0);
  }));
});

test("a link that is cut in the middle of an episode costs no more than a new beginning", async () => {
  const { port } = new URL(PROXIED);
  const links = new Set();
  const link = createServer((near) => {
    const far = connect(Number(port), "127.0.0.1");
    for (const [from, to] of [[near, far], [far, near]]) {
      links.add(from);
      from.pipe(to);
      from.on("error", () => to.destroy()).on("close", () => links.delete(from));
    }
  });
  await new Promise((resolve) => link.listen(0, "127.0.0.1", resolve));
  await using(new RemoteAgent(`http://127.0.0.1:${link.address().port}`), async (agent) => {
    await agent.reset({ gripper: 0 }, "push");
    for (let i = 0; i < 3; i++) await agent.act({ gripper: 0.5 });
    for (const end of links) end.destroy();
    const act = await agent.act({ gripper: 1 });
    assert.deepEqual([act.resumed, act.info.observed, act.rows[0][0], act.rows[0][2]], [true, 2, 0, 1]);
    assert.equal((await agent.act({})).resumed, false);
  });
  for (const end of links) end.destroy();
  link.close();
});

test("a player with a real policy plays rows that belong to their ticks", async () => {
  await using(new ChunkPlayer(new RemoteAgent(URL_), { ahead: 2 }), async (player) => {
    await player.reset({}, "push");
    let asked = -1;
    for (let tick = 0; tick < 20; tick++) {
      const { action, row, chunk } = await player.act({ gripper: 1 });
      assert.deepEqual([...action].slice(0, 3), [chunk, row, 1]);
      assert.ok(chunk === asked || chunk === asked + 1);
      asked = chunk;
      if (tick === 5) player.countMissed(2); // the server refuses an act whose report is wrong
    }
    assert.deepEqual(player.ticks, { all: 22, starved: 2, share: 1 - 2 / 22 });
    assert.ok(asked >= 5);
  });
});

test("an agent that was closed can begin again", async () => {
  const agent = new RemoteAgent(URL_);
  for (let i = 0; i < 2; i++) {
    await agent.reset({});
    await agent.act({});
    await agent.close();
  }
});
