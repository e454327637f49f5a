/** Plays chunks of actions open loop, while the next one is on its way. */

import type { Answer, RemoteAgent } from "./agent.js";
import { InvalidInput } from "./errors.js";
import type { Obs } from "./frames.js";
import type { Value } from "./values.js";

export interface PlayerOptions {
  /**
   * How many rows before the end of a chunk the next one is asked for: the ticks that an answer takes, rounded up. With 0,
   * the default, the loop waits for each chunk.
   */
  ahead?: number;
}

/** The action of one tick. */
export interface Played {
  action: Float32Array;
  /** Its row in its chunk. */
  row: number;
  /** The number of its chunk since the reset, from 0. */
  chunk: number;
  /** Ticks since the observation of which the chunk was computed. */
  ageTicks: number;
  /** The last row of a chunk with which the policy considers the task finished. */
  done: boolean;
  /** What came with the chunk. */
  answer: Answer;
}

/** The ticks of an episode at which the policy was to act. */
export interface Ticks {
  all: number;
  /** Those of them for which no answer had a row. */
  starved: number;
  /** The share of the ticks in time, from 0 to 1; undefined without ticks. */
  share: number | undefined;
}

interface Plan {
  answer: Answer;
  number: number;
  at: number; // the tick of its row 0
  seenAt: number; // when its observation was passed to `act`, ms of `performance.now`
}

/**
 * Calls the policy once for each chunk, and returns one row of it at each tick.
 *
 * Row i of a chunk belongs to the i-th tick after its observation, so the rows that passed while it was on its way are
 * left out. Each request reports the ticks since the last one, and the age of the last action, to the server.
 */
export class ChunkPlayer {
  private tick = 0;
  private number = 0;
  private plan: Plan | undefined;
  private asked: Promise<Plan> | undefined;
  private all = 0;
  private starved = 0;
  private reported = { all: 0, starved: 0 }; // by earlier requests
  private executedAgeMs: number | undefined; // of the last action since the last request

  constructor(private readonly agent: RemoteAgent, private readonly options: PlayerOptions = {}) {
    const { ahead = 0 } = options;
    if (!Number.isInteger(ahead) || ahead < 0) {
      throw new InvalidInput(`ahead: expected a whole number of rows, 0 or more, got ${ahead}`, "invalid_input");
    }
  }

  /** Begin an episode, after the chunk that may be on its way has come. */
  async reset(obs: Obs, instruction?: string, kwargs: Record<string, Value> = {}): Promise<Record<string, Value>> {
    await this.settled();
    this.tick = this.number = this.all = this.starved = 0;
    this.reported = { all: 0, starved: 0 };
    this.plan = this.executedAgeMs = undefined;
    return this.agent.reset(obs, instruction, kwargs);
  }

  /** Return the action of this tick; call it once a tick. It waits only where no row is left. */
  async act(obs: Obs): Promise<Played> {
    if (this.left() === 0) {
      if (this.asked === undefined) this.ask(obs);
      await this.take();
      if (this.left() === 0) {
        this.ask(obs); // the chunk came too late to have a row for this tick
        await this.take();
      }
    }
    if (this.asked === undefined && this.left() <= (this.options.ahead ?? 0)) this.ask(obs);
    const { answer, number, at, seenAt } = this.plan!;
    const row = this.tick - at;
    this.tick += 1;
    this.all += 1;
    this.executedAgeMs = performance.now() - seenAt;
    const action = answer.rows[row]!;
    return { action, row, chunk: number, ageTicks: row, done: answer.done && row === answer.rows.length - 1, answer };
  }

  /** Count ticks that passed while your loop was busy, such as with waiting in `act`: no action came in time for them. */
  countMissed(ticks: number): void {
    this.all += ticks;
    this.starved += ticks;
  }

  /** The ticks of the episode so far: the calls of `act`, and those of `countMissed`. */
  get ticks(): Ticks {
    const { all, starved } = this;
    return { all, starved, share: all === 0 ? undefined : 1 - starved / all };
  }

  /** End the session. */
  async close(): Promise<void> {
    await this.settled();
    await this.agent.close();
  }

  /** Rows of the plan from this tick on. */
  private left(): number {
    return this.plan === undefined ? 0 : Math.max(0, this.plan.at + this.plan.answer.rows.length - this.tick);
  }

  private ask(obs: Obs): void {
    const [at, number, seenAt] = [this.tick, this.number++, performance.now()];
    const request = { ...obs, info: { ...obs.info, ...this.requestInfo() } };
    this.asked = this.agent.act(request).then((answer) => ({ answer, number, at, seenAt }));
    this.asked.catch(() => undefined); // it is thrown where the chunk is needed
  }

  /** What a request tells the server of the ticks since the last one (docs/protocol.md). */
  private requestInfo(): Record<string, Value> {
    const { all, starved, reported, executedAgeMs } = this;
    this.reported = { all, starved };
    this.executedAgeMs = undefined;
    const info = { ticks: [all - reported.all, starved - reported.starved] };
    return executedAgeMs === undefined ? info : { ...info, executed_age_ms: executedAgeMs };
  }

  private async take(): Promise<void> {
    const asked = this.asked;
    this.asked = undefined;
    this.plan = await asked!;
    if (this.plan.answer.rows.length === 0) throw new InvalidInput("act: expected a chunk with rows, got an empty one", "invalid_action");
  }

  private async settled(): Promise<void> {
    await this.asked?.catch(() => undefined);
    this.asked = undefined;
  }
}
