// An artifact's test vectors: inputs and the outputs that they must give.

const LIMIT_M = 1e-3; // how far a position may be from the stored one
const PROBABILITY = 1e-4;
const COVARIANCE = 1e-3; // as a share of the largest, or of 1 m^2

/**
 * Run every test vector. `read(path)` gives a file of the artifact as Uint8Array; `run(inputs)` gives
 * outputs by name. Inputs and outputs are {type, data, dims}.
 */
export async function check(contract, read, run) {
  const listed = new TextDecoder().decode(await read("SHA256SUMS"));
  const folders = new Set(listed.match(/test_data_set_\d+/g));
  const stored = async (folder, side, names) => {
    const tensors = names.map(async (name, i) => [name, tensorOf(await read(`${folder}/${side}_${i}.pb`))]);
    return Object.fromEntries(await Promise.all(tensors));
  };
  let worstM = 0;
  let good = folders.size > 0;
  for (const folder of folders) {
    const found = await run(await stored(folder, "input", Object.keys(contract.inputs)));
    const result = compare(found, await stored(folder, "output", Object.keys(contract.outputs)));
    worstM = Math.max(worstM, result.worstM);
    good &&= result.good;
  }
  const worst = `worst ${(1e3 * worstM).toFixed(4)} mm`;
  return { good, line: `${contract.name}: ${folders.size} vectors, ${worst}, ${good ? "ok" : "FAILED"}` };
}

/** A serialised TensorProto of float32 or bool: dims (field 1), data_type (2), raw_data (9). */
export function tensorOf(bytes) {
  const dims = [];
  let kind = 0;
  let raw = new Uint8Array();
  for (const [field, value] of fieldsOf(bytes)) {
    if (field === 1) dims.push(...(typeof value === "number" ? [value] : numbersOf(value)));
    if (field === 2) kind = value;
    if (field === 9) raw = new Uint8Array(value); // a copy, because floats must lie at a multiple of 4
  }
  if (kind === 1) return { type: "float32", dims, data: new Float32Array(raw.buffer) };
  if (kind === 9) return { type: "bool", dims, data: raw };
  throw new Error(`a tensor of type ${kind}, neither float32 nor bool`);
}

function* fieldsOf(bytes) {
  const at = { byte: 0 };
  while (at.byte < bytes.length) {
    const key = varint(bytes, at);
    const value = varint(bytes, at); // of a field of bytes, its length
    if ((key & 7) === 2) at.byte += value;
    yield [key >> 3, (key & 7) === 2 ? bytes.subarray(at.byte - value, at.byte) : value];
  }
}

function numbersOf(bytes) {
  const at = { byte: 0 };
  const numbers = [];
  while (at.byte < bytes.length) numbers.push(varint(bytes, at));
  return numbers;
}

function varint(bytes, at) {
  let value = 0;
  for (let scale = 1; ; scale *= 128) {
    const byte = bytes[at.byte++];
    value += (byte & 127) * scale;
    if (byte < 128) return value;
  }
}

/** How far positions are apart, and whether all outputs agree. Modes as probable as each other may change places. */
function compare(found, expected) {
  const bad = { worstM: Infinity, good: false };
  for (const [name, { dims, data }] of Object.entries(expected)) {
    if (String(found[name]?.dims) !== String(dims)) return bad;
    if (!found[name].data.every(Number.isFinite) || !data.every(Number.isFinite)) return bad;
  }
  const [batch, modes] = expected.probabilities.dims;
  let worstM = 0;
  let good = true;
  for (let b = 0; b < batch; b++) {
    const free = new Set(Array(modes).keys());
    for (let k = 0; k < modes; k++) {
      const share = (outputs, m) => outputs.probabilities.data[b * modes + m];
      const apart = (name, m) => difference(found[name], expected[name], b * modes + m, b * modes + k);
      const level = [...free].filter((m) => Math.abs(share(found, m) - share(expected, k)) <= PROBABILITY);
      level.sort((a, c) => apart("trajectories", a) - apart("trajectories", c));
      const mode = level[0] ?? k;
      free.delete(mode);
      worstM = Math.max(worstM, apart("trajectories", mode));
      good &&= level.length > 0 && (!expected.covariances || apart("covariances", mode) <= COVARIANCE);
    }
  }
  return { worstM, good: good && worstM <= LIMIT_M };
}

/** The largest between two modes, of a covariance as a share of its largest value or of 1 m^2. */
function difference(found, expected, foundMode, expectedMode) {
  const size = expected.dims.slice(2).reduce((a, b) => a * b, 1);
  const unit = expected.dims.length === 5 ? 4 : 1; // values of one covariance
  let largest = 0;
  for (let i = 0; i < size; i += unit) {
    const theirs = expected.data.subarray(expectedMode * size + i, expectedMode * size + i + unit);
    const scale = unit === 1 ? 1 : Math.max(1, ...theirs.map(Math.abs));
    theirs.forEach((value, j) => {
      largest = Math.max(largest, Math.abs(found.data[foundMode * size + i + j] - value) / scale);
    });
  }
  return largest;
}
