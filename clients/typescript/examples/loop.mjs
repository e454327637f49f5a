// A robot's loop: node examples/loop.mjs http://gpu-box:8000 [--ticks 100] [--hz 20]
// Replace `observe` and `apply` by your robot's own.

import { setTimeout as sleep } from "node:timers/promises";
import { parseArgs } from "node:util";

import { ChunkPlayer, RemoteAgent } from "vlagents-ray";

const options = { ticks: { type: "string", default: "100" }, hz: { type: "string", default: "20" } };
const { positionals, values } = parseArgs({ options, allowPositionals: true });
const [url = "http://127.0.0.1:8000"] = positionals;
const periodMs = 1000 / Number(values.hz);

/** What the robot sees: an image of its camera, or a JPEG file as `new ImageFile(bytes)`, and its joints in radians. */
function observe() {
  const front = { height: 224, width: 224, data: new Uint8Array(224 * 224 * 3) };
  return { cameras: { front }, gripper: 1, state: { joints: [0, 0, 0, 0, 0, 0, 0] } };
}

function apply(action) {
  void action; // send it to the robot
}

// A late answer is of no use to a robot: this agent has a short time limit, and does not wait for a server that starts.
const player = new ChunkPlayer(new RemoteAgent(url, { timeoutMs: 3000 }), { ahead: 2 });
let slowestMs = 0;
let tick = 0;
try {
  await player.reset(observe(), "push the cube to the goal");
  let next = performance.now();
  for (; tick < Number(values.ticks); tick++) {
    const begun = performance.now();
    const { action, done } = await player.act(observe());
    slowestMs = Math.max(slowestMs, performance.now() - begun);
    apply(action);
    if (done) break;
    next += periodMs;
    const missed = Math.max(0, Math.floor((performance.now() - next) / periodMs));
    player.countMissed(missed);
    next += missed * periodMs;
    await sleep(Math.max(0, next - performance.now()));
  }
  const inTime = (100 * (player.ticks.share ?? 1)).toFixed(2);
  console.log(`${tick} ticks, the slowest of ${slowestMs.toFixed(1)} ms; ${inTime} % in time`);
} finally {
  await player.close();
}
