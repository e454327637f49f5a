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

interface Plan {
  answer: Answer;
  number: number;
  at: number; // the tick of its row 0
}

/**
 * Calls the policy once for each chunk, and returns one row of it at each tick.
 *
 * Row i of a chunk belongs to the i-th tick after its observation, so the rows that passed while it was on its way are
 * left out.
 */
export class ChunkPlayer {
  private tick = 0;
  private number = 0;
  private plan: Plan | undefined;
  private asked: Promise<Plan> | undefined;

  constructor(private readonly agent: RemoteAgent, private readonly options: PlayerOptions = {}) {
    const { ahead = 0 } = options;
    if (!Number.isInteger(ahead) || ahead < 0) {
      throw new InvalidInput(`ahead: got ${ahead}, want a whole number of rows from 0 on`, "invalid_input");
    }
  }

  /** Begin an episode, after the chunk that may be on its way has come. */
  async reset(obs: Obs, instruction?: string, kwargs: Record<string, Value> = {}): Promise<Record<string, Value>> {
    await this.settled();
    this.tick = this.number = 0;
    this.plan = undefined;
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
    const { answer, number, at } = this.plan!;
    const row = this.tick - at;
    this.tick += 1;
    const action = answer.rows[row]!;
    return { action, row, chunk: number, ageTicks: row, done: answer.done && row === answer.rows.length - 1, answer };
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
    const [at, number] = [this.tick, this.number++];
    this.asked = this.agent.act(obs).then((answer) => ({ answer, number, at }));
    this.asked.catch(() => undefined); // it is thrown where the chunk is needed
  }

  private async take(): Promise<void> {
    const asked = this.asked;
    this.asked = undefined;
    this.plan = await asked!;
    if (this.plan.answer.rows.length === 0) throw new InvalidInput("act: got a chunk without rows", "invalid_action");
  }

  private async settled(): Promise<void> {
    await this.asked?.catch(() => undefined);
    this.asked = undefined;
  }
}
