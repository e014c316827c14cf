// Latency as a line over the last minute, and how often each occurred.

import { FONT } from "./scene.mjs";

const SMALL = FONT.replace("12px", "11px");

/** `points`: [[seconds ago, milliseconds]]; the line's top is the worst. */
export function drawSpark(canvas, points, colours, span = 60) {
  const { context, width, height } = prepared(canvas);
  if (!points.length) return;
  const top = scaleTop(Math.max(...points.map((point) => point[1])));
  const x = (ago) => width * (1 - ago / span);
  const y = (ms) => height - 1 - (height - 14) * Math.min(1, ms / top);
  axis(context, width, height, colours);
  context.strokeStyle = colours.chosen;
  context.lineWidth = 1.2;
  context.beginPath();
  points.forEach(([ago, ms], i) => (i ? context.lineTo(x(ago), y(ms)) : context.moveTo(x(ago), y(ms))));
  context.stroke();
  write(context, `${top} ms`, 0, 9, "left", colours);
  write(context, "last minute", width, 9, "right", colours);
}

/** `values`: milliseconds. */
export function drawHistogram(canvas, values, colours) {
  const { context, width, height } = prepared(canvas);
  if (!values.length) return;
  const top = scaleTop(Math.max(...values));
  const bins = new Array(30).fill(0);
  for (const ms of values) bins[Math.min(29, Math.floor((30 * ms) / top))] += 1;
  const most = Math.max(...bins);
  const room = height - 15;
  context.fillStyle = colours.chosen;
  bins.forEach((count, i) => {
    if (!count) return;
    const tall = Math.max(1.5, ((room - 2) * count) / most);
    context.fillRect((width * i) / 30 + 0.5, room - tall, width / 30 - 1, tall);
  });
  axis(context, width, room + 1, colours);
  write(context, "0", 0, height - 2, "left", colours);
  write(context, `${top} ms`, width, height - 2, "right", colours);
}

function prepared(canvas) {
  const ratio = Math.min(2, devicePixelRatio || 1);
  const width = canvas.clientWidth;
  const height = Number(canvas.getAttribute("height-px") ?? canvas.getAttribute("height"));
  if (!canvas.hasAttribute("height-px")) canvas.setAttribute("height-px", height);
  canvas.style.height = `${height}px`;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  return { context, width, height };
}

function axis(context, width, y, colours) {
  context.strokeStyle = colours.edge;
  context.lineWidth = 1;
  context.beginPath();
  context.moveTo(0, y - 0.5);
  context.lineTo(width, y - 0.5);
  context.stroke();
}

function write(context, text, x, y, align, colours) {
  context.font = SMALL;
  context.textAlign = align;
  context.textBaseline = "alphabetic";
  context.fillStyle = colours.soft;
  context.fillText(text, x, y);
}

/** A round number of milliseconds at least as large. */
function scaleTop(ms) {
  return [5, 10, 20, 30, 50, 75, 100, 150, 200, 300, 500, 1000, 2000, 5000].find((top) => top >= ms) ?? 10000;
}
