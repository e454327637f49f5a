/** Frames: a JSON header and binary blobs, each at a multiple of 8 bytes. */

import { errorFrom, type VLAgentsError } from "./errors.js";
import {
  type ImageFile, type Json, malformed, NdArray, type Pixels, show, type Value, ValueReader, ValueWriter,
} from "./values.js";

export const PROTOCOL_VERSION = 1;
export const CONTENT_TYPE = "application/x-vlagents-frame";
const PREFIX = 8;
const ALIGN = 8;

/** What a robot or a simulator sees at one moment. */
export interface Obs {
  /** Images by camera: raw RGB pixels, or a JPEG or PNG file. */
  cameras?: Record<string, Pixels | ImageFile>;
  /** From 0 (closed) to 1 (open). */
  gripper?: number | null;
  /** Parts of the proprioception by name, such as the joints in radians. */
  state?: Record<string, ArrayLike<number>>;
  info?: Record<string, Value>;
}

/** The priority of a request: robots go first. */
export type Priority = "robot" | "simulation";

export interface Request {
  op: "reset" | "act" | "close";
  obs?: Obs | undefined;
  instruction?: string | undefined;
  kwargs?: Record<string, Value> | undefined;
  contract?: Json | undefined;
  history?: Obs[] | undefined;
  session?: string | undefined;
  priority?: Priority | undefined;
  step?: string | undefined;
  request_id?: string | undefined;
  deadline_ms?: number | undefined;
}

/** An action, or a chunk of actions to be executed one after the other. */
export interface Act {
  /** One or more rows, each an action of D numbers. */
  rows: Float32Array[];
  /** The policy considers the task finished. */
  done: boolean;
  info: Record<string, Value>;
}

export interface Reply {
  request_id: string;
  act?: Act;
  info?: Record<string, Value>;
  error?: VLAgentsError;
  step?: string;
  draining: boolean;
  /** Milliseconds by stage. */
  timing: Record<string, number>;
}

/** Return the bytes of a frame. */
export function pack(header: { [key: string]: Json }, blobs: readonly Uint8Array[]): Uint8Array {
  const text = new TextEncoder().encode(JSON.stringify({ ...header, blobs: blobs.map((blob) => blob.length) }));
  const places: number[] = [];
  let size = PREFIX + text.length;
  for (const blob of blobs) {
    places.push((size = aligned(size)));
    size += blob.length;
  }
  const frame = new Uint8Array(size);
  frame.set([0x56, 0x4c, 0x41, PROTOCOL_VERSION]); // "VLA"
  new DataView(frame.buffer).setUint32(4, text.length, true);
  frame.set(text, PREFIX);
  blobs.forEach((blob, index) => frame.set(blob, places[index]));
  return frame;
}

/** Return the header of a frame, and views of its blobs. */
export function unpack(frame: Uint8Array): { header: Record<string, unknown>; blobs: Uint8Array[] } {
  if (frame.length < PREFIX) throw malformed(`frame: expected at least ${PREFIX} bytes, got ${frame.length}`);
  const magic = String.fromCharCode(...frame.subarray(0, 3));
  if (magic !== "VLA") throw malformed(`frame: expected "VLA" at its start, got ${show(magic)}`);
  if (frame[3] !== PROTOCOL_VERSION) {
    throw malformed(`frame: expected version ${PROTOCOL_VERSION} of the protocol, got ${frame[3]}; upgrade the older side`);
  }
  const length = new DataView(frame.buffer, frame.byteOffset).getUint32(4, true);
  let at = PREFIX + length;
  if (at > frame.length) throw malformed(`frame: ends inside its header (${frame.length} of ${at} bytes)`);
  const header = parse(frame.subarray(PREFIX, at));
  const lengths = header["blobs"];
  if (!Array.isArray(lengths) || !lengths.every((n) => Number.isInteger(n) && n >= 0)) {
    throw malformed("frame: the header has no list 'blobs' of lengths");
  }
  const blobs = (lengths as number[]).map((size) => {
    at = aligned(at);
    if (at + size > frame.length) throw malformed(`frame: ends inside a blob (${frame.length} of ${at + size} bytes)`);
    at += size;
    return frame.subarray(at - size, at);
  });
  if (at !== frame.length) throw malformed(`frame: ${frame.length - at} bytes follow its last blob`);
  return { header, blobs };
}

