// The page: what comes in, what is shown, what keys and buttons do.

import { Camera, TURNS } from "./camera.mjs";
import { STALE_S, ago, set, showBanner, showScore, showSelected, showService } from "./panels.mjs";
import { Scene, egoAt } from "./scene.mjs";
import { showSigns } from "./signs.mjs";
import { openStream } from "./stream.mjs";
import { FileTimeline, LiveTimeline } from "./timeline.mjs";
import { UNKNOWN, decodeLanes, decodeUpdate } from "./update.mjs";

const PANELS_MS = 250;
const KEPT_STATUSES = 70;
const by = (id) => document.getElementById(id);
const seconds = () => performance.now() / 1000;

const camera = new Camera();
const scene = new Scene(by("scene"));
const page = {
  timeline: new LiveTimeline(),
  hello: null,
  connected: false,
  lost: false, // and not merely not yet connected
  opened: seconds(),
  statuses: [],
  trouble: "",
  moment: null,
  selected: null,
  yaw: null,
  before: null, // the cycle of the picture before
  words: "",
  frames: 0,
  scriptMs: [],
  frameTimes: [],
};

const stream = openStream({
  state: (connected) => {
    page.connected = connected;
    page.lost = !connected;
    page.opened = seconds();
    panels();
  },
  text: hear,
  update: (buffer) => {
    const first = page.timeline.empty;
    page.timeline.add(decodeUpdate(buffer), seconds());
    if (first) panels();
  },
});

function hear(message) {
  const { timeline } = page;
  switch (message.kind) {
    case "hello":
      greet(message);
      break;
    case "lanes":
      scene.addLanes(decodeLanes(message));
      if (timeline.mode === "file") timeline.lanes = message.number;
      break;
    case "status":
      if (message.time_s < (page.statuses.at(-1)?.time_s ?? 0)) page.statuses = [];
      page.statuses.push(message);
      if (page.statuses.length > KEPT_STATUSES) page.statuses.shift(); // only live ones come singly
      break;
    case "statuses":
      page.statuses = message.statuses;
      break;
    case "index":
      timeline.index(message);
      break;
    case "trouble":
      page.trouble = message.words;
      break;
    default: // of a newer server
  }
}

/** A server: the one that was lost, and then nothing is forgotten, or another. */
function greet(message) {
  if (page.hello?.server !== message.server) {
    const ofFile = message.mode === "file";
    page.timeline = ofFile ? new FileTimeline((wanted) => stream.ask(wanted)) : new LiveTimeline();
    page.statuses = [];
    page.trouble = "";
    scene.laneSets = [];
    by("speed").hidden = !ofFile;
    by("speed").value = "1";
    page.before = page.selected = null;
    page.yaw = null; // perhaps it knows no ego vehicle, and is somewhere else
    camera.placed = false;
  }
  page.hello = message;
  set("live", message.mode === "file" ? "To end" : "Live");
}

// Pictures

let last = seconds();

function picture() {
  requestAnimationFrame(picture);
  const began = performance.now();
  const now = began / 1000;
  page.moment = page.timeline.moment(now, Math.min(0.1, now - last));
  last = now;
  if (page.moment) {
    notice(page.moment.cycle);
    aim(page.moment);
  }
  const time = page.moment?.cycle.time_s ?? 0;
  scene.draw(page.moment, camera, page.selected, (back) => page.timeline.near(time - back));
  page.frames += 1;
  remember(page.frameTimes, began);
  remember(page.scriptMs, performance.now() - began);
}

function remember(list, value) {
  list.push(value);
  if (list.length > 600) list.shift();
}

/** A service that starts again numbers its tracks anew: who was selected is another one now. */
function notice(cycle) {
  const before = page.before ?? cycle;
  page.before = cycle;
  const another = cycle.stream !== before.stream && cycle.cycle <= before.cycle;
  if (another && page.selected !== null) select(null); // else it was given another model
}

/** Where the camera looks at this moment. */
function aim(moment) {
  const ego = egoAt(moment);
  if (ego) page.yaw = ego[2];
  let at = ego;
  const row = moment.cycle.rows.get(page.selected);
  if (camera.follow === "selected" && row !== undefined) at = agentPlace(moment, row) ?? at;
  if (!at && camera.follow === "ego") at = traffic(moment.cycle);
  camera.placed = Boolean(at) || camera.placed;
  const [x, y] = at ?? [camera.x, camera.y];
  camera.lookAt(x, y, page.yaw);
}

/** An agent's place at a moment, [x, y], or null where it is too far away to be told. */
function agentPlace({ cycle, next, part }, row) {
  const place = (of, at) => [
    of.origin[0] + of.position[2 * at] * of.step_m, of.origin[1] + of.position[2 * at + 1] * of.step_m,
  ];
  if (cycle.position[2 * row] === UNKNOWN) return null;
  const [x, y] = place(cycle, row);
  const later = next?.rows.get(cycle.agents.track_id[row]);
  if (later === undefined || next.position[2 * later] === UNKNOWN) return [x, y];
  const [nx, ny] = place(next, later);
  return [x + part * (nx - x), y + part * (ny - y)];
}

