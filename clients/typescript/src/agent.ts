/** A policy on a server, as an object with `reset`, `act` and `close`. */

import { randomUUID } from "node:crypto";

import { type Connection, connect, isLate, type Metadata, type Server, Unreachable } from "./connection.js";
import {
  ConnectionLost, DeadlineExceeded, InvalidInput, NotReset, OutcomeUnknown, Overloaded, PolicyUnavailable,
  TooManyRequests, UnknownSession, VLAgentsError,
} from "./errors.js";
import type { Act, Obs, Priority, Reply, Request } from "./frames.js";
import type { Json, Value } from "./values.js";

export interface Options {
  /** An API key; by default that of the variable VLAGENTS_RAY_API_KEY, if it is set. */
  key?: string;
  /** The name of the session; by default a new one. */
  session?: string;
  /** The priority of the requests: robots, the default, go first. */
  priority?: Priority;
  /** For how long a call may take, milliseconds. */
  timeoutMs?: number;
  /** `websocket`, the default, or `http` where proxies allow nothing else. */
  transport?: "websocket" | "http";
  /** Whether a session that was lost is begun again; otherwise its error is thrown. */
  resume?: boolean;
  /** The robot's observations and actions. The server rejects a reset if its policy does not fit them. */
  contract?: Json;
}

/** An act as `RemoteAgent.act` returns it. */
export interface Answer extends Act {
  /** Milliseconds by stage, as the server measured them. */
  timing: Record<string, number>;
  /** Whether the session had to be begun again since the last act. */
  resumed: boolean;
}

interface Episode {
  first: Obs;
  instruction: string | undefined;
  kwargs: Record<string, Value>;
  since: Obs[]; // the last observations after the first, oldest first
}

const GRACE_MS = 250; // the answer to a deadline that passed is waited for so much longer
const CLOSE_MS = 1000;
const RETRY_MS = 100;
const MOST_HISTORY = 256;

/** A session of a policy: one robot or one environment. It makes one call at a time. */
export class RemoteAgent {
  readonly session: string;
  private readonly server: Server;
  private readonly options: Required<Pick<Options, "priority" | "timeoutMs" | "transport" | "resume">> & Options;
  private connection: Connection | undefined;
  private held: Connection | undefined; // the connection at which the session is
  private moving = false; // the replica asked for another connection
  private step: string | undefined;
  private episode: Episode | undefined;
  private busy = false;

