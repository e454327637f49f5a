/** Connections to a server: the metadata, a WebSocket, or HTTP where nothing else passes. */

import { randomUUID } from "node:crypto";

import WebSocket from "ws";

import { ConnectionLost, DeadlineExceeded, errorOf, errorOfAnswer, PolicyUnavailable, VLAgentsError } from "./errors.js";
import { CONTENT_TYPE, decodeReplies, encodeRequests, PROTOCOL_VERSION, type Reply, type Request } from "./frames.js";
import { show } from "./values.js";

/** The document of `GET /v1/metadata`, of which a client needs these keys. */
export interface Metadata {
  protocol: number;
  policy?: string;
  contract?: { history?: number | null; chunk?: number | null; control_hz?: number | null; [key: string]: unknown } | null;
  stream?: { port: number; path: string } | null;
  [key: string]: unknown;
}

/** Sends requests, and returns the reply to each. */
export interface Connection {
  readonly name: "stream" | "websocket" | "http";
  readonly metadata: Metadata;
  /** Whether requests can be sent; a connection that was closed stays so. */
  readonly isOpen: boolean;
  /** Send a request; an answer with an error is returned, not thrown. */
  call(request: Request, timeoutMs: number): Promise<Reply>;
  close(): void;
}

/** The server's address, and what each request to it carries. */
export interface Server {
  /** With http or https, and without a slash at its end. */
  url: string;
  headers: Record<string, string>;
}

const OWN_PORT_MS = 2000; // then the path through the proxy is tried
const MESSAGE_BYTES = 16 * 2 ** 20;
const REPLY_BYTES = 128 * 2 ** 20;
const CLOSE_MS = 1000; // then a server that does not confirm the end is not waited for
const SILENT_MS = 5000; // a connection without a sign of the server for so long is given up

/** Connect within `timeoutMs`: to the replica's own port, else through the proxy. */
export async function connect(server: Server, transport: "websocket" | "http", timeoutMs: number): Promise<Connection> {
  const ends = Date.now() + timeoutMs;
  const metadata = await readMetadata(server, timeoutMs);
  if (transport === "http") return new HttpConnection(server, metadata);
  const address = new URL(server.url.replace(/^http/, "ws"));
  if (metadata.stream && address.protocol === "ws:") { // the port is not encrypted
    const own = `ws://${address.hostname}:${metadata.stream.port}${metadata.stream.path}`;
    try {
      return await openWebSocket(own, "stream", server, metadata, Math.min(OWN_PORT_MS, ends - Date.now()));
    } catch {
      // a firewall or a tunnel of one port: the proxy's port was reached
    }
  }
  const proxied = `${server.url.replace(/^http/, "ws")}/v1/stream`;
  return openWebSocket(proxied, "websocket", server, metadata, ends - Date.now());
}

/** Return the metadata of the replica with the least load. */
async function readMetadata(server: Server, timeoutMs: number): Promise<Metadata> {
  const headers = { ...server.headers, "x-boot-id": "server" };
  const answer = await ask(`${server.url}/v1/metadata`, { headers }, timeoutMs, false);
  const text = new TextDecoder().decode(answer.body);
  let metadata: unknown;
  try {
    metadata = JSON.parse(text);
  } catch {
    throw new VLAgentsError(`${server.url}/v1/metadata: expected JSON, got something else; is this a server of vlagents_ray?`);
  }
  const protocol = (metadata as Metadata | null)?.protocol;
  if (protocol !== PROTOCOL_VERSION) {
    throw new VLAgentsError(`protocol: the server speaks version ${show(protocol)}, this client ${PROTOCOL_VERSION}`);
  }
  return metadata as Metadata;
}

/**
 * Send an HTTP request; throws the error of an answer with a status of 400 or more.
 *
 * `sent` says whether a request whose answer is missing may have been executed.
 */
async function ask(
  url: string, options: RequestInit, timeoutMs: number, sent: boolean,
): Promise<{ type: string; body: Uint8Array }> {
  let response: Response;
  let body: Uint8Array;
  const signal = AbortSignal.timeout(Math.max(1, timeoutMs));
  try {
    response = await fetch(url, { ...options, signal, redirect: "error" });
    body = new Uint8Array(await response.arrayBuffer());
  } catch (error) {
    if (signal.aborted && sent) throw late(url, timeoutMs);
    const cause = error instanceof Error && error.cause !== undefined ? error.cause : error;
    const cure = String(cause).includes("certificate")
      ? "if a CA of your own has signed the server's, name its file in NODE_EXTRA_CA_CERTS"
      : "is the server running? One with TLS needs https://";
    const detail = `${url}: ${String(cause)}; ${cure}`;
    throw sent ? new ConnectionLost(detail, "connection_lost") : new Unreachable(detail, "unavailable");
  }
  const type = response.headers.get("content-type") ?? "";
  if (!response.ok) {
    throw errorOfAnswer(response.status, type, new TextDecoder().decode(body), response.headers.get("retry-after"));
  }
  return { type, body };
}

class HttpConnection implements Connection {
  readonly name = "http";
  readonly isOpen = true;
  private readonly route = randomUUID(); // its hash chooses the replica

  constructor(private readonly server: Server, readonly metadata: Metadata) {}

  async call(request: Request, timeoutMs: number): Promise<Reply> {
    const headers = {
      ...this.server.headers, "content-type": CONTENT_TYPE, accept: CONTENT_TYPE, "x-session-id": this.route,
    };
    const body = encodeRequests([request]);
    try {
      const url = `${this.server.url}/v1/${request.op}`;
      const answer = await ask(url, { method: "POST", headers, body: body as NonNullable<RequestInit["body"]> }, timeoutMs, true);
      return decodeReplies(answer.body)[0]!;
    } catch (error) {
      if (!(error instanceof VLAgentsError) || error instanceof ConnectionLost || isLate(error)) throw error;
      return { request_id: request.request_id ?? "", error, draining: false, timing: {} };
    }
  }

