// The bird's-eye view: lanes, agents, where they came from, where they are predicted to go.

import { FADES, addTrajectory, layerOf } from "./layers.mjs";
import { Labels } from "./labels.mjs";
import { UNKNOWN, isPredicted } from "./update.mjs";

const LANE_M = 3.3;
const SIZES = { // metres, where the sensor tells none: drawn dashed
  car: [4.6, 1.8], truck: [9, 2.5], motorcycle: [2.2, 0.8], bicycle: [1.8, 0.6],
  pedestrian: [0.6, 0.6], animal: [1, 0.5],
};
const DOT_M = 1; // radius of an object of which neither size nor class is known
const EGO_M = [4.6, 1.9];
const LEAST_PX = 5; // nobody is drawn smaller
const LANES_KEPT = 30; // as far as 150 s at 120 km/h: of a file, so much is at hand
const TURNED_BACK = Math.PI;

/** Draws moments on a canvas. */
export class Scene {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.labels = new Labels();
    this.laneSets = []; // around places that were driven through, the newest last
    this.ghosts = true;
    this.agents = []; // of the last picture: { id, row, x, y, px, py }
    this.readColours();
  }

  /** Takes the colours of the style sheet, which change with the light. */
  readColours() {
    const style = getComputedStyle(document.documentElement);
    this.colours = new Proxy({}, {
      get: (cache, name) => (cache[name] ??= style.getPropertyValue(`--${name}`).trim()),
    });
  }

  /** Fits the canvas to its place on the page. */
  resize(camera) {
    this.ratio = Math.min(2, devicePixelRatio || 1);
    const { clientWidth, clientHeight } = this.canvas;
    this.canvas.width = Math.round(clientWidth * this.ratio);
    this.canvas.height = Math.round(clientHeight * this.ratio);
    camera.resize(clientWidth, clientHeight);
  }

  /** Takes the lanes around another place, of this map or another one. */
  addLanes(lanes) {
    const others = this.laneSets.filter(({ number }) => number !== lanes.number);
    this.laneSets = [...others, lanes].slice(-LANES_KEPT);
  }

  /** The lanes around where a cycle was, or null. */
  lanesAt(cycle) {
    if (!cycle.on_map) return null;
    return this.laneSets.find(({ number }) => number === cycle.lanes) ?? null;
  }

  /** Draws one moment; `selected` is a track id or null. `past(s)` is the cycle s seconds before. */
  draw(moment, camera, selected, past) {
    const { context, colours } = this;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = colours.ground;
    context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    this.agents = [];
    this.lanesDrawn = 0;
    if (!moment) return;
    const { cycle } = moment;
    this.#place(moment, camera);
    const lanes = this.lanesAt(cycle);
    if (lanes) this.#drawLanes(lanes, camera);
    context.setTransform(...camera.transform(...cycle.origin, this.ratio));
    this.#drawLines(cycle, camera.scale, selected);
    const row = cycle.rows.get(selected);
    if (row !== undefined) this.#drawSelected(cycle, row, camera.scale, past);
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    if (this.ghosts) this.#drawGhosts(cycle, camera);
    this.#drawAgents(cycle, camera, selected);
    this.#drawEgo(moment, camera);
    this.labels.draw(context, this.agents, { cycle, camera, colours, selected, keepFree: this.ego });
    this.#drawScale(camera, cycle.on_map);
  }

  /** The agent at a pixel, or null. */
  hit(px, py) {
    let [best, least] = [null, 22];
    for (const agent of this.agents) {
      const away = Math.hypot(agent.px - px, agent.py - py);
      if (away < least) [best, least] = [agent, away];
    }
    return best;
  }

  /** Everybody's place now: measured, or on the way from one measurement to the next. */
  #place({ cycle, next, part }, camera) {
    const { agents, position, origin, step_m: step } = cycle;
    for (let row = 0; row < cycle.count; row += 1) {
      if (position[2 * row] === UNKNOWN) continue;
      const id = agents.track_id[row];
      let x = origin[0] + position[2 * row] * step;
      let y = origin[1] + position[2 * row + 1] * step;
      let heading = agents.heading_rad[row];
      const later = next?.rows.get(id);
      if (later !== undefined && next.position[2 * later] !== UNKNOWN) {
        x += part * (next.origin[0] + next.position[2 * later] * step - x);
        y += part * (next.origin[1] + next.position[2 * later + 1] * step - y);
        heading = between(heading, next.agents.heading_rad[later], part);
      }
      const [px, py] = camera.pixels(x, y);
      const agent = { id, row, x, y, px, py, heading };
      this.#measure(agent, agents, camera);
      this.agents.push(agent);
    }
  }

  /** An agent's size on the screen: of its box, or of a dot where little is known. */
  #measure(agent, columns, camera) {
    const usual = SIZES[columns.kind[agent.row]];
    const length = columns.length_m[agent.row] ?? usual?.[0];
    const width = columns.width_m[agent.row] ?? usual?.[1];
    agent.dot = length === undefined || width === undefined || agent.heading === null;
    if (agent.dot) {
      agent.long = agent.wide = agent.halfX = agent.halfY = Math.max(LEAST_PX / 2, DOT_M * camera.scale);
      return;
    }
    agent.long = Math.max(LEAST_PX * 1.6, length * camera.scale) / 2;
    agent.wide = Math.max(LEAST_PX, width * camera.scale) / 2;
    const angle = agent.heading + camera.turn;
    const [cos, sin] = [Math.abs(Math.cos(angle)), Math.abs(Math.sin(angle))];
    agent.halfX = cos * agent.long + sin * agent.wide;
    agent.halfY = sin * agent.long + cos * agent.wide;
  }

  /** How far the ring around a selected agent is from its middle. */
  #ring(agent) { return Math.max(agent.long, 9) + 5; }

  #drawLanes(lanes, camera) {
    const { context, colours } = this;
    const [x0, y0, x1, y1] = camera.box;
    const [ox, oy] = lanes.origin;
    const path = new Path2D();
    for (const { points, box } of lanes.lanes) {
      if (box[0] + ox > x1 || box[2] + ox < x0 || box[1] + oy > y1 || box[3] + oy < y0) continue;
      this.lanesDrawn += 1;
      path.moveTo(points[0], points[1]);
      for (let i = 2; i < points.length; i += 2) path.lineTo(points[i], points[i + 1]);
    }
    context.setTransform(...camera.transform(ox, oy, this.ratio));
    context.lineJoin = context.lineCap = "round"; // no gaps where one lane goes on in another
    context.strokeStyle = colours.lane;
    context.lineWidth = LANE_M;
    context.stroke(path);
    context.strokeStyle = colours["lane-middle"];
    context.lineWidth = 1 / camera.scale;
    context.stroke(path);
  }

  #drawLines(cycle, scale, selected) {
    const { context, colours } = this;
    const layer = layerOf(cycle);
    const faded = selected === null || !cycle.rows.has(selected) ? 1 : 0.55;
    context.lineCap = "butt";
    context.lineJoin = "bevel";
    context.strokeStyle = colours.past;
    context.globalAlpha = 0.6 * faded;
    context.lineWidth = 1.3 / scale;
    context.stroke(layer.history);
    if (layer.ellipses) {
      context.fillStyle = colours.ahead;
      context.globalAlpha = 0.1 * faded;
      context.fill(layer.ellipses);
    }
    context.strokeStyle = colours.ahead;
    context.lineWidth = 2 / scale;
    layer.modes.forEach((path, fade) => {
      if (!path) return;
      context.globalAlpha = FADES[fade][1] * faded;
      context.stroke(path);
    });
    if (this.ghosts) {
      context.globalAlpha = 0.7 * faded;
      context.strokeStyle = colours.ghost;
      context.lineWidth = 1 / scale;
      context.stroke(layer.ghosts);
    }
    context.globalAlpha = 1;
  }

  /** What one agent alone gets: all its modes, constant velocity, its past predictions. */
  #drawSelected(cycle, row, scale, past) {
    const { context, colours } = this;
    const [, , modes] = cycle.shape;
    context.lineWidth = 3 / scale;
    context.strokeStyle = colours.ahead;
    for (let mode = modes - 1; mode >= 0; mode -= 1) {
      const path = new Path2D();
      addTrajectory(path, cycle, row, mode, 1);
      context.globalAlpha = 0.25 + 0.75 * cycle.agents.probabilities[row][mode];
      context.stroke(path);
    }
    context.globalAlpha = 1;
    this.#drawUsualError(cycle, row, scale);
    this.#drawConstantVelocity(cycle, row, scale);
    if (!this.ghosts) return;
    context.strokeStyle = colours.ghost;
    context.lineWidth = 1.5 / scale;
    context.setLineDash([5 / scale, 3 / scale]);
    for (const seconds of [1, 2, 3]) {
      const then = past(seconds);
      const before = then?.rows.get(cycle.agents.track_id[row]);
      if (before === undefined || then.stream !== cycle.stream) continue;
      if (Math.abs(cycle.time_s - then.time_s - seconds) > 0.2) continue; // there was a gap
      const path = new Path2D();
      addTrajectory(path, then, before, 0, 1);
      const moved = new Path2D();
      const shift = [then.origin[0] - cycle.origin[0], then.origin[1] - cycle.origin[1]];
      moved.addPath(path, new DOMMatrix([1, 0, 0, 1, ...shift]));
      context.stroke(moved);
    }
    context.setLineDash([]);
  }

  /** Circles as wide as predictions were wrong in the last minute, after 1, 2 and 3 s. */
  #drawUsualError(cycle, row, scale) {
    if (!cycle.score || cycle.agents.ellipses || !isPredicted(cycle.agents, row)) return;
    const { context, colours } = this;
    const [, , modes, horizon] = cycle.shape;
    context.strokeStyle = colours.ahead;
    context.lineWidth = 1.2 / scale;
    context.setLineDash([2 / scale, 3 / scale]);
    for (const seconds of [1, 2, 3]) {
      const radius = cycle.score.eqrt[`fde_${seconds}s`];
      const h = Math.round(seconds / cycle.dt_s) - 1;
      const at = 2 * (row * modes * horizon + h);
      if (!radius || h >= horizon || cycle.trajectories[at] === UNKNOWN) continue;
      const [x, y] = [cycle.trajectories[at], cycle.trajectories[at + 1]];
      context.beginPath();
      context.arc(x * cycle.step_m, y * cycle.step_m, radius, 0, 2 * Math.PI);
      context.stroke();
    }
    context.setLineDash([]);
  }

  #drawConstantVelocity(cycle, row, scale) {
    const [, steps, , horizon] = cycle.shape;
    const back = Math.round(0.5 / cycle.dt_s);
    const at = 2 * (row * steps + steps - 1 - back);
    if (steps <= back || cycle.history[at] === UNKNOWN) return;
    const { context, colours } = this;
    const place = (values, i) => [values[i] * cycle.step_m, values[i + 1] * cycle.step_m];
    const [x, y] = place(cycle.position, 2 * row);
    const [bx, by] = place(cycle.history, at);
    const ahead = (horizon * cycle.dt_s) / (back * cycle.dt_s);
    context.strokeStyle = colours.straight;
    context.lineWidth = 2 / scale;
    context.setLineDash([2 / scale, 4 / scale]);
    context.beginPath();
    context.moveTo(x, y);
    context.lineTo(x + (x - bx) * ahead, y + (y - by) * ahead);
    context.stroke();
    context.setLineDash([]);
  }

  #drawGhosts(cycle, camera) {
    const { context, colours } = this;
    const size = Math.max(2.5, Math.min(4, camera.scale / 2));
    context.beginPath();
    for (let i = 0; i < cycle.count * 3; i += 1) {
      const x = cycle.ghosts[2 * i];
      if (x === UNKNOWN) continue;
      const [px, py] = camera.pixels(
        cycle.origin[0] + x * cycle.step_m,
        cycle.origin[1] + cycle.ghosts[2 * i + 1] * cycle.step_m,
      );
      context.moveTo(px, py - size);
      context.lineTo(px + size, py);
      context.lineTo(px, py + size);
      context.lineTo(px - size, py);
      context.closePath();
    }
    context.strokeStyle = colours.ghost;
    context.lineWidth = 1.2;
    context.stroke();
  }

  #drawAgents(cycle, camera, selected) {
    const { context, colours, agents } = this;
    for (const agent of agents) {
      const { row } = agent;
      const chosen = agent.id === selected;
      const level = cycle.agents.level[row];
      const measured = cycle.agents.length_m[row] !== null && cycle.agents.width_m[row] !== null;
      this.#outline(agent, camera);
      context.fillStyle = level === "good" ? colours.agent : colours["agent-light"];
      context.strokeStyle = chosen ? colours.chosen : colours.agent;
      context.lineWidth = chosen ? 3 : 1.4;
      const guessed = !measured && !agent.dot;
      context.globalAlpha = guessed ? 0.4 : 1;
      context.fill();
      context.globalAlpha = 1;
      if (guessed) context.setLineDash([4, 3]);
      context.stroke();
      context.setLineDash([]);
      if (level === "bad") this.#cross(agent);
      if (chosen) {
        context.beginPath();
        context.arc(agent.px, agent.py, this.#ring(agent), 0, 2 * Math.PI);
        agent.halfX = agent.halfY = this.#ring(agent) + 1; // its label keeps off
        context.lineWidth = 1.5;
        context.stroke();
      }
    }
  }

  /** The path of an agent's box, or of a dot with a nose. */
  #outline(agent, camera) {
    const { context } = this;
    context.beginPath();
    if (!agent.dot) return box(context, agent, camera);
    const { px, py, long: radius } = agent;
    context.arc(px, py, radius, 0, 2 * Math.PI);
    if (agent.heading === null) return undefined;
    const angle = -(agent.heading + camera.turn);
    const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
    context.moveTo(px + radius * cos, py + radius * sin);
    context.lineTo(px + 1.8 * radius * cos, py + 1.8 * radius * sin);
    return undefined;
  }

  #cross({ px, py }) {
    const { context, colours } = this;
    context.strokeStyle = colours.bad;
    context.lineWidth = 2;
    context.beginPath();
    context.moveTo(px - 5, py - 5);
    context.lineTo(px + 5, py + 5);
    context.moveTo(px + 5, py - 5);
    context.lineTo(px - 5, py + 5);
    context.stroke();
  }

  #drawEgo(moment, camera) {
    const pose = egoAt(moment);
    this.ego = null;
    if (!pose) return;
    const { context, colours } = this;
    const [px, py] = camera.pixels(pose[0], pose[1]);
    context.beginPath();
    const [long, wide] = EGO_M.map((metres) => Math.max(LEAST_PX, metres * camera.scale) / 2);
    this.ego = [px - long, py - wide, px + long, py + wide];
    box(context, { px, py, heading: pose[2], long, wide }, camera);
    context.fillStyle = colours.ego;
    context.fill();
    context.strokeStyle = colours.ground;
    context.lineWidth = 1;
    context.stroke();
    const angle = -(pose[2] + camera.turn);
    const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
    const at = (ahead, aside) => [px + cos * ahead - sin * aside, py + sin * ahead + cos * aside];
    context.beginPath(); // an arrow in it, for whom its colour is none
    context.moveTo(...at(-0.3 * long, -0.6 * wide));
    context.lineTo(...at(0.4 * long, 0));
    context.lineTo(...at(-0.3 * long, 0.6 * wide));
    context.lineWidth = Math.max(1.5, 0.3 * wide);
    context.stroke();
  }

  /** A bar of a round length, and where north is: that is known on a map. */
  #drawScale(camera, onMap) {
    const { context, colours, canvas } = this;
    const metres = [1, 2, 5, 10, 20, 50, 100, 200].find((m) => m * camera.scale >= 60) ?? 500;
    const [x, y] = [14, canvas.height / this.ratio - 16];
    context.strokeStyle = colours.soft;
    context.fillStyle = colours.soft;
    context.lineWidth = 1.5;
    context.beginPath();
    context.moveTo(x, y - 5);
    context.lineTo(x, y);
    context.lineTo(x + metres * camera.scale, y);
    context.lineTo(x + metres * camera.scale, y - 5);
    context.stroke();
    context.font = FONT;
    context.textAlign = "left";
    context.textBaseline = "alphabetic";
    context.fillText(`${metres} m`, x + 4, y - 6);
    this.north = onMap;
    if (onMap) this.#drawNorth(x + metres * camera.scale + 26, y - 8, camera);
  }

  #drawNorth(x, y, camera) {
    const { context } = this;
    const angle = -(Math.PI / 2 + camera.turn); // of north on the screen
    const tip = (length, turned) => [
      x + length * Math.cos(angle + turned), y + length * Math.sin(angle + turned),
    ];
    context.beginPath();
    context.moveTo(...tip(10, 0));
    context.lineTo(...tip(7, 2.6));
    context.lineTo(...tip(3, TURNED_BACK));
    context.lineTo(...tip(7, -2.6));
    context.closePath();
    context.fill();
    context.textAlign = "left";
    context.fillText("N", x + 14, y + 4);
  }
}