/** Where nobody tells the place of the ego vehicle: slowly to the middle of the traffic. */
function traffic(cycle) {
  if (!cycle.count || page.yaw !== null) return null; // it is known but for a moment
  const [x, y] = cycle.origin;
  const near = camera.placed && Math.hypot(x - camera.x, y - camera.y) < 200;
  return near ? [camera.x + 0.03 * (x - camera.x), camera.y + 0.03 * (y - camera.y)] : [x, y];
}

// Panels

function panels() {
  const { timeline, moment } = page;
  const now = seconds();
  const silent = silence(timeline, moment, now);
  const stopped = page.lost || (timeline.mode === "live" && silent > STALE_S);
  page.words = showBanner({
    lost: page.lost, hello: page.hello, moment, silent,
    status: statusAt(moment?.time), waiting: now - page.opened,
  });
  showService(page.statuses, moment, timeline.mode, page.trouble ? [page.trouble] : [], scene.colours);
  showScore(moment?.cycle.score ?? null);
  showSelected(moment, page.selected);
  showTransport(timeline, stopped ? now - timeline.arrived : 0);
  sayTurn();
  sayFollow();
}

/** What the service said of the second of a moment, else before it, else first. */
function statusAt(time = Infinity) {
  const after = page.statuses.findIndex((status) => status.time_s >= time);
  if (after < 0) return page.statuses.at(-1);
  const { time_s: said, seconds: period } = page.statuses[after];
  return said - period <= time ? page.statuses[after] : page.statuses[Math.max(0, after - 1)];
}

/** For how long nothing has come that should, or stands in a file, s. */
function silence(timeline, moment, now) {
  if (timeline.mode === "file") return moment ? moment.time - moment.cycle.time_s : 0;
  return timeline.live && !timeline.empty ? now - timeline.arrived : 0;
}

/** `stopped`: for how long nothing has come that should, s; 0 if all is well. */
function showTransport(timeline, stopped) {
  set("play", timeline.playing ? "Pause" : "Play");
  by("live").classList.toggle("now", timeline.live && !stopped);
  for (const id of ["play", "back", "forward", "scrub", "live"]) by(id).disabled = timeline.empty;
  if (timeline.empty) return set("when", "");
  const span = timeline.last - timeline.first;
  if (document.activeElement !== by("scrub") || timeline.playing) {
    by("scrub").value = span && !timeline.live ? (1000 * (timeline.time - timeline.first)) / span : 1000;
  }
  return set("when", when(timeline, stopped));
}

function when(timeline, stopped) {
  if (timeline.mode === "file") {
    return `${clock(timeline.time - timeline.first)} of ${clock(timeline.last - timeline.first)}${timeline.done ? "" : " …"}`;
  }
  if (timeline.live && stopped) return `stopped ${ago(stopped)} ago`;
  if (timeline.live) return `live, ${timeline.delay.toFixed(2)} s ago`;
  return `${(timeline.last - timeline.time).toFixed(1)} s ago`;
}

function clock(time) {
  const minutes = Math.floor(time / 60);
  return `${minutes}:${(time - 60 * minutes).toFixed(1).padStart(4, "0")}`;
}

// What a person does

const actions = {
  pause: () => (page.timeline.playing ? page.timeline.pause() : page.timeline.play()),
  back: () => page.timeline.step(-1),
  forward: () => page.timeline.step(1),
  backSecond: () => page.timeline.step(-10),
  forwardSecond: () => page.timeline.step(10),
  live: () => page.timeline.goLive(),
  closer: () => camera.zoom(1.25),
  farther: () => camera.zoom(0.8),
  turn: () => {
    camera.axis = TURNS[(TURNS.indexOf(camera.axis) + 1) % TURNS.length];
  },
  follow: () => follow(nextToFollow()),
  ghosts: () => {
    scene.ghosts = !scene.ghosts;
    by("ghosts").setAttribute("aria-pressed", scene.ghosts);
  },
  help: () => (by("help").open ? by("help").close() : by("help").showModal()),
  unselect: () => select(null),
  next: () => select(neighbour(1)),
  previous: () => select(neighbour(-1)),
};

const keys = {
  " ": "pause", p: "pause", ArrowLeft: "back", ArrowRight: "forward", l: "live", End: "live",
  "+": "closer", "=": "closer", "-": "farther", n: "turn", f: "follow", g: "ghosts", "?": "help",
  Escape: "unselect",
};

function sayTurn() {
  const still = page.moment?.cycle.on_map ? "North up" : "Not turning";
  const words = { up: "Heading up", right: "Heading right", north: still };
  set("turn", page.yaw === null ? words.north : words[camera.axis]);
  by("turn").disabled = page.yaw === null;
}

function nextToFollow() {
  if (camera.follow === "free") return "ego";
  if (camera.follow === "ego" && page.selected !== null) return "selected";
  return camera.follow === "ego" ? "free" : "ego";
}

