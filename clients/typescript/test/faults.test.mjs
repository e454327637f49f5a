// What a client does about a server that is gone, busy, or answers wrongly.

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { once } from "node:events";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { createServer } from "node:https";
import { tmpdir } from "node:os";
import { test } from "node:test";

import {
  ConnectionLost, DeadlineExceeded, InvalidInput, InvalidObservation, MessageTooLarge, NoReplica, NotReset,
  OutcomeUnknown, Overloaded, PolicyFailed, PolicyUnavailable, RemoteAgent, Unauthorized, UnknownSession, unpack,
  VLAgentsError,
} from "vlagents-ray";

import { answer, fail, fakeServer, LONG_MS, reply, thrown, with_ } from "./fake-server.mjs";

const golden = new URL("../../golden/", import.meta.url);

test("a wrong url, and a call of act before reset, are rejected without a server", async () => {
  assert.throws(() => new RemoteAgent("gpu-box:8000"), InvalidInput);
  await thrown(new RemoteAgent("http://127.0.0.1:9").act({}), NotReset, "not_reset");
});

test("a server that is not there is said so at once", async () => {
  const begun = Date.now();
  await thrown(new RemoteAgent("http://127.0.0.1:9", { timeoutMs: LONG_MS }).reset({}), PolicyUnavailable, "unavailable");
  assert.ok(Date.now() - begun < LONG_MS / 2);
});

test("a port that speaks TLS, and a certificate of an unknown authority, are named with their cure", async () => {
  const files = mkdtempSync(`${tmpdir()}/`);
  const [key, cert] = [`${files}/key`, `${files}/cert`];
  execFileSync("openssl", ["req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-subj", "/CN=here", "-keyout", key, "-out", cert], { stdio: "ignore" });
  const server = createServer({ key: readFileSync(key), cert: readFileSync(cert) }).listen(0, "127.0.0.1");
  await once(server, "listening");
  const at = (scheme) => new RemoteAgent(`${scheme}://127.0.0.1:${server.address().port}`, { timeoutMs: LONG_MS }).reset({});
  await assert.rejects(at("http"), /One with TLS needs https/);
  await assert.rejects(at("https"), /name its file in NODE_EXTRA_CA_CERTS/);
  server.close();
  rmSync(files, { recursive: true });
});

test("a server that is not ready is waited for", async () => {
  let refused = 0;
  const http = (request, response) => {
    if (refused++ >= 2) return false;
    response.writeHead(503, { "retry-after": "0", "content-type": refused === 1 ? "text/plain" : "application/problem+json" });
    response.end(refused === 1 ? "no replicas" : JSON.stringify({ code: "unavailable", detail: "it loads" }));
    return true;
  };
  await with_({ http }, {}, async (agent) => {
    await agent.reset({});
    assert.equal(refused, 3);
  });
});

for (const [status, type, body, kind, code] of [
  [503, "text/plain", "no replicas", NoReplica, "no_replica"],
  [503, "application/problem+json", '{"code": "no_replica", "detail": "none"}', NoReplica, "no_replica"],
  [404, "text/html", "<html>", PolicyUnavailable, "unavailable"],
  [401, "application/problem+json", '{"code": "unauthorized", "detail": "no key"}', Unauthorized, "unauthorized"],
  [500, "application/problem+json", "not JSON", ConnectionLost, "connection_lost"],
  [418, "application/problem+json", '{"code": "teapot", "detail": "short"}', VLAgentsError, "internal"],
  [200, "application/json", "not JSON", VLAgentsError, "internal"],
  [200, "application/json", '{"protocol": 2}', VLAgentsError, "internal"],
]) {
  test(`metadata with status ${status}, ${type}, ${body} is the error ${code}`, async () => {
    const http = (request, response) => {
      response.writeHead(status, { "content-type": type, "retry-after": "1000" }).end(body); // longer than it waits
      return true;
    };
    await with_({ http }, {}, (agent) => thrown(agent.reset({}), kind, code));
  });
}

test("a key is in the handshake, and a refused handshake is its error", async () => {
  const fake = await fakeServer();
  fake.streams.options.verifyClient = ({ req }, done) => done(req.headers.authorization === "Bearer good", 403, "forbidden");
  const [good, bad] = ["good", "bad"].map((key) => new RemoteAgent(fake.url, { key, timeoutMs: LONG_MS }));
  await good.reset({});
  await thrown(bad.reset({}), InvalidInput, "forbidden");
  await good.close();
  await fake.close();
});

const malformed = JSON.parse(readFileSync(new URL("index.json", golden))).filter((one) => one.kind === "malformed");

