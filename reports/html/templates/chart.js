// Figures: plotly-like specifications (data and layout) drawn as SVG that follows theme and width.
const DEFAULT_COLOURS = ["#1f6fb4", "#d9542b", "#2a9d6f", "#8a5cc2"];
const NARROW = 620, FONT = "12.5px Inter, system-ui, sans-serif";
const ruler = document.createElement("canvas").getContext("2d");
const COUNTS = Array.from({ length: 41 }, (_, step) => 2 + step / 4);  // of ticks: how many fit is known only once the room for them is
const widthOf = (text) => { ruler.font = FONT; return ruler.measureText(text).width; };
const plain = (text) => String(text ?? "").replace(/<b>|<\/b>/g, "").replace(/&lt;/g, "<").replace(/&gt;/g, ">").replace(/&amp;/g, "&");
/** The opposite: a name that a figure shows as it stands. */
const verbatim = (text) => text.replace(/&/g, "&amp;").replace(/</g, "&lt;");
const linesOf = (text) => String(text ?? "").split("<br>").map(plain);

function wrapTo(text, room) {
  const lines = [""];
  for (const word of linesOf(text).join(" ").split(" ")) {
    const longer = `${lines.at(-1)} ${word}`.trim();
    if (lines.at(-1) && widthOf(longer) > room) lines.push(word); else lines[lines.length - 1] = longer;
  }
  return lines;
}

/** A text cut to a width in pixels. */
function fitted(text, room) {
  let cut = text;
  while (cut && widthOf(cut) > room) cut = cut.slice(0, -1);
  return cut === text ? text : `${cut.slice(0, -1).trim()}…`;
}

/** A text whose beginning is cut to a width in pixels: names of sequences differ at their end. */
function ending(text, room) {
  let cut = text;
  while (cut && widthOf(cut) > room) cut = cut.slice(1);
  return cut === text ? text : `…${cut.slice(1).trim()}`;
}

const write = (lines, x, y, more = {}) => {
  const text = svg("text", { x, y, ...more });
  lines.forEach((line, at) => text.append(svg("tspan", { x, dy: at ? "1.2em" : 0 }, line)));
  return text;
};

/** The panels of a figure: every pair of axes that a trace names. */
function panelsOf(figure) {
  const found = new Map();
  for (const trace of figure.data) {
    const x = trace.xaxis ?? "x", y = trace.yaxis ?? (found.has(`${x} y${x.slice(1)}`) || figure.layout[`yaxis${x.slice(1)}`] ? `y${x.slice(1)}` : "y");
    const key = `${x} ${y}`;
    if (!found.has(key)) found.set(key, { traces: [], x: x.slice(1), y: y.slice(1) });
    found.get(key).traces.push(trace);
  }
  return [...found.values()].map((panel) => ({
    ...panel, grouped: figure.layout.barmode === "group", xSpec: figure.layout[`xaxis${panel.x}`] ?? {}, ySpec: figure.layout[`yaxis${panel.y}`] ?? {},
  }));
}

const spreads = (trace, axis) => {
  const values = [], error = trace[`error_${axis}`], given = trace[axis] ?? [];
  given.forEach((value, at) => {
    values.push(value);
    if (typeof value === "number" && error?.array?.[at] != null)
      values.push(value + error.array[at], value - (error.arrayminus?.[at] ?? error.array[at]));
    if (trace.type === "bar" && trace.base && (axis === "x") === (trace.orientation === "h")) values.push(trace.base[at] + value, trace.base[at]);
  });
  if (trace.quartiles && axis === "y") values.push(...trace.quartiles.flat());
  if (trace.type === "box" && axis === (trace.orientation === "h" ? "y" : "x") && !trace.quartiles) return [trace.name];
  return values.filter((value) => value !== null);
};

