// Everything beside the picture, in words and numbers.

import { drawHistogram, drawSpark } from "./charts.mjs";
import { isPredicted } from "./update.mjs";

const MARKS = { good: "✓", limited: "!", bad: "✕", lost: "✕", waiting: "…" };
export const STALE_S = 2;
const by = (id) => document.getElementById(id);
const number = (value, digits, unit) =>
  value === null || value === undefined ? "not known" : `${value.toFixed(digits)} ${unit}`;

/** The line at the top: how the service is, in one sentence. Returns it. */
export function showBanner({ lost, hello, moment, status, silent, waiting }) {
  let [level, words, since] = ["waiting", "Connecting", ""];
  if (lost) {
    [level, words] = ["lost", "Connection to eqrt view lost"];
  } else if (moment) {
    const { cycle } = moment;
    const lasts = moment.time - cycle.mode_since_s;
    [level, words] = [cycle.level, cycle.mode_words];
    if (cycle.level !== "good" && lasts >= 1) since = `, for ${ago(lasts)}`;
    if (silent > STALE_S) {
      const nothing = hello?.mode === "file" ? "Nothing is recorded here" : "Nothing heard of the service";
      [level, words, since] = ["lost", nothing, `, for ${ago(silent)}`];
    }
  } else if (hello) {
    words = hello.mode === "file" ? `Reading ${hello.name}` : "Waiting for predictions";
  }
  by("banner").className = level;
  set("mark", MARKS[level]);
  set("mode", words);
  set("since", since); // apart, so that a screen reader is not told every second
  set("what", whatRuns(hello, status, moment));
  showNotice({ lost, hello, moment, waiting });
  return words + since;
}

function whatRuns(hello, status, moment) {
  const parts = [];
  if (hello?.mode === "file") parts.push(hello.name);
  if (status) {
    parts.push(`sensor profile ${status.profile}`, `model ${status.model}`);
    parts.push(status.tile ? `map ${status.tile.split("/").pop()}` : "no map");
  }
  if (moment) parts.push(`${moment.cycle.count} agents`);
  return parts.join(" · ");
}

/** What to do, when there is nothing to see. */
function showNotice({ lost, hello, moment, waiting }) {
  const notice = by("notice");
  const lines = [];
  if (lost) {
    lines.push("Connection lost", "The program that feeds this page has ended or cannot be reached. Start it, or the ssh tunnel, again; the page then goes on by itself.", "eqrt view");
  } else if (!moment && hello?.mode === "live" && waiting > 1) {
    lines.push("Waiting for predictions", `Nothing comes to ${hello.address} yet. Start the service so that it sends there, or add this to how it is started:`, `eqrt serve --can can0 --profile ars408 --datagrams ${hello.address}`);
  }
  notice.hidden = !lines.length;
  if (!lines.length || notice.dataset.shown === lines.join()) return;
  notice.dataset.shown = lines.join();
  notice.replaceChildren(element("h2", lines[0]), element("p", lines[1]), element("pre", lines[2]));
}

/** Latency, rates and what went wrong, over the minute before the moment. */
export function showService(statuses, moment, mode, troubles, colours) {
  const now = moment?.time ?? statuses.at(-1)?.time_s ?? 0;
  const heard = statuses.filter((s) => s.time_s <= now + 1.5 && s.time_s > now - 61);
  const points = heard.flatMap((s) =>
    s.latencies_s.map((l, i) => [
      Math.max(0, now - s.time_s + s.seconds * (1 - (i + 1) / s.latencies_s.length)), 1000 * l,
    ]));
  const status = heard.at(-1);
  by("spark").hidden = by("histogram").hidden = !points.length;
  drawSpark(by("spark"), points, colours);
  const values = points.map((point) => point[1]);
  drawHistogram(by("histogram"), values, colours);
  set("service-words", serviceWords(status, values, mode));
  showNumbers("service-numbers", status ? serviceNumbers(status, values) : []);
  showTroubles([...troubles, ...serviceTroubles(status)], sinceStart(status));
}

function serviceWords(status, values, mode) {
  if (!status && mode === "file") return "The file says nothing about the service itself.";
  if (!status) return "The service has said nothing about itself.";
  if (!values.length) return "No predictions in the last minute.";
  return "From the last message of a cycle to its predictions sent:";
}

function serviceNumbers(status, values) {
  const rows = [];
  if (values.length) {
    const sorted = [...values].sort((a, b) => a - b);
    const share = (part) => sorted[Math.min(sorted.length - 1, Math.floor(part * sorted.length))];
    rows.push(["half within", `${share(0.5).toFixed(1)} ms`]);
    rows.push(["99 % within", `${share(0.99).toFixed(1)} ms`]);
    rows.push(["longest", `${sorted.at(-1).toFixed(1)} ms`]);
  }
  rows.push(["predictions", `${(status.latencies_s.length / status.seconds).toFixed(1)} cycles/s`]);
  rows.push(["messages in", `${Math.round(status.messages / status.seconds)} /s`]);
  rows.push(["missed by this view", `${status.lost_cycles} cycles`]);
  rows.push(["runs for", ago(status.uptime_s)]);
  return rows;
}

function serviceTroubles(status) {
  if (!status) return [];
  const buses = status.buses.filter((bus) => bus.state !== "UP")
    .map((bus) => `CAN ${bus.name}: ${bus.state.toLowerCase().replace("_", " ")} for ${ago(bus.since_s)}`);
  const sources = status.sources.map((s) => `${s.name}: ${s.reason}, for ${ago(s.since_s)}`);
  return [...buses, ...sources];
}

