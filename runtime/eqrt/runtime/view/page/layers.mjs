// Paths of one cycle, made once and drawn with every picture. Metres from the cycle's origin.

import { UNKNOWN } from "./update.mjs";

export const FADES = [ // probability from which, opacity
  [0.5, 0.95],
  [0.2, 0.6],
  [0.07, 0.34],
  [0.02, 0.18],
]; // less probable modes are not drawn
const EVERY = 3; // steps of a trajectory: 0.3 s, a curve looks the same

/** Paths of history, modes by fade, ghosts and ellipses. */
export function layerOf(cycle) {
  cycle.layer ??= {
    history: historyPath(cycle),
    modes: modePaths(cycle),
    ghosts: ghostPath(cycle),
    ellipses: ellipsePath(cycle),
  };
  return cycle.layer;
}

/** One mode of one agent, from where the agent is. */
export function addTrajectory(path, cycle, row, mode, every = EVERY) {
  const [, , modes, horizon] = cycle.shape;
  const step = cycle.step_m;
  const start = (row * modes + mode) * horizon * 2;
  const { position, trajectories } = cycle;
  if (position[2 * row] === UNKNOWN) return;
  path.moveTo(position[2 * row] * step, position[2 * row + 1] * step);
  for (let h = every - 1; h < horizon; h += every) {
    const x = trajectories[start + 2 * h];
    if (x === UNKNOWN) return;
    path.lineTo(x * step, trajectories[start + 2 * h + 1] * step);
  }
}

function historyPath(cycle) {
  const path = new Path2D();
  const [agents, steps] = cycle.shape;
  const step = cycle.step_m;
  for (let row = 0; row < agents; row += 1) {
    let down = false;
    for (let t = 0; t < steps; t += 1) {
      const at = 2 * (row * steps + t);
      const x = cycle.history[at];
      if (x === UNKNOWN) {
        down = false;
      } else if (down) {
        path.lineTo(x * step, cycle.history[at + 1] * step);
      } else {
        path.moveTo(x * step, cycle.history[at + 1] * step);
        down = true;
      }
    }
  }
  return path;
}

function modePaths(cycle) {
  const [agents, , modes] = cycle.shape;
  const paths = FADES.map(() => null);
  for (let row = 0; row < agents; row += 1) {
    for (let mode = 0; mode < modes; mode += 1) {
      const probability = cycle.agents.probabilities[row][mode];
      const fade = FADES.findIndex(([least]) => probability >= least);
      if (fade < 0) continue;
      paths[fade] ??= new Path2D();
      addTrajectory(paths[fade], cycle, row, mode);
    }
  }
  return paths;
}

/** Lines from where agents were predicted to be now to where they are. */
function ghostPath(cycle) {
  const path = new Path2D();
  const step = cycle.step_m;
  for (let row = 0; row < cycle.count; row += 1) {
    for (let back = 0; back < 3; back += 1) {
      const at = 2 * (3 * row + back);
      if (cycle.ghosts[at] === UNKNOWN) continue;
      path.moveTo(cycle.ghosts[at] * step, cycle.ghosts[at + 1] * step);
      path.lineTo(cycle.position[2 * row] * step, cycle.position[2 * row + 1] * step);
    }
  }
  return path;
}

/** Half of the most probable mode's distribution after 1, 2, 3 s, where the model tells it. */
function ellipsePath(cycle) {
  if (!cycle.agents.ellipses) return null;
  const path = new Path2D();
  const [, , modes, horizon] = cycle.shape;
  cycle.agents.ellipses.forEach((ellipses, row) => {
    ellipses.forEach(([long, short, angle], second) => {
      const h = Math.round((second + 1) / cycle.dt_s) - 1;
      const at = (row * modes * horizon + h) * 2;
      if (cycle.trajectories[at] === UNKNOWN) return;
      const [x, y] = [cycle.trajectories[at] * cycle.step_m, cycle.trajectories[at + 1] * cycle.step_m];
      path.moveTo(x + long * Math.cos(angle), y + long * Math.sin(angle));
      path.ellipse(x, y, long, short, angle, 0, 2 * Math.PI);
    });
  });
  return path;
}
