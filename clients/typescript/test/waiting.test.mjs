// Servers that are silent, which takes seconds to find out.

import assert from "node:assert/strict";
import { createServer } from "node:net";
import { test } from "node:test";

import { DeadlineExceeded } from "vlagents-ray";

import { answer, with_ } from "./fake-server.mjs";

test("a server that froze is left after five seconds without a sign of it", async () => {
  let frozen;
  const errors = [];
  const stream = (message, socket, number) => {
    if (message.op !== "act" || number > 0) return answer(message, socket, number);
    frozen ??= socket._socket.pause(); // it reads no more, and answers no ping
  };
  await with_({ stream }, {}, async (agent, fake) => {
    await agent.reset({});
    while (fake.connections() === 1) await agent.act({}, 1500).catch((error) => errors.push(error));
    assert.ok(errors[0] instanceof DeadlineExceeded);
    assert.equal((await agent.act({})).rows[0][0], fake.connections() - 1);
  });
});

test("a stream that cannot be reached is replaced by the path through the proxy", async () => {
  const deaf = createServer(() => undefined); // accepts, and says nothing
  await new Promise((resolve) => deaf.listen(0, "127.0.0.1", resolve));
  for (const port of [9, deaf.address().port]) {
    await with_({ metadata: { stream: { port, path: "/v1/stream/x" } } }, {}, async (agent) => {
      await agent.reset({});
      assert.equal(agent.transport, "websocket");
    });
  }
  deaf.close();
  deaf.unref();
});
