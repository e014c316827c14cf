// The cycles at hand and the moment that is shown. Times are the service's, in seconds.

const KEPT_S = 60;
const CHUNK = 50; // cycles that are asked for at once, of a file
const KEPT_CHUNKS = 30;
const ASK_AGAIN_MS = 2000;
const MOVES_WITHIN_S = 0.5; // between cycles farther apart nobody is drawn on the way

/** The last minute of a running service. */
export class LiveTimeline {
  constructor() {
    this.mode = "live";
    this.cycles = [];
    this.live = true;
    this.playing = true;
    this.speed = 1;
    this.lags = [];
    this.arrived = 0;
  }

  get first() { return this.cycles[0]?.time_s ?? 0; }
  get last() { return this.cycles.at(-1)?.time_s ?? 0; }
  get empty() { return this.cycles.length === 0; }

  /** Takes a cycle, at `now` (s, the page's clock). Earlier ones may come later. */
  add(cycle, now) {
    const newest = this.cycles.at(-1);
    if (newest && cycle.stream < newest.stream) return;
    if (newest && cycle.stream > newest.stream) {
      this.cycles = [];
      this.lags = [];
      this.time = undefined;
    }
    const at = this.#after(cycle.time_s);
    if (this.cycles[at - 1]?.cycle === cycle.cycle) return;
    this.cycles.splice(at, 0, cycle);
    if (at === this.cycles.length - 1) {
      this.arrived = now;
      this.lags.push(now - cycle.time_s);
      if (this.lags.length > 50) this.lags.shift();
    }
    const oldest = this.last - KEPT_S;
    let gone = 0;
    while (this.cycles[gone].time_s < oldest) gone += 1;
    if (gone) this.cycles.splice(0, gone);
  }

  /** How far behind the newest measurement that could be shown we are: one period and its jitter. */
  get delay() {
    const n = this.cycles.length;
    if (n < 3) return 0.1;
    const times = this.cycles.slice(-12).map((cycle) => cycle.time_s);
    const gaps = times.slice(1).map((time, i) => time - times[i]).sort((a, b) => a - b);
    return Math.min(0.3, gaps[Math.floor(0.9 * (gaps.length - 1))] + 0.02);
  }

  /** The moment to show at `now`, `passed` seconds after the last picture. */
  moment(now, passed) {
    if (this.empty) return null;
    if (this.live) {
      const lag = Math.min(...this.lags, now - this.last);
      this.time = Math.min(this.last, Math.max(this.time ?? 0, now - lag - this.delay));
      if (this.time < this.last - 1) this.time = this.last - this.delay;
    } else if (this.playing) {
      this.time = Math.min(this.last, this.time + passed * this.speed);
      if (this.time >= this.last - this.delay) this.live = true;
    }
    this.time = Math.max(this.time ?? this.last, this.first);
    return pick(this.cycles, this.time, this.playing || this.live);
  }

