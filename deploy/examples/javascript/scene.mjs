// A scene becomes the model's inputs: tracks and lanes, sized by the model's contract.

/** Scene and contract as read from JSON -> {name: {type, data, dims}}. What is not seen stays 0 (False). */
export function pack(scene, contract) {
  if (Math.abs(scene.dt_s - contract.dt_s) > 1e-6) {
    throw new Error(`a step is ${scene.dt_s} s, the model wants ${contract.dt_s} s`);
  }
  const inputs = {};
  for (const [name, { type, shape }] of Object.entries(contract.inputs)) {
    const dims = [scene.targets.length, ...shape.slice(1)];
    const size = dims.reduce((a, b) => a * b, 1);
    inputs[name] = { type, dims, data: type === "bool" ? new Uint8Array(size) : new Float32Array(size) };
  }
  const { num_agents, history_steps, num_centerlines, centerline_points } = contract;
  scene.targets.forEach((target, b) => {
    nearest(scene.agents, target.agent).slice(0, num_agents).forEach((agent, n) => {
      const recent = agent.slice(-history_steps);
      const unseen = Array(history_steps - recent.length).fill(null);
      fill(inputs, "history", b * num_agents + n, [...unseen, ...recent]);
    });
    target.centerlines.slice(0, num_centerlines).forEach((line, q) => {
      fill(inputs, "centerlines", b * num_centerlines + q, resampled(line, centerline_points));
    });
    inputs.heading.data.set(target.heading, 2 * b);
  });
  return inputs;
}

/** All agents: the target, then the others by their distance from it now. */
function nearest(agents, target) {
  const [x, y] = agents[target].at(-1);
  const distance = (agent) => Math.hypot(agent.at(-1)[0] - x, agent.at(-1)[1] - y);
  return [...agents].sort((a, b) => distance(a) - distance(b));
}

/** `count` points at equal distances over the whole line; null where it is not known. */
function resampled(line, count) {
  return Array.from({ length: count }, (_, i) => {
    const at = (i * (line.length - 1)) / Math.max(count - 1, 1);
    const [a, b, share] = [line[Math.floor(at)], line[Math.ceil(at)], at % 1];
    return a && b && [a[0] * (1 - share) + b[0] * share, a[1] * (1 - share) + b[1] * share];
  });
}

/** Write places, and which of them are known, into row `row` of an input and its mask. */
function fill(inputs, name, row, places) {
  places.forEach((place, i) => {
    if (place) {
      inputs[name].data.set(place, 2 * (row * places.length + i));
      inputs[`${name}_valid`].data[row * places.length + i] = 1;
    }
  });
}

/** Target `b`'s trajectories, the most probable first: [{share, places: [[x, y], ...]}, ...]. */
export function modesOf(outputs, b) {
  const [, modes, steps] = outputs.trajectories.dims;
  return Array.from({ length: modes }, (_, k) => {
    const first = (b * modes + k) * steps;
    const place = (_, h) => Array.from(outputs.trajectories.data.subarray(2 * (first + h), 2 * (first + h + 1)));
    return { share: outputs.probabilities.data[b * modes + k], places: Array.from({ length: steps }, place) };
  });
}

/** How far the last position that is known was from the one predicted, metres. */
export function missedBy(places, future) {
  const last = Math.min(places.length, future.length) - 1;
  return Math.hypot(places[last][0] - future[last][0], places[last][1] - future[last][1]);
}