test("what is no frame ends the connection, and the session is begun again", async () => {
  let wrong = 0;
  const stream = (message, socket, number) => {
    if (message.op !== "act" || message.connection >= malformed.length) return answer(message, socket, number);
    socket.send(readFileSync(new URL(malformed[wrong++].file, golden)));
  };
  await with_({ stream, metadata: { contract: { history: 2 } } }, {}, async (agent, fake) => {
    await agent.reset({ gripper: 0 }, "push", { seed: 3 });
    const act = await agent.act({ gripper: 0.5 });
    assert.equal(wrong, malformed.length);
    assert.deepEqual([act.resumed, [...act.rows[0]]], [true, [malformed.length]]);
    const resets = fake.requests.filter((one) => one.op === "reset");
    for (const { obs, instruction, kwargs } of resets) assert.deepEqual([obs.gripper, instruction, kwargs], [0, "push", { seed: 3 }]);
  });
});

test("a text message ends the connection, too; without resume that is an error", async () => {
  const stream = (message, socket, number) => (message.op === "act" ? socket.send("hello") : answer(message, socket, number));
  await with_({ stream }, { resume: false }, async (agent) => {
    await agent.reset({});
    await thrown(agent.act({}), ConnectionLost, "connection_lost");
    await thrown(agent.act({}), ConnectionLost, "connection_lost");
    await agent.reset({});
  });
});

test("answers in another order, and to requests of nobody, are told apart", async () => {
  const stream = (message, socket, number) => {
    socket.send(reply({ request_id: "nobody" }, [7]));
    answer(message, socket, number);
  };
  await with_({ stream }, {}, async (agent) => {
    await agent.reset({});
    assert.deepEqual([...(await agent.act({})).rows[0]], [0]);
  });
});

test("an answer that never comes is given up, and the next act brings no step", async () => {
  let silent = true;
  const stream = (message, socket, number) => {
    if (message.op === "act" && silent) return (silent = false);
    answer(message, socket, number);
  };
  await with_({ stream }, {}, async (agent, fake) => {
    await agent.reset({});
    await thrown(agent.act({}, 100), DeadlineExceeded, "deadline_exceeded");
    await agent.act({});
    await agent.act({});
    assert.deepEqual(fake.requests.slice(0, 4).map((one) => one.step), [undefined, "100", undefined, "101"]);
    assert.ok(fake.requests[1].deadline_ms <= 100);
    assert.equal(fake.connections(), 1);
  });
});

for (const [code, kind, step] of [
  ["outcome_unknown", OutcomeUnknown, undefined],
  ["deadline_exceeded", DeadlineExceeded, "100"],
  ["overloaded", Overloaded, "100"],
  ["policy_failed", PolicyFailed, "100"],
  ["invented_later", VLAgentsError, "100"],
]) {
  test(`after ${code} the session goes on, with ${step === undefined ? "no step" : "the same step"}`, async () => {
    let failed = false;
    const stream = (message, socket, number) => {
      if (message.op !== "act" || failed) return answer(message, socket, number);
      failed = true;
      fail(message, socket, { code, detail: "no", retry_after_s: 0.25 });
    };
    await with_({ stream }, {}, async (agent, fake) => {
      await agent.reset({});
      await assert.rejects(agent.act({}), (error) => {
        assert.deepEqual([error.constructor, error.retryAfterS], [kind, 0.25]);
        assert.equal(error.code, code === "invented_later" ? "internal" : code);
        return true;
      });
      assert.equal((await agent.act({})).resumed, false);
      assert.equal(fake.requests[2].step, step);
    });
  });
}

test("a lost session is begun again with the last observations, and no act is sent to it twice", async () => {
  const stream = (message, socket, number) => {
    if (message.op === "act" && message.obs.gripper === 0.75 && number === 0) return socket.terminate();
    answer(message, socket, number);
  };
  await with_({ stream, metadata: { contract: { history: 2 } } }, {}, async (agent, fake) => {
    await agent.reset({ gripper: 0 }, "push");
    for (const gripper of [0.125, 0.25, 0.5]) assert.equal((await agent.act({ gripper })).resumed, false);
    assert.equal((await agent.act({ gripper: 0.75 })).resumed, true);
    assert.equal((await agent.act({ gripper: 1 })).resumed, false);
    const again = fake.requests.filter((one) => one.connection === 1);
    assert.deepEqual(again.map((one) => [one.op, one.obs.gripper]), [["reset", 0], ["act", 0.75], ["act", 1]]);
    assert.deepEqual(again[0].history.map((one) => one.gripper), [0.25, 0.5]);
    assert.deepEqual([again[0].session, again[0].instruction, again[0].step], [agent.session, "push", "103"]);
  });
});

test("an unknown session is begun again at the same connection", async () => {
  let known = false;
  const stream = (message, socket, number) => {
    if (message.op === "act" && !known) {
      known = true;
      return fail(message, socket, { code: "unknown_session", detail: "gone" });
    }
    answer(message, socket, number);
  };
  await with_({ stream }, {}, async (agent, fake) => {
    await agent.reset({});
    assert.equal((await agent.act({})).resumed, true);
    assert.equal(fake.connections(), 1);
  });
  known = false;
  await with_({ stream }, { resume: false }, async (agent) => {
    await agent.reset({});
    await thrown(agent.act({}), UnknownSession, "unknown_session");
  });
});

