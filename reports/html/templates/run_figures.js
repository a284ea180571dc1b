// Figures of one run, made of its frames and its track.
const TRUE_LINE = { color: "var(--soft)", width: 1.4, dash: "dash" };
const STAGE_COLOURS = ["#1f6fb4", "#d9542b", "#2a9d6f", "#8a5cc2", "#c9970c", "#3aa6c9", "#c2427f", "#6b7a1f", "#8c564b", "#4b5fd6"];
const gapped = (run, values) => values.map((value, at) => (run.frames.states[at] === "o" ? value : null));

/** Panels below each other that share their time: a list of titles with their traces. */
function stacked(panels, layout = {}) {
  const data = [], made = { showlegend: true, ...layout };
  panels.filter((panel) => panel.traces.length).forEach(({ title, traces, axis }, at) => {
    const suffix = at ? String(at + 1) : "";
    data.push(...traces.map((trace) => ({ mode: "lines", showlegend: traces.length > 1, ...trace, xaxis: `x${suffix}`, yaxis: `y${suffix}` })));
    made[`xaxis${suffix}`] = { title: { text: "time (s)" }, ...axis };
    made[`yaxis${suffix}`] = { title: { text: title }, rangemode: "tozero" };
  });
  return { data, layout: made };
}

function overTime(run) {
  const { frames, track } = run, shift = track.start && frames.start ? track.start - frames.start : 0;
  const hover = { hovertemplate: "%{y} at %{x:.2f} s<extra>%{fullData.name}</extra>" };
  const absolute = track.error_mm ? [{ name: "absolute error", x: track.t.map((t) => t + shift), y: track.error_mm, line: { color: "#d9542b", width: 1.8 }, ...hover }] : [];
  if (!frames.t) return stacked([{ title: "absolute error (mm)", traces: absolute }], { height: 300, columns: 1 });
  const line = (name, y, colour, more = {}) => ({ name, x: frames.t, y, line: { color: colour, width: 1.6 }, ...hover, ...more });
  const counts = Object.entries(frames.counts).map(([name, values], at) => line(name, values, ["#6b7280", "#d9542b", "#1f6fb4", "#2a9d6f"][at]));
  return stacked([
    { title: "absolute error (mm)", traces: absolute },
    { title: "frame-to-frame error (mm)", traces: [line("frame error", gapped(run, frames.frame_error_mm), "#8a5cc2")] },
    { title: `image that shows people (%)`, traces: frames.share ? [line("dynamic share", frames.share, "#c9970c", { fill: "tozeroy" })] : [] },
    { title: "features and matches", traces: counts },
  ], { height: 300, columns: 2 });
}

function poses(run) {
  const { track } = run, names = ["x (m)", "y (m)", "z (m)", "yaw (°)", "pitch (°)", "roll (°)"];
  const data = [], layout = { height: 270, columns: 3 };
  names.forEach((name, at) => {
    const suffix = at ? String(at + 1) : "", part = at < 3 ? "xyz" : "angles";
    const trace = { mode: "lines", x: track.t, xaxis: `x${suffix}`, yaxis: `y${suffix}`, hovertemplate: "%{y} at %{x:.2f} s<extra>%{fullData.name}</extra>" };
    if (track[`true_${part}`]) data.push({ ...trace, name: "truth", legendgroup: "truth", y: track[`true_${part}`][at % 3], line: TRUE_LINE });
    data.push({ ...trace, name: "estimate", legendgroup: "estimate", y: track[part][at % 3], line: { color: "#1f6fb4", width: 1.8 } });
    layout[`xaxis${suffix}`] = { title: { text: at > 2 ? "time (s)" : "" } };
    layout[`yaxis${suffix}`] = { title: { text: name } };
  });
  return { data, layout };
}

function spread(run, colour) {
  const sorted = run.track.error_mm.filter((value) => value !== null).sort((a, b) => a - b);
  const bins = Math.min(30, Math.max(8, Math.round(Math.sqrt(sorted.length)))), step = sorted.at(-1) / bins || 1;
  const counts = Array(bins).fill(0);
  sorted.forEach((value) => { counts[Math.min(bins - 1, Math.floor(value / step))] += 1; });
  return {
    data: [
      { type: "bar", name: "frames", x: counts.map((_, at) => (at + 0.5) * step), y: counts, width: 0.92, marker: { color: colour }, hovertemplate: "%{y} frames near %{x:.1f} mm<extra></extra>" },
      { mode: "lines", name: "share below", x: sorted, y: sorted.map((_, at) => (100 * (at + 1)) / sorted.length), xaxis: "x2", yaxis: "y2", line: { color: colour, width: 2.2 }, hovertemplate: "%{y:.0f} % of the frames below %{x:.1f} mm<extra></extra>" },
    ],
    layout: {
      height: 330, showlegend: false, xaxis: { title: { text: "absolute error (mm)" }, range: [0, sorted.at(-1) || 1] }, yaxis: { title: { text: "frames" } },
      xaxis2: { title: { text: "absolute error (mm)" }, range: [0, sorted.at(-1) || 1] }, yaxis2: { title: { text: "share of the frames below (%)" }, range: [0, 101] },
    },
  };
}

/** Times of the stages on top of each other, a bar for every frame (of many frames, for every few). */
function stageStack(run) {
  const { frames } = run, names = Object.keys(frames.stages), group = Math.ceil(frames.t.length / 120);
  const mean = (values) => { const known = values.filter((value) => value !== null); return known.length ? known.reduce((a, b) => a + b, 0) / values.length : 0; };
  const grouped = (values) => Array.from({ length: Math.ceil(values.length / group) }, (_, at) => mean(values.slice(at * group, (at + 1) * group)));
  const x = grouped(frames.t), base = x.map(() => 0);
  const data = names.map((name, at) => {
    const y = grouped(frames.stages[name]), trace = { type: "bar", name, x, y, base: [...base], width: 0.96, marker: { color: STAGE_COLOURS[at % STAGE_COLOURS.length] }, hovertemplate: "%{y} ms at %{x:.2f} s<extra>%{fullData.name}</extra>" };
    y.forEach((value, row) => { base[row] += value; });
    return trace;
  }).filter((trace) => trace.y.some((value) => value > 0));
  const sorted = [...base].sort((a, b) => a - b), highest = Math.min(sorted.at(-1), 2.5 * quantile(sorted, 0.8)) || 1;
  return { data, layout: { height: 400, xaxis: { title: { text: "time (s)" } }, yaxis: { title: { text: "time of a frame (ms)" }, range: [0, 1.08 * highest] } } };
}

function drawRunFigures(run, where) {
  if ($("over-time")) show("over-time", overTime(run));
  if ($("poses")) show("poses", poses(run));
  if ($("spread")) show("spread", spread(run, where.colour));
  if ($("stage-stack")) show("stage-stack", stageStack(run));
}
