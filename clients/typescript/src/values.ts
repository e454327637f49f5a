/** Values of a message: JSON with references to binary blobs for what JSON does not have. */

import { InvalidInput, InvalidObservation, MalformedMessage } from "./errors.js";

export type DType =
  | "|b1" | "|i1" | "<i2" | "<i4" | "<i8" | "|u1" | "<u2" | "<u4" | "<u8" | "<f2" | "<f4" | "<f8";

const VIEWS = {
  "|b1": Uint8Array,
  "|i1": Int8Array,
  "<i2": Int16Array,
  "<i4": Int32Array,
  "<i8": BigInt64Array,
  "|u1": Uint8Array,
  "<u2": Uint16Array,
  "<u4": Uint32Array,
  "<u8": BigUint64Array,
  "<f2": Uint16Array, // the bits: Node.js has no type for half precision before 24
  "<f4": Float32Array,
  "<f8": Float64Array,
} as const;

export type TypedArray =
  | Int8Array | Int16Array | Int32Array | BigInt64Array | Uint8Array | Uint16Array | Uint32Array | BigUint64Array
  | Float32Array | Float64Array;

/** An array of numbers or booleans; its last axis is the fastest. */
export class NdArray {
  readonly dtype: DType;
  readonly shape: readonly number[];
  /** The values, row by row; of `<f2` the bits as integers. */
  readonly data: TypedArray;

  constructor(dtype: DType, shape: readonly number[], data: TypedArray) {
    if (!(data instanceof VIEWS[dtype]) || data.length !== shape.reduce((all, n) => all * n, 1)) {
      throw new InvalidInput(`array: expected the values of ${VIEWS[dtype].name} of shape [${shape}], got ${data.length} values`, "invalid_input");
    }
    this.dtype = dtype;
    this.shape = shape;
    this.data = data;
  }

  /** The values as plain numbers; integers over 2**53 are rounded. */
  numbers(): number[] {
    return Array.from(this.data as Iterable<number | bigint>, (value) =>
      this.dtype === "<f2" ? fromHalf(Number(value)) : Number(value));
  }
}

/** What `info` and `kwargs` may hold. A `Uint8Array` is bytes; other typed arrays are arrays of one axis. */
export type Value =
  | null | boolean | number | string | NdArray | ImageFile | Uint8Array | Float32Array | Float64Array | Int32Array
  | Value[] | { [key: string]: Value };

/** A JPEG or PNG file. */
export class ImageFile {
  constructor(readonly file: Uint8Array) {}
}

/** Raw pixels, RGB, row by row: `data` has height * width * 3 bytes. */
export interface Pixels {
  height: number;
  width: number;
  data: Uint8Array;
}

export type Json = null | boolean | number | string | Json[] | { [key: string]: Json };

/** Converts values to JSON and collects the blobs that they refer to. */
export class ValueWriter {
  readonly blobs: Uint8Array[] = [];

  array(value: NdArray): Json {
    if (littleEndian === false) throw new InvalidInput("arrays: this machine is big-endian, which is not supported");
    return { $: ["nd", this.blob(bytesOf(value.data)), value.dtype, [...value.shape]] };
  }

  image(value: Pixels | ImageFile, name: string): Json {
    if (value instanceof ImageFile) return { $: ["img", this.blob(value.file)] };
    const { height, width, data } = value;
    if (!(data instanceof Uint8Array) || data.length !== height * width * 3) {
      throw new InvalidObservation(
        `camera '${name}': expected ${height} x ${width} x 3 bytes of RGB, or new ImageFile(bytes), got ${data?.length}`,
        "invalid_observation",
      );
    }
    return { $: ["nd", this.blob(data), "|u1", [height, width, 3]] };
  }

  value(value: Value): Json {
    if (value === null || typeof value === "boolean" || typeof value === "string") return value;
    if (typeof value === "number") {
      if (Number.isFinite(value)) return value;
      return { $: ["float", Number.isNaN(value) ? "nan" : value > 0 ? "inf" : "-inf"] };
    }
    if (value instanceof NdArray) return this.array(value);
    if (value instanceof ImageFile) return this.image(value, "");
    if (value instanceof Uint8Array) return { $: ["bin", this.blob(value)] };
    if (value instanceof Float32Array) return this.array(new NdArray("<f4", [value.length], value));
    if (value instanceof Float64Array) return this.array(new NdArray("<f8", [value.length], value));
    if (value instanceof Int32Array) return this.array(new NdArray("<i4", [value.length], value));
    if (Array.isArray(value)) return value.map((item) => this.value(item));
    if (typeof value === "object" && Object.getPrototypeOf(value) === Object.prototype) {
      if (Object.hasOwn(value, "$")) throw new InvalidInput("info: expected no key '$', which the protocol uses, got it; rename the key", "invalid_input");
      const pairs = Object.entries(value).filter(([, item]) => item !== undefined);
      return Object.fromEntries(pairs.map(([key, item]) => [key, this.value(item)]));
    }
    throw new InvalidInput(`info: expected null, boolean, number, text, bytes, array, list or object, got ${String(value).slice(0, 40)}`, "invalid_input");
  }

