// The legend: each sign as it is drawn, and what it means.

const SIGNS = [
  ["ego vehicle", (c, k) => { car(c, k.ego, true); arrow(c, k.panel); }],
  ["agent, as large as measured", (c, k) => car(c, k.agent, true)],
  ["seen for less than 2 s", (c, k) => car(c, k.agent, false)],
  ["predicted without the model", (c, k) => { car(c, k.agent, false); cross(c, k.bad); }],
  ["size not measured", (c, k) => car(c, k.agent, true, [4, 3])],
  ["neither size nor class measured", (c, k) => dot(c, k.agent)],
  ["where it was, 2 s", (c, k) => line(c, k.past, 1.5)],
  ["predicted; fainter = less probable", (c, k) => line(c, k.ahead, 2.5)],
  ["predicted 1, 2, 3 s ago for now", (c, k) => diamond(c, k.ghost)],
  ["selected: constant velocity", (c, k) => line(c, k.straight, 2, [2, 4])],
  ["selected: usual error at 1, 2, 3 s", (c, k) => circle(c, k.ahead)],
  ["half of the outcomes, if the model says", (c, k) => ellipse(c, k.ahead)],
];

/** Fills the list; again when colours change. */
export function showSigns(list, colours) {
  list.replaceChildren(...SIGNS.map(([words, draw]) => {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [88, 36];
    const context = canvas.getContext("2d");
    context.scale(2, 2);
    draw(context, colours);
    const item = document.createElement("li");
    item.append(canvas, words);
    return item;
  }));
}

function car(c, colour, filled, dash = []) {
  c.beginPath();
  for (const [x, y] of [[9, 4], [30, 4], [35, 9], [30, 14], [9, 14]]) c.lineTo(x, y);
  c.closePath();
  c.setLineDash(dash);
  c.fillStyle = c.strokeStyle = colour;
  c.lineWidth = 1.4;
  c.globalAlpha = dash.length ? 0.4 : 1;
  if (filled) c.fill();
  c.globalAlpha = 1;
  c.stroke();
}

function line(c, colour, width, dash = []) {
  c.strokeStyle = colour;
  c.lineWidth = width;
  c.setLineDash(dash);
  c.beginPath();
  c.moveTo(2, 13);
  c.quadraticCurveTo(22, 12, 42, 5);
  c.stroke();
}

function diamond(c, colour) {
  c.strokeStyle = colour;
  c.lineWidth = 1.4;
  c.beginPath();
  for (const [x, y] of [[14, 4], [19, 9], [14, 14], [9, 9]]) c.lineTo(x, y);
  c.closePath();
  c.moveTo(19, 9);
  c.lineTo(36, 9);
  c.stroke();
}

function circle(c, colour) {
  c.strokeStyle = colour;
  c.setLineDash([2, 3]);
  c.lineWidth = 1.4;
  c.beginPath();
  c.arc(22, 9, 7.5, 0, 2 * Math.PI);
  c.stroke();
}

function ellipse(c, colour) {
  c.fillStyle = colour;
  c.globalAlpha = 0.3;
  c.beginPath();
  c.ellipse(22, 9, 14, 6, 0, 0, 2 * Math.PI);
  c.fill();
}

function dot(c, colour) {
  c.fillStyle = colour;
  c.beginPath();
  c.arc(22, 9, 5, 0, 2 * Math.PI);
  c.fill();
}

function cross(c, colour) {
  c.strokeStyle = colour;
  c.lineWidth = 2;
  c.beginPath();
  c.moveTo(17, 5);
  c.lineTo(25, 13);
  c.moveTo(25, 5);
  c.lineTo(17, 13);
  c.stroke();
}

function arrow(c, colour) {
  c.strokeStyle = colour;
  c.lineWidth = 2;
  c.beginPath();
  for (const [x, y] of [[17, 6], [25, 9], [17, 12]]) c.lineTo(x, y);
  c.stroke();
}
