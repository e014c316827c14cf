// The page: loads an artifact (?artifact=PATH), predicts the scene, draws it, checks the test vectors.

import * as ort from "./node_modules/onnxruntime-web/dist/ort.wasm.min.mjs";

import { missedBy, modesOf, pack } from "./scene.mjs";
import { check } from "./vectors.mjs";

const SHIPPED = "../../../runtime/eqrt/runtime/prediction/models/eqrt-free";
const ROAD = "#efefef";
const LANE = "#c9c9c9";
const HISTORY = "#333333";
const TRUTH = "#0072b2";
const PREDICTION = "#d55e00";

ort.env.wasm.numThreads = 1; // more need headers that a plain file server does not send
const artifact = new URLSearchParams(location.search).get("artifact") ?? SHIPPED;
const read = async (path) => new Uint8Array(await (await got(`${artifact}/${path}`)).arrayBuffer());

await orSayWhy(async () => {
  const contract = await (await got(`${artifact}/contract.json`)).json();
  const scene = await (await got("../scene.json")).json();
  const session = await ort.InferenceSession.create(await read("model.onnx"), { executionProviders: ["wasm"] });
  const run = (inputs) => session.run(tensors(inputs));
  const button = document.querySelector("#check");
  button.onclick = () => orSayWhy(async () => say("verdict", (await check(contract, read, run)).line));
  button.disabled = false;
  await show(scene, contract, run);
});

async function orSayWhy(work) {
  try {
    await work();
  } catch (error) {
    say("error", `${error}`);
    throw error;
  }
}

async function show(scene, contract, run) {
  const inputs = pack(scene, contract);
  await run(inputs); // the first run is slower
  const began = performance.now();
  const outputs = await run(inputs);
  const took = performance.now() - began;
  const targets = scene.targets.map((target, b) => ({ ...target, modes: modesOf(outputs, b) }));
  draw(scene, targets);
  const missed = targets.map(({ modes, future }) => missedBy(modes[0].places, future));
  const mean = missed.reduce((a, b) => a + b, 0) / missed.length;
  const ahead = (contract.horizon_steps * contract.dt_s).toFixed(1);
  say("model", `${contract.name} ${contract.version}, onnxruntime-web ${ort.env.versions.web}: ${targets.length} ` +
    `targets, ${ahead} s ahead, in ${took.toFixed(1)} ms; at the end they were ${mean.toFixed(2)} m away on average`);
  say("credits", `${scene.about}. ${scene.credits.join(". ")}.`);
}

function tensors(inputs) {
  const tensor = ([name, { type, data, dims }]) => [name, new ort.Tensor(type, data, dims)];
  return Object.fromEntries(Object.entries(inputs).map(tensor));
}

/** Lanes, where everybody came from, the truth, and the predictions, fainter where less probable. */
function draw(scene, targets) {
  const pen = document.querySelector("#picture").getContext("2d");
  const shown = targets.flatMap(({ agent, future }) => [...scene.agents[agent], ...future]);
  const { toPixel, pxPerM } = view(shown, pen.canvas);
  const line = (places, color, width, { dash = [], alpha = 1 } = {}) => {
    pen.strokeStyle = color;
    pen.lineWidth = width;
    pen.globalAlpha = alpha;
    pen.setLineDash(dash);
    pen.beginPath();
    places.filter(Boolean).map(toPixel).forEach(([x, y]) => pen.lineTo(x, y));
    pen.stroke();
  };
  const lanes = targets.flatMap(({ centerlines }) => centerlines);
  lanes.forEach((lane) => line(lane, ROAD, 3.2 * pxPerM));
  lanes.forEach((lane) => line(lane, LANE, 2));
  scene.agents.forEach((history) => line(history, HISTORY, 3));
  for (const { agent, future, modes } of targets) {
    const now = scene.agents[agent].at(-1);
    line([now, ...future], TRUTH, 6);
    for (const { places, share } of [...modes].reverse()) {
      const alpha = 0.2 + (0.8 * share) / modes[0].share;
      line([now, ...places], PREDICTION, 6, { dash: [14, 8], alpha });
    }
  }
  pen.globalAlpha = 1;
  pen.fillStyle = HISTORY;
  for (const history of scene.agents) {
    pen.beginPath();
    pen.arc(...toPixel(history.at(-1)), 8, 0, 2 * Math.PI);
    pen.fill();
  }
}

/** Metres to pixels, y up, so that all places are to be seen. */
function view(places, { width, height }) {
  const known = places.filter(Boolean);
  const [left, right] = extent(known.map(([x]) => x));
  const [bottom, top] = extent(known.map(([, y]) => y));
  const pxPerM = 0.92 * Math.min(width / (right - left), height / (top - bottom));
  const toPixel = ([x, y]) => [
    width / 2 + pxPerM * (x - (left + right) / 2),
    height / 2 - pxPerM * (y - (bottom + top) / 2),
  ];
  return { toPixel, pxPerM };
}

function extent(values) {
  return [Math.min(...values), Math.max(...values)];
}

async function got(path) {
  const response = await fetch(path);
  if (!response.ok) throw new Error(`${path}: ${response.status} ${response.statusText}`);
  return response;
}

function say(id, text) {
  document.querySelector(`#${id}`).textContent = text;
}