test("a replica that drains is left for a new connection, with the same session and step", async () => {
  const stream = (message, socket, number) => {
    if (message.op === "act" && number === 0) {
      return socket.send(reply({ request_id: message.request_id, step: "101", draining: true }, [0]));
    }
    answer(message, socket, number);
  };
  const closed = [];
  const sockets = (socket, number) => socket.on("close", () => closed.push(number));
  await with_({ stream, sockets }, {}, async (agent, fake) => {
    await agent.reset({});
    await agent.act({});
    const act = await agent.act({});
    assert.deepEqual([act.resumed, [...act.rows[0]]], [false, [1]]);
    const { op, session, step, connection } = fake.requests.at(-1);
    assert.deepEqual([op, session, step, connection], ["act", agent.session, "101", 1]);
    assert.deepEqual(fake.requests.map((one) => one.op), ["reset", "act", "act"]);
    while (closed.length === 0) await new Promise((resolve) => setTimeout(resolve, 5));
    assert.deepEqual(closed, [0]);
  });
});

test("over HTTP, a replica that drains is left by another x-session-id, with the same session and step", async () => {
  const sent = [];
  const http = (request, response) => {
    if (request.url === "/v1/metadata") return false;
    const parts = [];
    request.on("data", (part) => parts.push(part));
    request.on("end", () => {
      const { header } = unpack(new Uint8Array(Buffer.concat(parts)));
      sent.push({ route: request.headers["x-session-id"], session: header.session, step: header.step });
      const step = String(100 + sent.length);
      const node = { request_id: "", step, draining: sent.length === 2 };
      response.end(header.op === "act" ? reply(node, [sent.length]) : reply({ ...node, info: {} }));
    });
    return true;
  };
  await with_({ http }, { transport: "http" }, async (agent) => {
    await agent.reset({});
    await agent.act({});
    await agent.act({});
    const act = await agent.act({});
    assert.deepEqual([act.resumed, [...act.rows[0]]], [false, [4]]);
    assert.deepEqual(sent.map((one) => one.session), Array(4).fill(agent.session));
    assert.deepEqual(sent.map((one) => one.step), [undefined, "101", "102", "103"]);
    const [before, , after] = sent.map((one) => one.route);
    assert.deepEqual(sent.map((one) => one.route), [before, before, after, after]);
    assert.notEqual(before, after);
  });
});

test("a server that is gone for good ends the act with its deadline", async () => {
  const fake = await fakeServer();
  const agent = new RemoteAgent(fake.url, { timeoutMs: LONG_MS });
  await agent.reset({});
  await fake.close();
  await assert.rejects(agent.act({}, 700), PolicyUnavailable);
  await agent.close();
});

test("what is wrong on this side is said before it is sent", async () => {
  await with_({}, {}, async (agent, fake) => {
    await agent.reset({});
    const data = new Uint8Array(5);
    await thrown(agent.act({ cameras: { front: { height: 2, width: 3, data } } }), InvalidObservation, "invalid_observation");
    await thrown(agent.act({ info: { $: 1 } }), InvalidInput, "invalid_input");
    await thrown(agent.act({ info: { when: new Date() } }), InvalidInput, "invalid_input");
    const large = { height: 1, width: 6 * 2 ** 20, data: new Uint8Array(18 * 2 ** 20) };
    await thrown(agent.act({ cameras: { front: large } }), MessageTooLarge, "too_large");
    const both = Promise.allSettled([agent.act({}), agent.act({})]);
    assert.deepEqual((await both).map((one) => one.status), ["fulfilled", "rejected"]);
    assert.equal(fake.requests.filter((one) => one.op === "act").length, 1);
  });
});

test("over HTTP, an answer that is no frame is an error, and a lost answer begins the session again", async () => {
  const asked = [];
  const http = (request, response) => {
    if (request.url === "/v1/metadata") return false;
    asked.push(request.url);
    if (asked.length === 2) response.writeHead(500, { "content-type": "text/html" }).end("<html>");
    else if (asked.length === 3) response.writeHead(200).end(reply({ request_id: "", info: {} }));
    else if (asked.length === 4) response.writeHead(200).end(reply({ request_id: "" }, [1]));
    else if (asked.length === 5) response.writeHead(200).end("no frame");
    else response.writeHead(200).end(reply({ request_id: "", info: {} }));
    return true;
  };
  await with_({ http }, { transport: "http" }, async (agent) => {
    await agent.reset({});
    assert.equal((await agent.act({})).resumed, true);
    assert.deepEqual(asked, ["/v1/reset", "/v1/act", "/v1/reset", "/v1/act"]);
    await thrown(agent.act({}), InvalidInput, "malformed");
  });
});
