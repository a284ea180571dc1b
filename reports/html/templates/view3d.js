// A track in a 3-D view, coloured by its error: dragged to turn, with the true path in grey and a marker that follows the slider.
const RAMP = [[38, 120, 190], [60, 170, 140], [236, 190, 70], [222, 96, 52], [160, 28, 60]];

function rampColour(share) {
  const at = Math.max(0, Math.min(1, share)) * (RAMP.length - 1), low = Math.min(Math.floor(at), RAMP.length - 2), part = at - low;
  return `rgb(${RAMP[low].map((value, channel) => Math.round(value + (RAMP[low + 1][channel] - value) * part)).join(" ")})`;
}

class View3D {
  /** Tracks are lists of three lists of metres; `errors` in mm colours the first, up to `most`. */
  constructor(canvas, track, truth, errors, most) {
    Object.assign(this, { canvas, track, truth, errors, most, turn: -0.6, tilt: 0.45, at: track[0].length - 1 });
    const all = track.map((list, axis) => [...list, ...(truth?.[axis] ?? [])].filter((value) => value !== null));
    this.low = all.map((list) => Math.min(...list));
    this.high = all.map((list) => Math.max(...list));
    this.centre = this.low.map((low, axis) => (low + this.high[axis]) / 2);
    this.reach = Math.max(0.01, ...this.low.map((low, axis) => this.high[axis] - low)) / 2;
    let last = null;
    canvas.addEventListener("pointerdown", (event) => { last = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); });
    canvas.addEventListener("pointerup", () => { last = null; });
    canvas.addEventListener("pointermove", (event) => {
      if (!last) return;
      this.turn += (event.clientX - last[0]) / 120;
      this.tilt = Math.max(-1.5, Math.min(1.5, this.tilt + (event.clientY - last[1]) / 120));
      last = [event.clientX, event.clientY];
      this.draw();
    });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-0.15, 0], ArrowRight: [0.15, 0], ArrowUp: [0, 0.15], ArrowDown: [0, -0.15] }[event.key];
      if (!step) return;
      event.preventDefault();
      this.turn += step[0];
      this.tilt = Math.max(-1.5, Math.min(1.5, this.tilt + step[1]));
      this.draw();
    });
    addEventListener("themechange", () => this.draw());
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  project(x, y, z) {
    const [a, b, c] = [x - this.centre[0], y - this.centre[1], z - this.centre[2]];
    const u = a * Math.cos(this.turn) - b * Math.sin(this.turn), w = a * Math.sin(this.turn) + b * Math.cos(this.turn);
    const v = c * Math.cos(this.tilt) - w * Math.sin(this.tilt), scale = 0.62 * Math.min(this.width, this.height) / (2 * this.reach) * 1.25;
    return [this.width / 2 + u * scale, this.height / 2 - v * scale];
  }

  line(points, colour, width) {
    const { pen } = this;
    if (points.some((point) => point[0] === null)) return;
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.beginPath();
    points.forEach((point, at) => (at ? pen.lineTo(...this.project(...point)) : pen.moveTo(...this.project(...point))));
    pen.stroke();
  }

  draw() {
    const { canvas } = this, ratio = devicePixelRatio || 1;
    this.width = canvas.clientWidth;
    this.height = canvas.clientHeight;
    if (!this.width) return;
    canvas.width = this.width * ratio;
    canvas.height = this.height * ratio;
    this.pen = canvas.getContext("2d");
    this.pen.scale(ratio, ratio);
    this.pen.lineCap = this.pen.lineJoin = "round";
    const probe = getComputedStyle(canvas), soft = probe.color, grid = probe.borderTopColor;
    this.floor(grid, soft);
    const points = (track) => track[0].map((_, at) => track.map((list) => list[at]));
    const path = points(this.track), true_ = this.truth ? points(this.truth) : [];
    for (let at = 1; at < true_.length; at++) this.line([true_[at - 1], true_[at]], soft, 1.2);
    for (let at = 1; at < path.length; at++) this.line([path[at - 1], path[at]], this.errors ? rampColour(this.errors[at] / this.most) : soft, 2.6);
    const here = path[Math.min(this.at, path.length - 1)];
    if (here[0] === null) return;
    const [x, y] = this.project(...here);
    this.pen.fillStyle = soft;
    this.pen.beginPath();
    this.pen.arc(x, y, 5, 0, 7);
    this.pen.fill();
  }

  /** A grid below the track with round steps, and its step in words. */
  floor(grid, soft) {
    const step = niceStep(2 * this.reach, 5), { low, centre, reach } = this, z = low[2];
    const from = [0, 1].map((axis) => Math.floor((centre[axis] - reach) / step) * step), count = Math.ceil((2 * reach) / step) + 1;
    for (let at = 0; at <= count; at++) {
      this.line([[from[0] + at * step, from[1], z], [from[0] + at * step, from[1] + count * step, z]], grid, 1);
      this.line([[from[0], from[1] + at * step, z], [from[0] + count * step, from[1] + at * step, z]], grid, 1);
    }
    this.pen.fillStyle = soft;
    this.pen.font = FONT;
    this.pen.fillText(`grid ${tickText(step)} m`, 10, this.height - 10);
  }
}
