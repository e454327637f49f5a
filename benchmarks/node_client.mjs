// The TypeScript client of a benchmark: node node_client.mjs CLIENT URL TRANSPORT FOLDER
// It obeys the line protocol of benchmarks/line_client.py: a number of calls in, the milliseconds of each out.

import { readFileSync } from "node:fs";
import { createInterface } from "node:readline";
import { pathToFileURL } from "node:url";

const [client, url, transport, folder] = process.argv.slice(2);
const { RemoteAgent } = await import(pathToFileURL(client).href);
const read = JSON.parse(readFileSync(`${folder}/obs.json`, "utf8"));
const cameras = Object.entries(read.cameras).map(([name, [height, width]]) => {
  return [name, { height, width, data: new Uint8Array(readFileSync(`${folder}/${name}`)) }];
});
const obs = { ...read, cameras: Object.fromEntries(cameras) };
const agent = new RemoteAgent(url, { transport });

async function measure(calls) {
  const taken = [];
  for (let call = 0; call < calls; call++) {
    const begun = performance.now();
    await agent.act(obs);
    taken.push(performance.now() - begun);
  }
  return taken;
}

await agent.reset(obs, "a task");
await measure(20);
console.log(JSON.stringify({ transport: agent.transport }));
for await (const line of createInterface({ input: process.stdin })) console.log(JSON.stringify(await measure(Number(line))));
await agent.close();
