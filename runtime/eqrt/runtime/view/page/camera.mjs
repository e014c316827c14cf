// Where the picture is taken from: map metres to pixels of the screen.

const LEAST = 0.4; // pixels per metre
const MOST = 60;
const SHOWN_M = 130; // along the way, when the page opens

/** What the screen's axes can be held to, in the order in which a key goes through them. */
export const TURNS = ["right", "up", "north"];

export class Camera {
  constructor() {
    this.x = 0;
    this.y = 0;
    this.scale = 0; // pixels per metre; 0 = not chosen yet
    this.turn = 0; // radians, counter-clockwise, from the map's axes to the screen's
    this.axis = "up"; // where the ego vehicle drives to on the screen, or "north"
    this.follow = "ego"; // or "selected", or "free"
    this.width = 1;
    this.height = 1;
  }

  resize(width, height) {
    this.width = width;
    this.height = height;
    if (this.scale) return;
    this.axis = width > height ? "right" : "up"; // traffic is longer than wide
    this.scale = Math.max(LEAST, Math.max(width, height) / SHOWN_M);
  }

  /** Pixel where (x, y) of the camera is: off the middle when there is more to see ahead. */
  get middle() {
    const ahead = this.follow === "ego" ? this.axis : "north";
    return [this.width * (ahead === "right" ? 0.36 : 0.5), this.height * (ahead === "up" ? 0.66 : 0.5)];
  }

  /** Looks at a place; `yaw` is where the ego vehicle heads to, null = not known. */
  lookAt(x, y, yaw) {
    if (this.follow !== "free") {
      this.x = x;
      this.y = y;
    }
    const held = { up: Math.PI / 2 - yaw, right: -yaw, north: 0 };
    this.turn = yaw === null ? 0 : held[this.axis];
  }

  /** [a, b, c, d, e, f] for setTransform: metres from (ox, oy) of the map to pixels, times `ratio`. */
  transform(ox, oy, ratio = 1) {
    const [cos, sin] = [Math.cos(this.turn) * this.scale, Math.sin(this.turn) * this.scale];
    const [dx, dy] = [ox - this.x, oy - this.y];
    const [mx, my] = this.middle;
    return [cos, -sin, -sin, -cos, mx + cos * dx - sin * dy, my - sin * dx - cos * dy].map(
      (value) => value * ratio,
    );
  }

  /** Pixels of a place on the map. */
  pixels(x, y) {
    const [cos, sin] = [Math.cos(this.turn) * this.scale, Math.sin(this.turn) * this.scale];
    const [dx, dy] = [x - this.x, y - this.y];
    const [mx, my] = this.middle;
    return [mx + cos * dx - sin * dy, my - sin * dx - cos * dy];
  }

  /** Place on the map of pixels. */
  place(px, py) {
    const [mx, my] = this.middle;
    const [rx, ry] = [(px - mx) / this.scale, (my - py) / this.scale];
    const [cos, sin] = [Math.cos(this.turn), Math.sin(this.turn)];
    return [this.x + cos * rx + sin * ry, this.y - sin * rx + cos * ry];
  }

  zoom(factor, px = this.middle[0], py = this.middle[1]) {
    const [x, y] = this.place(px, py);
    this.scale = Math.max(LEAST, Math.min(MOST, this.scale * factor));
    if (this.follow !== "free") return;
    const [nx, ny] = this.place(px, py);
    this.x += x - nx;
    this.y += y - ny;
  }

  /** Moves the picture by pixels; from then on it follows nobody. */
  pan(dx, dy) {
    const centre = this.place(this.width / 2, this.height / 2);
    if (this.follow !== "free") {
      this.follow = "free"; // moves `middle` to the centre, and the picture must not jump
      [this.x, this.y] = centre;
    }
    [this.x, this.y] = this.place(this.width / 2 - dx, this.height / 2 - dy);
  }

  /** The box on the map that the screen shows: [x0, y0, x1, y1]. */
  get box() {
    const corners = [[0, 0], [this.width, 0], [0, this.height], [this.width, this.height]]
      .map(([px, py]) => this.place(px, py));
    const [xs, ys] = [corners.map((c) => c[0]), corners.map((c) => c[1])];
    return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  }
}
