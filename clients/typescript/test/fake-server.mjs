// A server that answers as a test says, on a port of its own.

import assert from "node:assert/strict";
import { createServer } from "node:http";

import { WebSocketServer } from "ws";

import { pack, RemoteAgent, unpack, ValueReader } from "vlagents-ray";

export const LONG_MS = 20000;

/** The frame of a reply; an action becomes its blob. */
export function reply(node, action) {
  if (action === undefined) return pack(node, []);
  const data = Float32Array.from(action);
  const act = { action: { $: ["nd", 0, "<f4", [data.length]] }, done: false, info: {} };
  return pack({ ...node, act }, [new Uint8Array(data.buffer)]);
}

/**
 * `http(request, response)` answers what it likes, and returns true if it did; `stream(message, socket, number)` gets each
 * message's header and the number of the connection. By default resets and acts are answered.
 */
export async function fakeServer({ http, stream = answer, metadata = {}, sockets = () => undefined } = {}) {
  const requests = []; // the headers of all messages
  const server = createServer((request, response) => {
    if (http?.(request, response)) return;
    response.setHeader("content-type", "application/json");
    response.end(JSON.stringify({ protocol: 1, contract: null, stream: null, ...metadata }));
  });
  const streams = new WebSocketServer({ server, path: "/v1/stream" });
  let connections = 0;
  streams.on("connection", (socket) => {
    const number = connections++;
    sockets(socket, number);
    socket.on("message", (data) => {
      const { header, blobs } = unpack(new Uint8Array(data));
      const message = { ...new ValueReader(blobs).value(header), connection: number };
      requests.push(message);
      stream(message, socket, number, requests);
    });
  });
  await new Promise((resolve) => server.listen(0, "127.0.0.1", resolve));
  const url = `http://127.0.0.1:${server.address().port}`;
  const close = () => {
    for (const socket of streams.clients) socket.terminate();
    server.closeAllConnections();
    return new Promise((resolve) => server.close(resolve));
  };
  return { url, requests, connections: () => connections, streams, close };
}

/** Answers a reset with step 100, and an act with the number of the connection and a step of one more. */
export function answer(message, socket, number) {
  const { op, request_id, step } = message;
  if (op === "act") socket.send(reply({ request_id, step: String(Number(step ?? 100) + 1) }, [number]));
  else socket.send(reply({ request_id, info: {}, ...(op === "reset" && { step: "100" }) }));
}

export function fail(message, socket, error, more = {}) {
  socket.send(reply({ request_id: message.request_id, error, ...more }));
}

/** Run a test with a fake server and a client of it. */
export async function with_(server, options, body) {
  const fake = await fakeServer(server);
  const agent = new RemoteAgent(fake.url, { timeoutMs: LONG_MS, ...options });
  try {
    await body(agent, fake);
  } finally {
    await agent.close();
    await fake.close();
  }
}

/** Fails unless the promise is rejected with that error. */
export const thrown = (promise, kind, code) => assert.rejects(promise, (error) => {
  assert.ok(error instanceof kind, `${error.name}: ${error.message}`);
  assert.equal(error.code, code);
  return true;
});