  close(): void {}
}

interface Waiting {
  resolve: (reply: Reply) => void;
  reject: (error: VLAgentsError) => void;
}

class WebSocketConnection implements Connection {
  private readonly waiting = new Map<string, Waiting>();
  private silentSince: number | undefined; // since when an answer is due, and nothing at all has come
  private reason: VLAgentsError | undefined; // why it is closed
  private count = 0;

  constructor(
    private readonly socket: WebSocket, readonly name: "stream" | "websocket", readonly metadata: Metadata,
  ) {
    socket.on("message", (data: Buffer, isBinary: boolean) => this.receive(data, isBinary));
    socket.on("pong", () => (this.silentSince = undefined));
    socket.on("error", (error) => this.end(`the connection broke: ${error.message}`));
    socket.on("close", (code, reason) => this.end(`the server closed the connection: ${code} ${reason.toString()}`.trim()));
  }

  get isOpen(): boolean {
    return this.reason === undefined && this.socket.readyState === WebSocket.OPEN;
  }

  call(request: Request, timeoutMs: number): Promise<Reply> {
    if (!this.isOpen) return Promise.reject(this.reason ?? new ConnectionLost("the connection is closed", "connection_lost"));
    const id = request.request_id ?? `${++this.count}`;
    const frame = encodeRequests([{ ...request, request_id: id }]);
    if (frame.length > MESSAGE_BYTES) {
      const detail = `message: expected at most ${MESSAGE_BYTES} bytes over a WebSocket, got ${frame.length}; send JPEG files`;
      return Promise.reject(errorOf("too_large", detail));
    }
    return new Promise((resolve, reject) => {
      this.silentSince ??= Date.now();
      const timer = setTimeout(() => {
        this.waiting.delete(id);
        const silentMs = Date.now() - (this.silentSince ?? Date.now());
        reject(late(this.name, timeoutMs));
        if (silentMs >= SILENT_MS) this.end(`no sign of the server for ${Math.round(silentMs / 1000)} s`);
        else if (this.isOpen) this.socket.ping();
      }, Math.max(1, timeoutMs));
      const settle = <T>(then: (value: T) => void) => (value: T) => {
        clearTimeout(timer);
        this.waiting.delete(id);
        then(value);
      };
      this.waiting.set(id, { resolve: settle(resolve), reject: settle(reject) });
      this.socket.send(frame);
    });
  }

  close(): void {
    this.reason ??= new ConnectionLost("closed by this client", "connection_lost");
    this.failAll(this.reason);
    this.socket.close();
    setTimeout(() => this.socket.terminate(), CLOSE_MS).unref();
  }

  private receive(data: Buffer, isBinary: boolean): void {
    this.silentSince = undefined;
    try {
      if (!isBinary) throw new VLAgentsError(`got a text message: ${data.toString().slice(0, 80)}`);
      for (const reply of decodeReplies(data)) {
        const waiting = this.waiting.get(reply.request_id);
        if (waiting !== undefined) waiting.resolve(reply);
        // An error without a request is about a message that could not be read, or about the connection itself.
        else if (reply.request_id === "" && reply.error !== undefined) this.failAll(reply.error);
      }
    } catch (error) {
      // Nothing else of this connection can be trusted to be what it seems.
      this.end(`the server sent what is no answer: ${error instanceof Error ? error.message : String(error)}`);
    }
  }

  private end(reason: string): void {
    if (this.reason !== undefined) return;
    this.reason = new ConnectionLost(reason, "connection_lost");
    this.failAll(this.reason);
    if (this.socket.readyState === WebSocket.OPEN) this.socket.terminate();
  }

  private failAll(error: VLAgentsError): void {
    for (const waiting of [...this.waiting.values()]) waiting.reject(error);
  }
}

function openWebSocket(
  url: string, name: "stream" | "websocket", server: Server, metadata: Metadata, timeoutMs: number,
): Promise<WebSocketConnection> {
  return new Promise((resolve, reject) => {
    const socket = new WebSocket(url, {
      headers: server.headers, perMessageDeflate: false, maxPayload: REPLY_BYTES,
      handshakeTimeout: Math.max(1, Math.round(timeoutMs)),
    });
    socket.once("open", () => {
      socket.removeAllListeners();
      resolve(new WebSocketConnection(socket, name, metadata));
    });
    socket.on("error", (error) => reject(new Unreachable(`${url}: ${error.message}`, "unavailable")));
    socket.once("unexpected-response", (_request, response) => {
      const pieces: Buffer[] = [];
      response.on("data", (piece: Buffer) => pieces.push(piece));
      response.on("end", () => {
        const body = Buffer.concat(pieces).toString();
        const { "content-type": type, "retry-after": wait } = response.headers;
        reject(errorOfAnswer(response.statusCode ?? 500, type ?? "", body, wait));
        socket.terminate();
      });
    });
  });
}

function late(where: string, timeoutMs: number): DeadlineExceeded {
  return new Unanswered(`${where}: no answer within ${Math.round(timeoutMs)} ms`, "deadline_exceeded");
}

/** There is no server at the address, or none that answers. */
export class Unreachable extends PolicyUnavailable {}

/** No answer came; only this side says so, and the server may have executed the request. */
class Unanswered extends DeadlineExceeded {}

export function isLate(error: unknown): boolean {
  return error instanceof Unanswered;
}