export const FONT = '12px system-ui, "Segoe UI", "DejaVu Sans", sans-serif';

/** The ego vehicle's pose at a moment, [x, y, yaw], or null. */
export function egoAt({ cycle, next, part }) {
  if (!cycle.ego || !next?.ego) return cycle.ego;
  const [a, b] = [cycle.ego, next.ego];
  if (Math.hypot(b[0] - a[0], b[1] - a[1]) > 20) return a; // the map frame has jumped
  return [a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1]), between(a[2], b[2], part)];
}

/** An angle on the shorter way from one to another. */
function between(from, to, part) {
  if (from === null || to === null) return from ?? to;
  const turn = ((to - from + 3 * Math.PI) % (2 * Math.PI)) - Math.PI;
  return from + part * turn;
}

/** Path of a box seen from above, its front a little pointed. */
function box(context, { px, py, heading, long, wide }, camera) {
  const angle = -(heading + camera.turn);
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  const at = (ahead, aside) => [px + cos * ahead - sin * aside, py + sin * ahead + cos * aside];
  context.moveTo(...at(-long, -wide));
  context.lineTo(...at(long - wide * 0.6, -wide));
  context.lineTo(...at(long, 0));
  context.lineTo(...at(long - wide * 0.6, wide));
  context.lineTo(...at(-long, wide));
  context.closePath();
}