  /** `url` begins with http, https, ws or wss; nothing is sent before the first call. */
  constructor(url: string, options: Options = {}) {
    const address = /^(http|ws)(s?):\/\/[^/?#]+[^?#]*$/.exec(url);
    if (address === null) {
      throw new InvalidInput(`url: expected a URL such as http://gpu-box:8000, got '${url}'`, "invalid_input");
    }
    const key = options.key ?? process.env["VLAGENTS_RAY_API_KEY"];
    this.server = {
      url: url.replace(/^(http|ws)(s?):/, "http$2:").replace(/\/+$/, ""),
      headers: key ? { authorization: `Bearer ${key}` } : {},
    };
    this.session = options.session ?? randomUUID();
    this.options = { priority: "robot", timeoutMs: 30000, transport: "websocket", resume: true, ...options };
  }

  /** The transport in use: `stream` is the replica's own port; undefined before the first call. */
  get transport(): string | undefined {
    return this.connection?.name;
  }

  /** Return the server's metadata: policy, checkpoint, contract. */
  async metadata(): Promise<Metadata> {
    return this.alone(async () => (await this.connected(Date.now() + this.options.timeoutMs)).metadata);
  }

  /** Begin an episode; returns what the policy says. A server that is not ready is waited for until `timeoutMs`. */
  async reset(obs: Obs, instruction?: string, kwargs: Record<string, Value> = {}): Promise<Record<string, Value>> {
    return this.alone(async () => {
      this.episode = undefined;
      const episode: Episode = { first: obs, instruction, kwargs, since: [] };
      const info = await this.begin(episode, Date.now() + this.options.timeoutMs);
      this.episode = episode;
      return info;
    });
  }

  /**
   * Return the policy's next action or chunk.
   *
   * A request is never sent twice to the same session. A session that was lost is begun again, with the first
   * observation and the last ones, before the observation is sent to it.
   */
  async act(obs: Obs, timeoutMs = this.options.timeoutMs): Promise<Answer> {
    return this.alone(async () => {
      const episode = this.episode;
      if (episode === undefined) throw new NotReset("act was called before reset; call reset with the first observation", "not_reset");
      const ends = Date.now() + timeoutMs;
      let resumed = false;
      try {
        for (;;) {
          try {
            await this.here(episode, ends, () => (resumed = true));
            const act = await this.once(obs, ends);
            return { ...act, resumed };
          } catch (error) {
            const lost = error instanceof ConnectionLost || error instanceof UnknownSession;
            const wait = lost ? RETRY_MS : error instanceof PolicyUnavailable ? waitOf(error, true) : undefined;
            if (wait === undefined || !this.options.resume || this.episode !== episode) throw error;
            if (lost) this.held = undefined; // the session ended: the next round begins it again
            if (Date.now() + wait >= ends) throw error;
            await pause(wait, ends);
          }
        }
      } finally {
        this.remember(episode, obs);
      }
    });
  }

  /** End the session and the connection; the agent can be used again after another reset. */
  async close(): Promise<void> {
    const { connection, held } = this;
    this.connection = this.held = this.episode = this.step = undefined;
    if (connection === undefined) return;
    try {
      if (held === connection && connection.isOpen) await connection.call({ op: "close", session: this.session }, CLOSE_MS);
    } catch {
      // the session ends with its connection, or when it has been idle for long
    } finally {
      connection.close();
    }
  }

  /** Begin the episode, at a server that may not be ready yet. */
  private async begin(episode: Episode, ends: number): Promise<Record<string, Value>> {
    let why: unknown; // it could not be begun so far
    for (;;) {
      try {
        const connection = await this.connected(ends);
        const { first, instruction, kwargs, since } = episode;
        const request: Request = { op: "reset", obs: first, instruction, kwargs, history: since, step: this.step };
        const reply = await this.send(connection, { ...request, contract: this.options.contract }, ends);
        this.held = connection;
        return reply.info ?? {};
      } catch (error) {
        const wait = waitOf(error, this.options.resume && this.episode === episode);
        if (!(error instanceof Unreachable)) why = error;
        else if (why !== undefined && ends - Date.now() < RETRY_MS) throw why; // not that time ran out in another try
        if (wait === undefined || Date.now() + wait >= ends) throw error;
        await pause(wait, ends);
      }
    }
  }

  /** Make sure that the session is at the connection: move it there, or begin it again. */
  private async here(episode: Episode, ends: number, resumed: () => void): Promise<void> {
    if (this.held !== undefined && this.moving) {
      this.held = await this.connected(ends); // with the same session and step: it moves there with its state
      return;
    }
    if (this.held?.isOpen) return;
    this.held = undefined;
    if (!this.options.resume) {
      throw new ConnectionLost("the connection was lost, and with it the session; reset it", "connection_lost");
    }
    await this.begin(episode, ends);
    resumed();
  }

  private async once(obs: Obs, ends: number): Promise<Act & { timing: Record<string, number> }> {
    const connection = this.held!;
    const reply = await this.send(connection, { op: "act", obs, step: this.step }, ends);
    if (reply.act === undefined) throw new VLAgentsError("act: the server's answer has no action");
    return { ...reply.act, timing: reply.timing };
  }

  private async send(connection: Connection, request: Request, ends: number): Promise<Reply> {
    const left = ends - Date.now();
    if (left <= 0) throw new DeadlineExceeded("the deadline passed before the request was sent", "deadline_exceeded");
    const { session, options } = this;
    let reply: Reply;
    try {
      reply = await connection.call({ ...request, session, priority: options.priority, deadline_ms: left }, left + GRACE_MS);
    } catch (error) {
      if (isLate(error)) this.step = undefined; // the session may have taken the step
      throw error;
    }
    if (reply.draining) this.moving = true;
    if (reply.error instanceof OutcomeUnknown) this.step = undefined; // it has, or is about to
    if (reply.error !== undefined) throw reply.error;
    this.step = reply.step;
    return reply;
  }

  /** Return an open connection, a new one if need be. */
  private async connected(ends: number): Promise<Connection> {
    const old = this.connection;
    if (old?.isOpen && !this.moving) return old;
    this.connection = await connect(this.server, this.options.transport, Math.max(1, ends - Date.now()));
    this.moving = false;
    old?.close();
    return this.connection;
  }

  private remember(episode: Episode, obs: Obs): void {
    const kept = Math.min(this.connection?.metadata.contract?.history ?? 0, MOST_HISTORY);
    episode.since = kept > 0 ? [...episode.since, obs].slice(-kept) : [];
  }

  private async alone<T>(call: () => Promise<T>): Promise<T> {
    if (this.busy) {
      throw new InvalidInput("another call of this agent is still running; await it, or create an agent for each robot", "invalid_input");
    }
    this.busy = true;
    try {
      return await call();
    } finally {
      this.busy = false;
    }
  }
}

/**
 * Return after how many milliseconds a request that was not executed, or a reset, is worth another try; undefined if it
 * is not. `begun`: also if the server cannot be reached, since it was there before.
 */
function waitOf(error: unknown, begun: boolean): number | undefined {
  if ((error instanceof ConnectionLost || error instanceof Unreachable) && !begun) return undefined;
  if (error instanceof PolicyUnavailable || error instanceof Overloaded || error instanceof TooManyRequests) {
    return error.retryAfterS === undefined ? RETRY_MS : error.retryAfterS * 1000;
  }
  return undefined;
}

function pause(ms: number, ends: number): Promise<void> {
  return new Promise((resolve) => setTimeout(resolve, Math.max(0, Math.min(ms, ends - Date.now()))));
}
