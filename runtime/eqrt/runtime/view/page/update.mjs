// What the server sends about one cycle: a head as JSON, then places as int16 (see updates.py).

export const UNKNOWN = -32768;
const text = new TextDecoder();

/** The cycle in a binary message: the head's fields, and places in steps from `origin`. */
export function decodeUpdate(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const cycle = JSON.parse(text.decode(new Uint8Array(buffer, 4, length)));
  const [agents, steps, modes, horizon] = cycle.shape;
  let offset = Math.ceil((4 + length) / 4) * 4;
  const take = (count) => {
    const values = new Int16Array(buffer, offset, count);
    offset += 2 * count;
    return values;
  };
  cycle.position = take(agents * 2);
  cycle.history = take(agents * steps * 2);
  cycle.ghosts = take(agents * 3 * 2);
  cycle.trajectories = take(agents * modes * horizon * 2);
  cycle.count = agents;
  cycle.rows = new Map(cycle.agents.track_id.map((id, row) => [id, row]));
  cycle.layer = null; // what was made to draw it, by layers.mjs
  return cycle;
}

/** Whether anything tells how an agent moves: without, its paths stay where it is and say nothing. */
export function isPredicted(agents, row) { return agents.speed_mps[row] !== null; }

/** Lanes as arrays of metres from `origin`, with the box around each. */
export function decodeLanes(message) {
  const lanes = message.lanes.map((centimetres) => {
    const points = Float64Array.from(centimetres, (value) => value / 100);
    const box = [Infinity, Infinity, -Infinity, -Infinity];
    for (let i = 0; i < points.length; i += 2) {
      box[0] = Math.min(box[0], points[i]);
      box[1] = Math.min(box[1], points[i + 1]);
      box[2] = Math.max(box[2], points[i]);
      box[3] = Math.max(box[3], points[i + 1]);
    }
    return { points, box };
  });
  return { ...message, lanes };
}
