// Numbers and classes beside agents; where there is no room for one, it is left out.

import { FONT } from "./scene.mjs";

const HEIGHT = 13;
const PLACES = [[0, -1], [0, 1], [1, 0], [-1, 0], [1, -1], [-1, -1], [1, 1], [-1, 1]]; // around an agent
const GAP = 3; // px
const WORDS_FROM = 5.5; // pixels per metre from which the class is written too
const MARGIN = 2;

export class Labels {
  constructor() {
    this.widths = new Map();
    this.places = new Map(); // track -> its place last time, so that labels do not flicker
    this.shown = 0;
  }

  /** Nearest to the ego vehicle first, the selected one before all. */
  draw(context, agents, { cycle, camera, colours, selected, keepFree }) {
    context.font = FONT;
    context.textBaseline = "middle";
    const range = (agent) => (agent.id === selected ? -1 : cycle.agents.range_m[agent.row] ?? 0);
    const order = agents
      .filter(({ px, py }) => px > -20 && py > -20 && px < camera.width + 20 && py < camera.height + 20)
      .sort((a, b) => range(a) - range(b));
    const taken = order.map(({ px, py, halfX, halfY }) => [px - halfX, py - halfY, px + halfX, py + halfY]);
    if (keepFree) taken.push(keepFree);
    const places = new Map();
    this.boxes = [];
    for (const agent of order) {
      const text = this.#text(agent, cycle, camera, selected);
      const width = this.#width(context, text);
      const before = this.places.get(agent.id) ?? 0;
      for (let i = 0; i < PLACES.length; i += 1) {
        const place = (before + i) % PLACES.length;
        const box = boxAt(agent, PLACES[place], width);
        if (taken.some((other) => overlap(box, other))) continue;
        taken.push(box);
        this.boxes.push(box);
        places.set(agent.id, place);
        this.#write(context, text, box, agent.id === selected ? colours.chosen : colours.text, colours);
        break;
      }
    }
    this.places = places;
    this.shown = places.size;
  }

  #text(agent, cycle, camera, selected) {
    const kind = cycle.agents.kind[agent.row];
    const short = kind === "object" || (camera.scale < WORDS_FROM && agent.id !== selected);
    return short ? `${agent.id}` : `${agent.id} ${kind}`;
  }

  #width(context, text) {
    let width = this.widths.get(text);
    if (width === undefined) {
      if (this.widths.size > 2000) this.widths.clear();
      width = context.measureText(text).width;
      this.widths.set(text, width);
    }
    return width;
  }

  #write(context, text, [x, y], colour, colours) {
    context.textAlign = "left";
    context.lineWidth = 3;
    context.lineJoin = "round";
    context.strokeStyle = colours.ground;
    context.strokeText(text, x + MARGIN, y + HEIGHT / 2 + 1);
    context.fillStyle = colour;
    context.fillText(text, x + MARGIN, y + HEIGHT / 2 + 1);
  }
}

function boxAt({ px, py, halfX, halfY }, [sideX, sideY], width) {
  const [w, h] = [width / 2 + MARGIN, HEIGHT / 2];
  const x = px + sideX * (halfX + GAP + w);
  const y = py + sideY * (sideX ? Math.min(halfY, 4) + h : halfY + GAP + h);
  return [x - w, y - h, x + w, y + h];
}

function overlap(a, b) {
  return a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3];
}