function sinceStart(status) {
  return Object.entries(status?.drops ?? {}).map(([words, count]) => `since the start, ${words}: ${count}`);
}

/** What is wrong now, then what once was. */
function showTroubles(troubles, before) {
  const list = by("troubles");
  const shown = [...troubles, ...before].join();
  if (list.dataset.shown === shown) return;
  list.dataset.shown = shown;
  list.replaceChildren(...[...troubles, ...before].map((words) => element("li", words)));
  [...list.children].slice(troubles.length).forEach((item) => item.classList.add("before"));
}

/** Mean errors of the last minute beside constant velocity's. */
export function showScore(score) {
  by("score-table").hidden = !score;
  if (!score) {
    set("score-words", "None can be judged yet: what was predicted must first happen.");
    return;
  }
  set("score-words", `Mean distance from what happened, of ${score.count} predictions, in metres:`);
  const horizons = Object.keys(score.eqrt).filter((name) => name.startsWith("ade"));
  const row = (kind, name, table) => [kind, name, ...horizons.map((h) => `${table[h].toFixed(2)}`)];
  showTable("score-table", ["", "over the first", ...horizons.map((h) => `${h.slice(4, -1)} s`)], [
    row("us", "eqrt", score.eqrt),
    row("", "constant velocity", score.constant_velocity),
  ]);
}

/** Everything about one agent. Returns whether it is there. */
export function showSelected(moment, id) {
  const row = moment?.cycle.rows.get(id);
  by("selected").hidden = id === null;
  if (id === null) return false;
  set("selected-name", row === undefined ? `${id}` : `${id}, ${moment.cycle.agents.kind[row]}`);
  for (const part of ["selected-numbers", "selected-modes", "selected-errors-words", "selected-errors"]) {
    by(part).hidden = row === undefined;
  }
  if (row === undefined) {
    set("selected-how", "Not seen at this moment.");
    return false;
  }
  const { agents } = moment.cycle;
  const size = agents.length_m[row] === null && agents.width_m[row] === null ? "not known"
    : `${number(agents.length_m[row], 1, "m")} × ${number(agents.width_m[row], 1, "m")}`;
  const how = agents.words[row];
  set("selected-how", `${how[0].toUpperCase()}${how.slice(1)}.`);
  showNumbers("selected-numbers", [
    ["speed", number(agents.speed_mps[row], 1, "m/s")],
    ["from ego", number(agents.range_m[row], 1, "m")],
    ["length × width", size],
    ["age of measurement", `${Math.round(1000 * agents.age_s[row])} ms`],
    ["the sensor's number", `${agents.object_id[row]}`],
  ]);
  by("selected-modes").hidden = !isPredicted(agents, row);
  showModes(agents.probabilities[row]);
  showErrors(agents, row);
  return true;
}

function showModes(probabilities) {
  by("selected-modes").replaceChildren(...probabilities.map((probability, mode) => {
    const line = element("div", "");
    line.className = "bar";
    const bar = element("b", "");
    const fill = document.createElement("i");
    fill.style.display = "block";
    fill.style.width = `${100 * probability}%`;
    fill.style.opacity = 0.3 + 0.7 * probability;
    bar.append(fill);
    const value = element("span", `${Math.round(100 * probability)} %`);
    value.className = "value";
    line.append(element("span", `path ${mode + 1}`), bar, value);
    return line;
  }));
}

function showErrors(agents, row) {
  const cells = (values) => values.map((value) => (value === null ? "–" : `${value.toFixed(2)}`));
  showTable("selected-errors", ["", "predicted before", "1 s", "2 s", "3 s"], [
    ["us", "eqrt", ...cells(agents.error_m[row])],
    ["", "constant velocity", ...cells(agents.constant_velocity_error_m[row])],
  ]);
}

/** `rows`: [class, heading, cells ...]. Only what changed is written. */
function showTable(id, head, rows) {
  const table = by(id);
  if (table.rows.length !== rows.length + 1 || table.rows[0].cells.length !== head.length - 1) {
    table.replaceChildren();
    const line = table.createTHead().insertRow();
    for (const words of head.slice(1)) line.append(element("th", words));
    const body = table.createTBody();
    for (const [kind, name, ...cells] of rows) {
      const tr = body.insertRow();
      tr.className = kind;
      tr.append(element("th", name));
      for (const cell of cells) tr.append(element("td", cell));
    }
    return;
  }
  rows.forEach(([, , ...cells], i) => cells.forEach((cell, j) => {
    const td = table.rows[i + 1].cells[j + 1];
    if (td.textContent !== cell) td.textContent = cell;
  }));
}

function showNumbers(id, rows) {
  const list = by(id);
  if (list.children.length !== 2 * rows.length) {
    list.replaceChildren(...rows.flatMap(([name, value]) => [element("dt", name), element("dd", value)]));
    return;
  }
  rows.forEach(([name, value], i) => {
    if (list.children[2 * i].textContent !== name) list.children[2 * i].textContent = name;
    if (list.children[2 * i + 1].textContent !== value) list.children[2 * i + 1].textContent = value;
  });
}

/** A length of time in words. */
export function ago(seconds) {
  const s = Math.max(0, Math.round(seconds));
  if (s < 60) return `${s} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${s % 60} s`;
  return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
}

export function set(id, words) {
  const node = by(id);
  if (node.textContent !== words) node.textContent = words;
}

function element(name, words) {
  const node = document.createElement(name);
  node.textContent = words;
  return node;
}
