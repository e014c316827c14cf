// Predict a recorded scene with an eqrt artifact in Node.js.
//
//   node predict.mjs ARTIFACT SCENE.json   print where everybody will be
//   node predict.mjs --check ARTIFACT...   run the artifact's test vectors; status 1 if one is missed

import { readFile } from "node:fs/promises";
import { join } from "node:path";

import { missedBy, modesOf, pack } from "./scene.mjs";
import { check } from "./vectors.mjs";

process.env.ORT_DISABLE_TELEMETRY = "1"; // read when onnxruntime is loaded
const { default: ort } = await import("onnxruntime-node");

const [first, ...rest] = process.argv.slice(2);
if (first === "--check" && rest.length) {
  for (const artifact of rest) {
    const read = (path) => readFile(join(artifact, path));
    const { good, line } = await check(await readJson(artifact, "contract.json"), read, await load(artifact));
    console.log(line);
    if (!good) process.exitCode = 1;
  }
} else if (first && !first.startsWith("-") && rest.length === 1) {
  await show(first, rest[0]);
} else {
  console.error("node predict.mjs ARTIFACT SCENE.json\nnode predict.mjs --check ARTIFACT...");
  process.exitCode = 2;
}

async function show(artifact, path) {
  const contract = await readJson(artifact, "contract.json");
  const scene = await readJson(path);
  const outputs = await (await load(artifact))(pack(scene, contract));
  scene.targets.forEach(({ agent, future }, b) => {
    const modes = modesOf(outputs, b);
    console.log(`agent ${agent} at ${place(scene.agents[agent].at(-1))}`);
    for (const { share, places } of modes) {
      const percent = `${Math.round(100 * share)}%`.padStart(6);
      console.log(percent + parts(places, contract.dt_s));
    }
    const last = future[Math.min(modes[0].places.length, future.length) - 1];
    console.log(`  was at ${place(last)}: ${missedBy(modes[0].places, future).toFixed(2)} m away`);
  });
}

async function load(artifact) {
  const options = { intraOpNumThreads: 1 }; // small models gain nothing from more
  const session = await ort.InferenceSession.create(join(artifact, "model.onnx"), options);
  return (inputs) => {
    const tensor = ([name, { type, data, dims }]) => [name, new ort.Tensor(type, data, dims)];
    return session.run(Object.fromEntries(Object.entries(inputs).map(tensor)));
  };
}

async function readJson(...path) {
  return JSON.parse(await readFile(join(...path), "utf8"));
}

function place([x, y]) {
  return `(${x.toFixed(2)}, ${y.toFixed(2)})`;
}

/** A third and two thirds of the way, and the end. */
function parts(places, dtS) {
  const steps = [1, 2, 3].map((part) => Math.max(1, Math.floor((places.length * part) / 3)));
  return steps.map((step) => `  ${(step * dtS).toFixed(1)} s ${place(places[step - 1])}`).join("");
}