function follow(whom) {
  if (camera.follow !== whom && whom === "free") camera.pan(0, 0);
  camera.follow = whom;
  camera.placed = false;
  sayFollow();
}

function sayFollow() {
  const ego = page.yaw === null ? "Following traffic" : "Following ego";
  const words = { ego, selected: "Following selected", free: "Not following" };
  set("follow", words[camera.follow]);
}

function select(id) {
  page.selected = id;
  if (id === null && camera.follow === "selected") follow("ego");
  panels();
}

/** The next agent by distance from the ego vehicle. */
function neighbour(step) {
  const agents = page.moment?.cycle.agents;
  if (!agents?.track_id.length) return null;
  const order = agents.track_id.map((id, row) => [agents.range_m[row] ?? id, id]).sort((a, b) => a[0] - b[0]);
  const at = order.findIndex(([, id]) => id === page.selected);
  return order[(at + step + order.length) % order.length][1];
}

function act(name) {
  actions[name]();
  panels();
}

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || by("help").open) return;
  const inScrub = event.target === by("scrub") || event.target === by("speed");
  if (inScrub && event.key.startsWith("Arrow")) return;
  let name = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
  if (event.shiftKey && (name === "back" || name === "forward")) name += "Second";
  const onPicture = event.target === by("scene") || event.target === document.body;
  if (event.key === "Tab" && onPicture && page.selected !== null) {
    name = event.shiftKey ? "previous" : "next";
  }
  if (event.key === "Enter" && onPicture) name = "next";
  if (!name || (event.target.tagName === "BUTTON" && (event.key === " "))) return;
  event.preventDefault();
  act(name);
});

const buttons = {
  play: "pause", back: "back", forward: "forward", live: "live", "zoom-in": "closer",
  "zoom-out": "farther", turn: "turn", follow: "follow", ghosts: "ghosts", "help-button": "help",
  unselect: "unselect",
};
for (const [id, name] of Object.entries(buttons)) by(id).onclick = () => act(name);

by("scrub").oninput = () => {
  const { timeline } = page;
  if (timeline.mode === "live" && timeline.playing) timeline.pause();
  timeline.seek(timeline.first + (by("scrub").value / 1000) * (timeline.last - timeline.first));
  panels();
};
by("speed").onchange = () => (page.timeline.speed = Number(by("speed").value));

const canvas = by("scene");
let drag = null;
canvas.onpointerdown = (event) => {
  canvas.setPointerCapture(event.pointerId);
  drag = { x: event.offsetX, y: event.offsetY, moved: 0 };
};
canvas.onpointermove = (event) => {
  if (!drag) {
    canvas.classList.toggle("hit", scene.hit(event.offsetX, event.offsetY) !== null);
    return;
  }
  const [dx, dy] = [event.offsetX - drag.x, event.offsetY - drag.y];
  drag.moved += Math.abs(dx) + Math.abs(dy);
  if (drag.moved > 4) {
    camera.pan(dx, dy);
    sayFollow();
    canvas.classList.add("dragging");
  }
  [drag.x, drag.y] = [event.offsetX, event.offsetY];
};
canvas.onpointerup = (event) => {
  if (drag && drag.moved <= 4) select(scene.hit(event.offsetX, event.offsetY)?.id ?? null);
  drag = null;
  canvas.classList.remove("dragging");
};
canvas.onpointercancel = () => (drag = null);
canvas.onwheel = (event) => {
  event.preventDefault();
  camera.zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
};

function dress() {
  scene.readColours();
  showSigns(by("signs"), scene.colours);
}
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", dress);
new ResizeObserver(() => scene.resize(camera)).observe(canvas);

scene.resize(camera);
dress();
setInterval(panels, PANELS_MS);
panels();
picture();

// For tests, and for whoever opens the console: what the page shows now.
window.eqrt = {
  get agents() { return scene.agents.map(({ id, x, y }) => ({ id, x, y })); },
  get moment() {
    const cycle = page.moment?.cycle;
    return cycle ? { cycle: cycle.cycle, time_s: page.moment.time, mode: cycle.mode, shape: cycle.shape } : null;
  },
  get words() { return page.words; },
  get paused() { return !page.timeline.playing; },
  get live() { return page.timeline.live; },
  get kept() { return page.timeline.cycles?.length ?? page.timeline.times.length; },
  get selected() { return page.selected; },
  get ghosts() { return page.moment ? page.moment.cycle.ghosts.filter((v) => v !== -32768).length / 2 : 0; },
  get score() { return page.moment?.cycle.score ?? null; },
  get lanes() { return scene.lanesDrawn; },
  get north() { return scene.north; },
  get labels() { return scene.labels.boxes ?? []; },
  get pixels() { return scene.agents.map(({ id, px, py }) => ({ id, px, py })); },
  get camera() { return { scale: camera.scale, follow: camera.follow, axis: camera.axis }; },
  get connected() { return page.connected; },
  get bytes() { return stream.bytes; },
  get updates() { return stream.updates; },
  get frames() { return page.frames; },
  get timing() { return { frameTimes: [...page.frameTimes], scriptMs: [...page.scriptMs] }; },
};
