// The traces of a figure as SVG shapes: lines, points with error bars, boxes and bars.
const SVG = "http://www.w3.org/2000/svg";

function svg(name, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) if (value !== undefined) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

const SHAPES = {
  circle: "M0-5A5 5 0 1 0 0 5A5 5 0 1 0 0-5Z", square: "M-4.5-4.5H4.5V4.5H-4.5Z", diamond: "M0-6L6 0L0 6L-6 0Z",
  "triangle-up": "M0-6L5.6 4.5H-5.6Z", "triangle-down": "M0 6L5.6-4.5H-5.6Z",
  cross: "M-2-6H2V-2H6V2H2V6H-2V2H-6V-2H-2Z", x: "M-5-3L-3-5L0-2L3-5L5-3L2 0L5 3L3 5L0 2L-3 5L-5 3L-2 0Z",
  pentagon: "M0-6L5.7-1.9L3.5 4.9H-3.5L-5.7-1.9Z", hexagon: "M-3-5.2H3L6 0L3 5.2H-3L-6 0Z",
  star: "M0-6.5L1.8-2.2L6.2-2L2.8.9L4 5.2L0 2.8L-4 5.2L-2.8.9L-6.2-2L-1.8-2.2Z",
};

const inkOf = (colour) => (!colour || colour === "ink" ? "var(--ink)" : colour);
const each = (value, at) => (Array.isArray(value) ? value[at] : value);
const SEQUENCE = ["#b7d3ea", "#1b4f82"];  // from the first to the last of a series of numbers

/** Colour of the point `at`: a name, or a place between the two ends of a scale for a list of numbers. */
function pointColour(colours, at) {
  if (!Array.isArray(colours) || typeof colours.find((value) => value !== null) !== "number") return inkOf(each(colours, at));
  const known = colours.filter((value) => Number.isFinite(value));
  const low = Math.min(...known), share = (colours[at] - low) / (Math.max(...known) - low || 1);
  return `color-mix(in srgb, ${SEQUENCE[1]} ${Math.round(100 * share)}%, ${SEQUENCE[0]})`;
}

function lineShapes(trace, place) {
  let path = "", pen = false, last = null;
  const step = trace.line?.shape === "hv";
  trace.x.forEach((x, at) => {
    const point = place(x, trace.y[at]);
    if (point === null) { pen = false; return; }
    const turn = step && pen ? `H${point[0].toFixed(1)}` : "";
    path += `${turn}${pen ? "L" : "M"}${point[0].toFixed(1)} ${point[1].toFixed(1)}`;
    pen = true;
    last = point;
  });
  const dash = { dot: "2 4", dash: "6 4" }[trace.line?.dash];
  const style = `--c: ${inkOf(trace.line?.color)}`;
  const shapes = [];
  if (trace.fill === "tozeroy" && last) {
    const start = path.match(/M([\d.-]+)/)[1], base = place(trace.x.find((x) => x !== null), 0)?.[1];
    shapes.push(svg("path", { d: `${path}V${base}H${start}Z`, class: "area", style }));
  }
  shapes.push(svg("path", { d: path, class: "line", style, "stroke-width": trace.line?.width ?? 1.6, "stroke-dasharray": dash }));
  return shapes;
}

function errorBars(trace, place) {
  const bars = [];
  for (const [axis, spec] of [["x", trace.error_x], ["y", trace.error_y]]) {
    if (!spec?.array) continue;
    trace.x.forEach((x, at) => {
      const y = trace.y[at], plus = spec.array[at], minus = spec.arrayminus?.[at] ?? plus;
      if (!Number.isFinite(plus) || !Number.isFinite(minus)) return;
      const ends = axis === "x" ? [place(x - minus, y), place(x + plus, y)] : [place(x, y - minus), place(x, y + plus)];
      if (ends[0] === null || ends[1] === null) return;
      const [[a, b], [c, d]] = ends, cap = axis === "x" ? [0, 4] : [4, 0];
      const hat = (u, v) => `M${u - cap[0]} ${v - cap[1]}L${u + cap[0]} ${v + cap[1]}`;
      bars.push(svg("path", { d: `M${a} ${b}L${c} ${d}${hat(a, b)}${hat(c, d)}`, class: "whisker" }));
    });
  }
  return bars;
}