/** Return the frame of one request, or of several. */
export function encodeRequests(requests: readonly Request[]): Uint8Array {
  const writer = new ValueWriter();
  const nodes = requests.map((request) => requestNode(request, writer));
  return pack(nodes.length === 1 ? (nodes[0] as { [key: string]: Json }) : { requests: nodes }, writer.blobs);
}

/** Return the replies in a frame, at least one. */
export function decodeReplies(frame: Uint8Array): Reply[] {
  const { header, blobs } = unpack(frame);
  const nodes = header["replies"] ?? [header];
  if (!Array.isArray(nodes) || nodes.length === 0 || !nodes.every(isObject)) {
    throw malformed(`replies: expected a list of replies, got ${show(nodes)}`);
  }
  return nodes.map((node) => readReply(node, new ValueReader(blobs)));
}

function requestNode(request: Request, writer: ValueWriter): { [key: string]: Json } {
  const { obs, kwargs, history, ...rest } = request;
  const node: { [key: string]: Json } = {};
  for (const [key, value] of Object.entries(rest)) if (value !== undefined) node[key] = value;
  if (obs !== undefined) node["obs"] = obsNode(obs, writer);
  if (kwargs !== undefined && Object.keys(kwargs).length > 0) node["kwargs"] = writer.value(kwargs);
  if (history !== undefined && history.length > 0) node["history"] = history.map((one) => obsNode(one, writer));
  return node;
}

function obsNode(obs: Obs, writer: ValueWriter): Json {
  const node: { [key: string]: Json } = { cameras: {}, state: {} };
  const [cameras, state] = [node["cameras"], node["state"]] as { [key: string]: Json }[];
  for (const [name, image] of Object.entries(obs.cameras ?? {})) cameras![name] = writer.image(image, name);
  for (const [name, part] of Object.entries(obs.state ?? {})) {
    const values = part instanceof Float32Array ? part : Float32Array.from(part);
    state![name] = writer.array(new NdArray("<f4", [values.length], values));
  }
  if (obs.gripper !== undefined) node["gripper"] = obs.gripper;
  if (obs.info !== undefined) node["info"] = writer.value(obs.info);
  return node;
}

function readReply(node: Record<string, unknown>, reader: ValueReader): Reply {
  const reply: Reply = {
    request_id: String(node["request_id"] ?? ""),
    draining: node["draining"] === true,
    timing: isObject(node["timing"]) ? (node["timing"] as Record<string, number>) : {},
  };
  if (typeof node["step"] === "string") reply.step = node["step"];
  const { error, act } = node;
  if (error !== undefined && error !== null) {
    reply.error = errorFrom(error);
  } else if (act !== undefined && act !== null) {
    reply.act = readAct(act, reader);
  } else {
    reply.info = reader.value(node["info"] ?? {}) as Record<string, Value>;
  }
  return reply;
}

function readAct(act: unknown, reader: ValueReader): Act {
  if (!isObject(act) || typeof act["done"] !== "boolean" || !isObject(act["info"])) {
    throw malformed(`reply: expected action, done and info, got ${show(act)}`);
  }
  const action = reader.array(act["action"]);
  const { data, shape } = action;
  if (!(data instanceof Float32Array) || shape.length < 1 || shape.length > 2 || data.length === 0) {
    throw malformed(`action: expected <f4 of shape [D] or [H, D] without an axis of 0, got ${action.dtype} of shape [${shape}]`);
  }
  const width = shape[shape.length - 1] ?? 0;
  const height = shape.length === 2 ? (shape[0] ?? 0) : 1;
  const rows = Array.from({ length: height }, (_, row) => data.subarray(row * width, (row + 1) * width));
  return { rows, done: act["done"], info: reader.value(act["info"]) as Record<string, Value> };
}

function parse(text: Uint8Array): Record<string, unknown> {
  let header: unknown;
  try {
    header = JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(text));
  } catch (error) {
    throw malformed(`frame: the header is not JSON (${String(error)})`);
  }
  if (!isObject(header)) throw malformed("frame: the header is no object");
  return header;
}

function isObject(value: unknown): value is Record<string, unknown> {
  return typeof value === "object" && value !== null && !Array.isArray(value);
}

function aligned(at: number): number {
  return Math.ceil(at / ALIGN) * ALIGN;
}