  private blob(bytes: Uint8Array): number {
    return this.blobs.push(bytes) - 1;
  }
}

/** Most bytes to which the references of a message may lead, counted as often as they are named: each is a copy. */
const COPIED_BYTES = 128 * 2 ** 20;
const MAX_DEPTH = 64; // more would overflow the stack

/** Converts JSON and blobs back to values. */
export class ValueReader {
  private left = COPIED_BYTES;

  constructor(private readonly blobs: readonly Uint8Array[]) {}

  value(node: unknown, depth = 0): Value {
    if (node === null || typeof node !== "object") return node as Value;
    if (depth > MAX_DEPTH) throw malformed(`JSON: expected at most ${MAX_DEPTH} levels, got more`);
    if (Array.isArray(node)) return node.map((item) => this.value(item, depth + 1));
    if (Object.hasOwn(node, "$")) return this.reference(node as { $: unknown });
    const found: { [key: string]: Value } = {};
    for (const [key, item] of Object.entries(node)) {
      // `__proto__` is an ordinary key of a message
      Object.defineProperty(found, key, { value: this.value(item, depth + 1), enumerable: true, writable: true, configurable: true });
    }
    return found;
  }

  /** Return the array to which a node refers. */
  array(node: unknown): NdArray {
    const found = this.value(node);
    if (!(found instanceof NdArray)) throw malformed(`reference: expected an array, got ${show(node)}`);
    return found;
  }

  private reference(node: { $: unknown }): Value {
    const reference: unknown[] = Array.isArray(node.$) && Object.keys(node).length === 1 ? node.$ : [];
    const [kind, first, dtype, shape] = reference;
    if (kind === "float" && reference.length === 2) {
      if (first === "nan") return Number.NaN;
      if (first === "inf" || first === "-inf") return first === "inf" ? Infinity : -Infinity;
    }
    if (kind === "bin" && reference.length === 2) return new Uint8Array(this.blob(first));
    if (kind === "img" && reference.length === 2) return new ImageFile(new Uint8Array(this.blob(first)));
    if (kind === "nd" && reference.length === 4) return readArray(this.blob(first), dtype, shape);
    throw malformed(`reference: expected 'nd', 'img', 'bin' or 'float', got ${show(node)}`);
  }

  private blob(index: unknown): Uint8Array {
    const found = typeof index === "number" && Number.isInteger(index) ? this.blobs[index] : undefined;
    if (found === undefined) {
      throw malformed(`reference: expected a blob below ${this.blobs.length}, got ${show(index)}`);
    }
    this.left -= found.length;
    if (this.left < 0) throw malformed(`reference: the blobs named take more than ${COPIED_BYTES} bytes`);
    return found;
  }
}

function readArray(data: Uint8Array, dtype: unknown, shape: unknown): NdArray {
  if (littleEndian === false) throw malformed("arrays: this machine is big-endian, which is not supported");
  if (typeof dtype !== "string" || !Object.hasOwn(VIEWS, dtype)) {
    throw malformed(`array: expected a type such as '<f4' or '|u1', got type ${show(dtype)}`);
  }
  const View = VIEWS[dtype as DType];
  if (!Array.isArray(shape) || shape.length > 32 || !shape.every((n) => Number.isInteger(n) && n >= 0)) {
    throw malformed(`array: expected at most 32 non-negative integers, got shape ${show(shape)}`);
  }
  const sizes = shape as number[];
  if (sizes.reduce((all, n) => all * n, View.BYTES_PER_ELEMENT) !== data.length) {
    throw malformed(`array: expected the bytes of [${sizes}] ${dtype}, got ${data.length}`);
  }
  const copy = new Uint8Array(data); // typed arrays must begin at a multiple of their size; `slice` of a Buffer copies nothing
  return new NdArray(dtype as DType, sizes, new View(copy.buffer, 0, data.length / View.BYTES_PER_ELEMENT));
}

function bytesOf(data: TypedArray): Uint8Array {
  return new Uint8Array(data.buffer, data.byteOffset, data.byteLength);
}

function fromHalf(bits: number): number {
  const sign = bits & 0x8000 ? -1 : 1;
  const exponent = (bits >> 10) & 0x1f;
  const fraction = bits & 0x3ff;
  if (exponent === 0) return sign * fraction * 2 ** -24;
  if (exponent === 31) return fraction ? Number.NaN : sign * Infinity;
  return sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}

export function malformed(detail: string): MalformedMessage {
  return new MalformedMessage(detail, "malformed");
}

export function show(value: unknown): string {
  return (JSON.stringify(value) ?? String(value)).slice(0, 80);
}

const littleEndian = new Uint8Array(new Uint16Array([1]).buffer)[0] === 1;