function pointShapes(trace, place) {
  const shapes = [], size = trace.marker?.size ?? 8;
  trace.x.forEach((x, at) => {
    const point = place(x, trace.y[at]);
    if (point === null) return;
    const symbol = each(trace.marker?.symbol, at) ?? "circle", open = symbol.endsWith("-open");
    const shape = SHAPES[symbol.replace("-open", "")] ?? SHAPES.circle, scale = each(size, at) / 10;
    const move = `translate(${point[0].toFixed(1)} ${point[1].toFixed(1)}) scale(${scale})`;
    const style = `--c: ${pointColour(trace.marker?.color ?? trace.line?.color, at)}`;
    shapes.push(svg("path", { d: shape, transform: move, class: open ? "point open" : "point", style, opacity: trace.marker?.opacity }));
  });
  return shapes;
}

/** Share of the way through sorted numbers, by linear interpolation. */
function quantile(sorted, share) {
  const at = (sorted.length - 1) * share, low = Math.floor(at);
  return sorted[low] + (sorted[Math.min(low + 1, sorted.length - 1)] - sorted[low]) * (at - low);
}

/** A box of given quartiles and whiskers, or of the points behind it, which are drawn too. */
function boxShapes(trace, place, room) {
  const style = `--c: ${inkOf(trace.marker?.color)}`, shapes = [], across = trace.orientation === "h";
  const half = room * 0.36 * (trace.width ?? 1);
  const spot = (value) => (across ? place(value, trace.name) : place(trace.at ?? trace.name, value));
  const boxes = trace.quartiles ?? [null];
  boxes.forEach((given, number) => {
    const values = (across ? trace.x : trace.y)?.filter((value) => value !== null).sort((a, b) => a - b) ?? [];
    const five = given ?? (values.length > 3 ? [0, 0.25, 0.5, 0.75, 1].map((share) => quantile(values, share)) : null);
    if (!five) return;
    const spots = five.map((value) => (trace.quartiles ? place(trace.x[number], value) : spot(value)));
    if (spots.some((point) => point === null)) return;
    const along = across ? 0 : 1, side = spots[0][1 - along] + (trace.shift ?? 0) * room;
    const xy = (p, q) => (across ? `${p.toFixed(1)} ${q.toFixed(1)}` : `${q.toFixed(1)} ${p.toFixed(1)}`);
    const [low, first, middle, third, high] = spots.map((point) => point[along]);
    const bar = (p) => `M${xy(p, side - half)}L${xy(p, side + half)}`;
    const d = `M${xy(first, side - half)}L${xy(third, side - half)}L${xy(third, side + half)}L${xy(first, side + half)}Z`;
    shapes.push(svg("path", { d: `M${xy(low, side)}L${xy(first, side)}M${xy(third, side)}L${xy(high, side)}`, class: "stem", style }));
    shapes.push(svg("path", { d, class: "box", style }), svg("path", { d: bar(middle), class: "middle", style }));
  });
  if (!trace.quartiles)
    (across ? trace.x : trace.y).forEach((value, at) => {
      const point = spot(value);
      if (point === null) return;
      point[across ? 1 : 0] += (((at * 0.618) % 1) - 0.5) * half;
      shapes.push(svg("circle", { cx: point[0].toFixed(1), cy: point[1].toFixed(1), r: 3, class: "point", style, opacity: 0.75 }));
    });
  return shapes;
}

/** Bars from `base` (stacked ones) or from zero. */
function barShapes(trace, place, room) {
  const across = trace.orientation === "h";
  return (across ? trace.y : trace.x).map((name, at) => {
    const value = (across ? trace.x : trace.y)[at], base = trace.base?.[at] ?? 0;
    const from = across ? place(base, name) : place(name, base), to = across ? place(base + value, name) : place(name, base + value);
    if (from === null || to === null) return "";
    const half = (trace.width ? trace.width * room : room * 0.7) / 2, shift = (trace.shift ?? 0) * room;
    const [x, y, w, h] = across
      ? [Math.min(from[0], to[0]), from[1] - half + shift, Math.abs(to[0] - from[0]), 2 * half]
      : [from[0] - half + shift, Math.min(from[1], to[1]), 2 * half, Math.abs(to[1] - from[1])];
    const style = `--c: ${inkOf(each(trace.marker?.color, at))}`;
    return svg("rect", { x: x.toFixed(1), y: y.toFixed(1), width: Math.max(w, 0.5).toFixed(1), height: h.toFixed(1), class: "bar", style, opacity: trace.marker?.opacity });
  });
}
