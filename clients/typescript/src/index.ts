/** A client of vlagents_ray: `RemoteAgent` asks a policy for actions, `ChunkPlayer` plays its chunks. */

export { type Answer, type Options, RemoteAgent } from "./agent.js";
export type { Metadata } from "./connection.js";
export * from "./errors.js";
export {
  type Act, decodeReplies, encodeRequests, type Obs, pack, PROTOCOL_VERSION, type Priority, type Reply, type Request, unpack,
} from "./frames.js";
export { ChunkPlayer, type Played, type PlayerOptions, type Ticks } from "./player.js";
export { type DType, ImageFile, type Json, NdArray, type Pixels, type TypedArray, type Value, ValueReader } from "./values.js";