  pause() { this.playing = false; this.live = false; this.#settle(); }
  play() { this.playing = true; if (this.time >= this.last - 0.2) this.live = true; }
  goLive() { this.playing = true; this.live = true; }
  seek(time) { this.live = false; this.time = time; if (!this.playing) this.#settle(); }

  step(cycles) {
    this.pause();
    const at = this.#after(this.time) - 1 + cycles;
    const cycle = this.cycles[Math.max(0, Math.min(this.cycles.length - 1, at))];
    if (cycle) this.time = cycle.time_s;
  }

  /** The cycle nearest to a time, or null. */
  near(time) {
    const at = this.#after(time);
    const [before, after] = [this.cycles[at - 1], this.cycles[at]];
    if (!before || !after) return before ?? after ?? null;
    return time - before.time_s <= after.time_s - time ? before : after;
  }

  #settle() {
    const at = Math.max(0, this.#after(this.time ?? 0) - 1);
    if (this.cycles[at]) this.time = this.cycles[at].time_s;
  }

  #after(time) { return after(this.cycles.length, (i) => this.cycles[i].time_s, time); }
}

/** A file: the times of all its cycles, and those cycles that were asked for. */
export class FileTimeline {
  constructor(ask) {
    this.mode = "file";
    this.ask = ask;
    this.times = [];
    this.chunks = new Map();
    this.asked = new Map();
    this.live = false;
    this.playing = true;
    this.speed = 1;
    this.lanes = -1;
    this.delay = 0;
  }

  get first() { return this.times[0] ?? 0; }
  get last() { return this.times.at(-1) ?? 0; }
  get empty() { return this.times.length === 0; }

  /** What the server has read so far. */
  index(message) { this.times = message.times_s; this.done = message.done; }

  add(cycle) {
    const at = Math.max(0, after(this.times.length, (i) => this.times[i], cycle.time_s + 1e-3) - 1);
    const number = Math.floor(at / CHUNK);
    if (!this.chunks.has(number)) this.chunks.set(number, new Array(CHUNK));
    this.chunks.get(number)[at % CHUNK] = cycle;
    if (this.chunks.size > KEPT_CHUNKS) this.#forget();
  }

  moment(now, passed) {
    if (this.empty) return null;
    this.time = Math.max(this.time ?? this.first, this.first);
    const at = this.#at(this.time);
    this.#want(at, now);
    const cycle = this.#cycle(at);
    if (!cycle) return this.shown ?? null; // what was shown last, until it has come
    if (this.playing) {
      this.time = Math.min(this.last, this.time + passed * this.speed);
      if (this.time >= this.last && this.done) this.playing = false;
    }
    const next = this.#cycle(at + 1);
    this.shown = pick(next ? [cycle, next] : [cycle], this.time, this.playing);
    return this.shown;
  }

  pause() { this.playing = false; this.time = this.times[this.#at(this.time ?? 0)] ?? 0; }
  play() { if (this.time >= this.last) this.time = this.first; this.playing = true; }
  goLive() { this.playing = false; this.time = this.last; }
  seek(time) { this.time = time; if (!this.playing) this.pause(); }

  step(cycles) {
    this.pause();
    const at = this.#at(this.time) + cycles;
    this.time = this.times[Math.max(0, Math.min(this.times.length - 1, at))];
  }

  near(time) { return this.#cycle(this.#at(time + 0.05)) ?? null; }

  #at(time) { return Math.max(0, after(this.times.length, (i) => this.times[i], time + 1e-6) - 1); }
  #cycle(at) { return this.chunks.get(Math.floor(at / CHUNK))?.[at % CHUNK]; }

  /** Asks for what is missing from 3 s before to 5 s after the moment. */
  #want(at, now) {
    for (let i = Math.max(0, at - 30); i <= Math.min(this.times.length - 1, at + CHUNK); i += 1) {
      if (this.#cycle(i)) continue;
      const number = Math.floor(i / CHUNK);
      if (1000 * (now - (this.asked.get(number) ?? -Infinity)) > ASK_AGAIN_MS) {
        this.asked.set(number, now);
        this.ask({ first: number * CHUNK, last: (number + 1) * CHUNK, lanes: this.lanes });
      }
    }
  }

  #forget() {
    const here = Math.floor(this.#at(this.time ?? 0) / CHUNK);
    const numbers = [...this.chunks.keys()].sort((a, b) => Math.abs(b - here) - Math.abs(a - here));
    for (const number of numbers.slice(0, this.chunks.size - KEPT_CHUNKS)) {
      this.chunks.delete(number);
      this.asked.delete(number);
    }
  }
}

/** How many of `count` ordered times are not later than `time`. */
function after(count, timeOf, time) {
  let [low, high] = [0, count];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (timeOf(middle) <= time) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** The cycle that holds at a time, the next one, and how far it is on the way there (0 to 1). */
function pick(cycles, time, moving) {
  const at = Math.max(0, after(cycles.length, (i) => cycles[i].time_s, time) - 1);
  const [cycle, next] = [cycles[at], cycles[at + 1]];
  const gap = next ? next.time_s - cycle.time_s : Infinity;
  if (!moving || gap > MOVES_WITHIN_S || next.stream !== cycle.stream) {
    return { cycle, next: null, part: 0, time };
  }
  return { cycle, next, part: Math.max(0, Math.min(1, (time - cycle.time_s) / gap)), time };
}
