// The golden files of the protocol: what they say is read from their bytes, and written so that it can be read.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";

import { decodeReplies, encodeRequests, ImageFile, MalformedMessage, NdArray, unpack, ValueReader } from "vlagents-ray";

const folder = new URL("../../golden/", import.meta.url);
const bytes = (file) => new Uint8Array(readFileSync(new URL(file, folder)));
const json = (file) => JSON.parse(readFileSync(new URL(file, folder), "utf8"));
const base64 = (data) => Buffer.from(data).toString("base64");
const index = json("index.json");
const of = (kind) => index.filter((one) => one.kind === kind);
const VIEWS = { "|i1": Int8Array, "<i2": Int16Array, "<i4": Int32Array, "<i8": BigInt64Array, "<u2": Uint16Array,
  "<u4": Uint32Array, "<u8": BigUint64Array, "<f2": Uint16Array, "<f4": Float32Array, "<f8": Float64Array };

/** A value as the golden files write it. */
function meaning(value) {
  if (value instanceof NdArray) {
    const values = value.numbers().map((one) => meaning(value.dtype === "|b1" ? one === 1 : one));
    return { $: "array", dtype: value.dtype, shape: [...value.shape], values };
  }
  if (value instanceof ImageFile) return { $: "image", base64: base64(value.file) };
  if (value instanceof Uint8Array) return { $: "bytes", base64: base64(value) };
  if (typeof value === "number" && !Number.isFinite(value)) {
    return { $: "float", value: Number.isNaN(value) ? "nan" : value > 0 ? "inf" : "-inf" };
  }
  if (Array.isArray(value)) return value.map(meaning);
  if (value === null || typeof value !== "object") return value;
  return Object.fromEntries(Object.entries(value).map(([key, item]) => [key, meaning(item)]));
}

/** The value of which `meaning` makes its argument. */
function valueOf(node) {
  if (Array.isArray(node)) return node.map(valueOf);
  if (node === null || typeof node !== "object") return node;
  if (node.$ === "bytes") return new Uint8Array(Buffer.from(node.base64, "base64"));
  if (node.$ === "image") return new ImageFile(new Uint8Array(Buffer.from(node.base64, "base64")));
  if (node.$ === "float") return { nan: NaN, inf: Infinity, "-inf": -Infinity }[node.value];
  if (node.$ === "array") {
    const View = VIEWS[node.dtype] ?? Uint8Array;
    const halves = { 0: 0, 1: 0x3c00 };
    const convert = { "<i8": BigInt, "<u8": BigInt, "<f2": (one) => halves[one] }[node.dtype] ?? Number;
    return new NdArray(node.dtype, node.shape, View.from(node.values.map((one) => convert(valueOf(one)))));
  }
  return Object.fromEntries(Object.entries(node).map(([key, item]) => [key, valueOf(item)]));
}

function observation(node) {
  const cameras = Object.entries(node.cameras).map(([name, image]) => {
    if (image.$ === "image") return [name, valueOf(image)];
    const [height, width] = image.shape;
    return [name, { height, width, data: Uint8Array.from(image.values) }];
  });
  const state = Object.entries(node.state).map(([name, part]) => [name, part.values]);
  return { ...node, cameras: Object.fromEntries(cameras), state: Object.fromEntries(state), info: valueOf(node.info) };
}

function request(node) {
  const found = { ...node };
  if (node.obs !== undefined) found.obs = observation(node.obs);
  if (node.history !== undefined) found.history = node.history.map(observation);
  if (node.kwargs !== undefined) found.kwargs = valueOf(node.kwargs);
  return found;
}

/** What a frame of requests says, by this client's reader of values. */
function said(frame) {
  const { header, blobs } = unpack(frame);
  const { blobs: _, ...rest } = meaning(new ValueReader(blobs).value(header));
  return (rest.requests ?? [rest]).map((node) => ({ ...node, ...(node.obs && { obs: whole(node.obs) }) }));
}

/** An observation in which a list of numbers and an image file look as the golden files write them. */
function whole(obs) {
  const state = Object.entries(obs.state).map(([name, part]) => {
    return [name, Array.isArray(part) ? { $: "array", dtype: "<f4", shape: [part.length], values: part } : part];
  });
  return { info: {}, ...obs, state: Object.fromEntries(state) };
}

const known = (node) => JSON.parse(JSON.stringify(node, (key, value) => {
  if (value?.$ !== "image") return value;
  return { $: "image", base64: value.base64 };
}));

for (const { file, meaning: means, says } of of("requests")) {
  test(`${file}: ${says}`, () => {
    const want = known(json(means));
    assert.deepEqual(said(bytes(file)), want);
    assert.deepEqual(said(encodeRequests(json(means).map(request))), want);
  });
}

for (const { file, meaning: means, says } of of("replies")) {
  test(`${file}: ${says}`, () => {
    const replies = decodeReplies(bytes(file));
    const wanted = json(means);
    assert.equal(replies.length, wanted.length);
    replies.forEach((reply, number) => {
      const want = wanted[number];
      assert.equal(reply.request_id, want.request_id);
      assert.equal(reply.step, want.step);
      assert.equal(reply.draining, want.draining ?? false);
      assert.deepEqual(reply.timing, want.timing ?? {});
      if (want.error !== undefined) {
        const code = want.error.code === "melted" ? "internal" : want.error.code;
        assert.deepEqual([reply.error.code, reply.error.message], [code, want.error.detail]);
        assert.equal(reply.error.retryAfterS, want.error.retry_after_s);
      } else if (want.act !== undefined) {
        const { shape, values } = want.act.action;
        assert.equal(reply.act.rows.length, shape.length === 2 ? shape[0] : 1);
        assert.deepEqual(reply.act.rows.flatMap((row) => [...row]), values);
        assert.equal(reply.act.done, want.act.done);
        assert.deepEqual(meaning(reply.act.info), want.act.info);
      } else {
        assert.deepEqual(meaning(reply.info), want.info);
      }
    });
  });
}

for (const { file, says } of of("malformed")) {
  test(`${file} is refused: ${says}`, () => {
    assert.throws(() => decodeReplies(bytes(file)), (error) => error instanceof MalformedMessage && error.code === "malformed");
  });
}

test("every beginning of a frame is refused", () => {
  const frame = bytes("frames/act_reply.bin");
  for (let end = 0; end < frame.length; end++) {
    assert.throws(() => decodeReplies(frame.subarray(0, end)), MalformedMessage);
  }
});

test("a frame may begin anywhere in memory", () => {
  const frame = bytes("frames/act_reply.bin");
  for (let at = 0; at < 8; at++) {
    const memory = new Uint8Array(frame.length + at);
    memory.set(frame, at);
    const want = decodeReplies(frame);
    assert.deepEqual(decodeReplies(memory.subarray(at)), want);
    assert.deepEqual(decodeReplies(Buffer.from(memory.buffer, at)), want);
  }
});

test("the key __proto__ is one like any other", () => {
  const found = new ValueReader([]).value(JSON.parse('{"__proto__": {"polluted": 1}}'));
  assert.equal(Object.getPrototypeOf(found), Object.prototype);
  assert.equal({}.polluted, undefined);
  assert.deepEqual(Object.keys(found), ["__proto__"]);
});