function scalesOf(panel, shown) {
  const traces = panel.traces.filter(shown), all = traces.length ? traces : panel.traces;
  const zero = (axis) => all.some((t) => t.type === "bar" && (t.orientation === "h") === (axis === "x")) || all.some((t) => t.fill && axis === "y");
  const gather = (axis) => (panel[`${axis}Spec`].type === "category" ? panel.traces : all).flatMap((trace) => spreads(trace, axis));
  panel.sx = makeScale(panel.xSpec, gather("x"), zero("x"));
  panel.sy = makeScale(panel.ySpec, gather("y"), zero("y"));
}

const LONGEST_NAME = 130;

/** Names below the axis: broken at their signs where they are too long, upright where that does not help either. */
function nameBelow(panel) {
  const room = panel.width / panel.sx.categories.length - 8, names = new Map();
  for (const name of panel.sx.categories) {
    const lines = [""];
    for (const piece of plain(name).split(/(?=[?&\[ _])/)) {
      if (lines.at(-1) && widthOf(lines.at(-1) + piece) > room) lines.push(piece.trim()); else lines[lines.length - 1] += piece;
    }
    names.set(name, lines);
  }
  const widest = Math.max(0, ...[...names.values()].flat().map(widthOf));
  panel.upright = widest > room;
  panel.names = panel.upright ? new Map([...names.keys()].map((name) => [name, [ending(plain(name), LONGEST_NAME)]])) : names;
  const lines = [...panel.names.values()];
  panel.foot = panel.upright ? 14 + Math.max(...lines.map(([line]) => widthOf(line))) : 8 + 15 * Math.max(...lines.map((each) => each.length));
}

/** Where the panels lie, for a width in pixels: side by side, or below each other where that is too narrow. */
function arrange(panels, layout, width) {
  const narrow = width < NARROW, columns = Math.min(panels.length, narrow ? layout.narrowColumns ?? 1 : layout.columns ?? panels.length);
  const gap = 14, outer = (width - gap * (columns - 1)) / columns;
  let top = 0;
  for (let start = 0; start < panels.length; start += columns) {
    const row = panels.slice(start, start + columns);
    let bottom = top;
    row.forEach((panel, column) => {
      const named = panel.sy.kind === "category";
      const longest = named ? Math.max(...panel.sy.categories.flatMap(linesOf).map(widthOf)) : 0;
      panel.inside = named && (narrow || longest > width * 0.34);
      const ticks = named ? [] : COUNTS.flatMap((count) => panel.sy.ticks(count)).map(tickText);
      const left = named ? (panel.inside ? 8 : longest + 14) : Math.max(28, ...ticks.map((text) => widthOf(text) + 12));
      panel.left = column * (outer + gap) + left;
      panel.width = Math.max(outer - left - 12, 40);
      panel.titleLines = wrapTo(panel.ySpec.title?.text ?? "", outer - 10);
      panel.xTitle = wrapTo(panel.xSpec.title?.text ?? "", panel.width + left);
      const head = panel.titleLines[0] ? 8 + 15 * panel.titleLines.length : 10;
      panel.top = top + head + 6;
      const equal = panel.ySpec.scaleanchor !== undefined;
      const wanted = named ? Math.max(layout.height - 100, (panel.inside ? 44 : 30) * panel.sy.categories.length) : Math.min((layout.height ?? 420) - 100, narrow ? 250 : 400);
      panel.height = equal ? panel.width : Math.max(wanted, 90);
      panel.foot = 22;
      if (panel.sx.kind === "category") nameBelow(panel);
      bottom = Math.max(bottom, panel.top + panel.height + panel.foot + (panel.xTitle[0] ? 18 * panel.xTitle.length : 0) + 6);
    });
    top = bottom + 4;
  }
  return top;
}

function axesOf(panel) {
  const { left, top, width, height, sx, sy } = panel, group = svg("g", { class: "axes" }), bottom = top + height;
  const reversed = panel.ySpec.autorange === "reversed";
  panel.place = (x, y) => {
    const a = sx.at(x), b = sy.at(y);
    if (x === null || y === null || !Number.isFinite(a) || !Number.isFinite(b)) return null;
    return [left + a * width, reversed ? top + b * height : bottom - b * height];
  };
  if (sx.kind === "category") {
    const room = width / sx.categories.length;
    for (const name of sx.categories) {
      const x = left + sx.at(name) * width;
      const turn = panel.upright ? { transform: `rotate(-90 ${x} ${bottom + 8}) translate(0 4)`, "text-anchor": "end" } : { "text-anchor": "middle" };
      group.append(write(panel.names.get(name), x, bottom + (panel.upright ? 8 : 16), turn));
      if (room > 24) group.append(svg("path", { d: `M${x + room / 2} ${top}V${bottom}`, class: "grid" }));
    }
  } else
    for (const tick of sx.ticks(Math.max(2, width / 70))) {
      const x = left + sx.at(tick) * width, text = tickText(tick), within = Math.min(x, left + width + 10 - widthOf(text) / 2);
      group.append(svg("path", { d: `M${x} ${top}V${bottom}`, class: "grid" }), write([text], within, bottom + 16, { "text-anchor": "middle" }));
    }
  if (sy.kind === "category") {
    for (const name of sy.categories) {
      const y = reversed ? top + sy.at(name) * height : bottom - sy.at(name) * height, lines = linesOf(name);
      group.append(svg("path", { d: `M${left} ${y}H${left + width}`, class: "grid" }));
      group.append(panel.inside ? write([fitted(lines.join(" "), width)], left, y - 9, { class: "inside" })
        : write(lines, left - 8, y + 4 - 7 * (lines.length - 1), { "text-anchor": "end", class: "name" }));
    }
  } else
    for (const tick of sy.ticks(Math.max(2, height / 42))) {
      const y = reversed ? top + sy.at(tick) * height : bottom - sy.at(tick) * height;
      group.append(svg("path", { d: `M${left} ${y}H${left + width}`, class: "grid" }), write([tickText(tick)], left - 6, y + 4, { "text-anchor": "end" }));
    }
  group.append(svg("path", { d: `M${left} ${top}V${bottom}H${left + width}`, class: "frame" }));
  if (panel.titleLines[0]) group.append(write(panel.titleLines, panel.inside || sy.kind === "category" ? left : Math.max(left - 24, 2), top - 15 * (panel.titleLines.length - 1) - 9, { class: "title" }));
  if (panel.xTitle[0]) group.append(write(panel.xTitle, left + width / 2, bottom + panel.foot + 14, { class: "title", "text-anchor": "middle" }));
  return group;
}

function guidesOf(panel, layout) {
  const { left, top, width, height } = panel, group = svg("g");
  for (const shape of layout.shapes ?? []) {
    if ((shape.xref ?? "x") !== "paper" && (shape.xref ?? `x${panel.x}`) !== `x${panel.x}`) continue;
    const at = shape.x0 === shape.x1 ? panel.place(shape.x0, panel.sy.kind === "category" ? panel.sy.categories[0] : panel.sy.back(0.5)) : panel.place(panel.sx.back?.(0.5), shape.y0);
    if (at === null) continue;
    const d = shape.x0 === shape.x1 ? `M${at[0]} ${top}V${top + height}` : `M${left} ${at[1]}H${left + width}`;
    group.append(svg("path", { d, class: "guide" }));
  }
  for (const note of layout.annotations ?? []) {
    const at = panel.place(note.x, panel.sy.back?.(0.5));
    if (at !== null && note.xref === `x${panel.x}` && note.yref === "paper") group.append(write([plain(note.text)], at[0] + 5, top + 12, { class: "note-text" }));
  }
  return group;
}

const chartIsGrouped = (panel) => panel.grouped && panel.traces.every((trace) => trace.type === "bar");

function shapesOf(panel, shown) {
  const { left, top, width, height, place, sx, sy } = panel, group = svg("g");
  const clip = `clip-${shapesOf.count = (shapesOf.count ?? 0) + 1}`;
  group.append(svg("clipPath", { id: clip }, svg("rect", { x: left - 7, y: top - 7, width: width + 14, height: height + 14 })));
  const inner = svg("g", { "clip-path": `url(#${clip})` });
  const room = sy.kind === "category" ? height / sy.categories.length : sx.kind === "category" ? width / sx.categories.length : width / Math.max(1, ...panel.traces.map((t) => t.x?.length ?? 1));
  const visible = panel.traces.filter(shown);
  if (chartIsGrouped(panel)) visible.forEach((trace, at) => Object.assign(trace, { width: 0.8 / visible.length, shift: ((at + 0.5) / visible.length - 0.5) * 0.8 }));
  for (const trace of visible) {
    if (trace.type === "bar") inner.append(...barShapes(trace, place, room));
    else if (trace.type === "box") inner.append(...boxShapes(trace, place, room));
    else {
      if ((trace.mode ?? "lines").includes("lines")) inner.append(...lineShapes(trace, place));
      inner.append(...errorBars(trace, place));
      if ((trace.mode ?? "").includes("markers")) inner.append(...pointShapes(trace, place));
    }
  }
  group.append(inner);
  return group;
}

/** Optuna's figures hold their numbers as bytes of a type. */
function decoded(value) {
  if (Array.isArray(value)) return value.map(decoded);
  if (!value || typeof value !== "object") return value;
  if (typeof value.bdata !== "string") return Object.fromEntries(Object.entries(value).map(([name, part]) => [name, decoded(part)]));
  const bytes = Uint8Array.from(atob(value.bdata), (letter) => letter.charCodeAt(0));
  const types = { f8: Float64Array, f4: Float32Array, i4: Int32Array, u4: Uint32Array, i2: Int16Array, u2: Uint16Array, i1: Int8Array, u1: Uint8Array };
  return Array.from(new types[value.dtype](bytes.buffer));
}

/** Draw a figure into its element, with a legend that shows and hides, and values where the pointer rests. */
function drawChart(element, given) {
  const figure = decoded(given);
  figure.data.forEach((trace, at) => {
    if (!trace.marker?.color && !trace.line?.color) trace.line = { ...trace.line, color: DEFAULT_COLOURS[at % DEFAULT_COLOURS.length] };
  });
  const layout = figure.layout ?? {}, hidden = new Set(), chart = { figure, panels: [], cursorAt: given.cursor };
  const keyOf = (trace) => trace.legendgroup ?? trace.name ?? "";
  for (const trace of figure.data) if (trace.visible === "legendonly") hidden.add(keyOf(trace));
  const shown = (trace) => !hidden.has(keyOf(trace));
  const canvas = document.createElement("div"), tip = document.createElement("div");
  canvas.className = "chart";
  tip.className = "tip";
  const render = () => {
    const width = Math.max(canvas.clientWidth || element.clientWidth, 240);
    const panels = panelsOf(figure);
    panels.forEach((panel) => scalesOf(panel, shown));
    const height = arrange(panels, layout, width);
    const drawing = svg("svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img", "aria-label": element.dataset.label ?? "figure" });
    for (const panel of panels) {
      const axes = axesOf(panel);
      drawing.append(axes, guidesOf(panel, layout), shapesOf(panel, shown));
    }
    chart.panels = panels;
    chart.width = width;
    canvas.replaceChildren(drawing, tip);
    if (chart.cursorAt !== undefined) chart.cursor(chart.cursorAt);
  };
  chart.cursor = (x) => {
    chart.cursorAt = x;
    const drawing = canvas.querySelector("svg");
    drawing.querySelectorAll(".cursor").forEach((line) => line.remove());
    for (const panel of chart.panels) {
      const share = panel.sx.at(x);
      if (share >= 0 && share <= 1) drawing.append(svg("path", { d: `M${panel.left + share * panel.width} ${panel.top}v${panel.height}`, class: "cursor" }));
    }
  };
  element.replaceChildren(canvas);
  addLegend(element, figure, hidden, keyOf, render);
  render();
  addHover(canvas, tip, chart, shown);
  new ResizeObserver(() => { if (Math.abs(canvas.clientWidth - chart.width) > 2) render(); }).observe(canvas);
  chart.render = render;
  element.chart = chart;
  return chart;
}
