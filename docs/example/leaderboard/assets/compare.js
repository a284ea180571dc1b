// Two trackers, or two sides of one: the change on every sequence, and both runs of a sequence on top of each other.
const SIDES = ["#0072b2", "#d55e00"], MOST = 60;
const safe = (text) => text.replace(/[&<>]/g, (character) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;" })[character]); // plotly reads markup
const percentText = (ratio) => (ratio > 2 ? `${ratio.toPrecision(2)} times the error` : `${+Math.abs(100 * (ratio - 1)).toPrecision(2)} % ${ratio < 1 ? "less" : "more"} error`);

function pairsOf(board, a, b) {
  const of = (tracker) => new Map(board.cells.filter((cell) => cell[0] === tracker && cell[5][0] !== null).map((cell) => [cell[1], cell]));
  const [one, other] = [of(a), of(b)];
  return [...one.keys()].filter((sequence) => other.has(sequence)).map((sequence) => {
    const cells = [one.get(sequence), other.get(sequence)], [x, y] = cells.map((cell) => Math.max(cell[5][0], 1e-4));
    return { sequence, cells, change: Math.log(y / x) };
  }).sort((p, q) => Math.abs(q.change) - Math.abs(p.change));
}

/** B against A, in the board's numbers. */
function sentenceOf(ratios, a, b, names) {
  const entry = ratios.find(([one, other]) => (one === a && other === b) || (one === b && other === a));
  if (!entry) return `${names[1]} and ${names[0]} have no ranked sequence in common.`;
  const turned = entry[0] === b, [, , value, from, to, n, verdict, scope, words] = entry;
  if (words) return words;
  const [ratio, low, high] = turned ? [1 / value, 1 / to, 1 / from] : [value, from, to], count = `${n} sequence${n > 1 ? "s" : ""}`;
  if (Math.abs(ratio - 1) < 1e-6) return `${names[1]} and ${names[0]} have the same error on ${count}.`;
  const head = `${names[1]} against ${names[0]}: ${percentText(ratio)} on ${count}`;
  if (from === null) return `${head}, too few scenes to tell.`;
  const range = `ratio ${ratio.toFixed(3)}, 95 % interval ${low.toFixed(3)} to ${high.toFixed(3)}`, apart = low > 1 || high < 1;
  if (verdict.includes("lost")) return `${head}; where both succeed ${names[+(verdict.startsWith("better") !== turned)]} is better ${scope}, but it lost more sequences (${range}).`;
  if (scope === "by lost sequences") return `${head} where both succeed; ${names[+(verdict.startsWith("better") === turned)]} lost more sequences than chance explains (${range}).`;
  if (!apart && verdict !== "cannot tell" && scope === "on these families") return `${head}, shown ${scope}; the interval goes beyond them (${range}).`;
  if (verdict === "cannot tell" && apart) return `${head}, but among all pairs of the board one may differ so by chance (${range}).`;
  return apart ? `${head} (${range}).` : `${head}, but that may be chance (${range}).`;
}

function dumbbells(board, pairs, names) {
  const shown = pairs.slice(0, MOST), labels = shown.map(({ sequence }) => safe(board.sequences[sequence].short));
  const line = { type: "scatter", mode: "lines", x: [], y: [], line: { color: "#8a8a8a", width: 2 }, hoverinfo: "skip", showlegend: false };
  shown.forEach(({ cells }, at) => { line.x.push(1000 * cells[0][5][0], 1000 * cells[1][5][0], null); line.y.push(labels[at], labels[at], null); });
  const dots = [0, 1].map((side) => {
    const value = shown.map(({ cells }) => 1000 * cells[side][5][0]);
    const reach = (end) => shown.map(({ cells }, at) => (cells[side][7].length ? Math.abs(1000 * cells[side][7][end] - value[at]) : 0));
    return { type: "scatter", mode: "markers", name: safe(names[side]), x: value, y: labels, marker: { size: 11, color: SIDES[side], symbol: ["circle", "diamond"][side] }, error_x: { type: "data", symmetric: false, array: reach(1), arrayminus: reach(0), thickness: 1.2 }, hovertemplate: "%{y}: %{x:.3g} mm<extra>%{fullData.name}</extra>" };
  });
  return { data: [line, ...dots], layout: { height: 110 + 26 * shown.length, legend: { orientation: "h", y: 1, yanchor: "bottom" }, xaxis: { type: "log", dtick: "D2", title: { text: "ATE (mm)" } }, yaxis: { autorange: "reversed", type: "category", automargin: true } } };
}

/** Both runs of a sequence: pictures with a divider, tracks in space, errors over time and their difference. */
async function showPair(board, pair, names) {
  const runs = await Promise.all(pair.cells.map((cell) => loadRun(cell[6])));
  byId("pair").hidden = false;
  byId("pair-title").textContent = board.sequences[pair.sequence].name;
  const both = runs[0].pictures.filter((frame) => runs[1].pictures.includes(frame)), slider = byId("same-frame");
  byId("divided").hidden = slider.parentElement.hidden = !both.length;
  slider.max = both.length - 1;
  const images = select("#divided img");
  const move = () => {
    images.forEach((image, side) => { image.src = pictureOf(runs[side].id, both[slider.value]); });
    document.querySelector("#divided figcaption").textContent = `Frame ${both[slider.value]}: ${names[0]} on the left, ${names[1]} on the right`;
  };
  slider.oninput = move;
  byId("divider").oninput = ({ target }) => { images[1].style.clipPath = `inset(0 0 0 ${target.value}%)`; };
  if (both.length) { slider.value = Math.floor(both.length / 2); move(); byId("divider").oninput({ target: byId("divider") }); }
  const truth = runs.flatMap(({ figures }) => figures.track?.data.filter(({ name }) => name === "true path") ?? []).slice(0, 1);
  const tracks = runs.flatMap(({ figures }, side) => (figures.track?.data ?? []).filter(({ name }) => name === "estimate").map((trace) => ({ ...trace, name: safe(names[side]), showlegend: true, line: { color: SIDES[side], width: 5 } })));
  const layout = runs.map(({ figures }) => figures.track?.layout).find(Boolean);
  if (layout) await draw(byId("tracks"), { data: [...truth, ...tracks, ...corners([...truth, ...tracks])], layout });
  const lines = runs.map(({ series }, side) => ({ type: "scatter", mode: "lines", name: safe(names[side]), x: series.track_t, y: series.track_error, line: { color: SIDES[side], dash: ["solid", "dash"][side] } })).filter(({ x }) => x);
  if (lines.length === 2) {
    const [first, second] = runs.map(({ series }) => series), gap = 0.1;
    const y = Array.from(second.track_t, (t, at) => { const near = nearest(first.track_t, t); return Math.abs(first.track_t[near] - t) < gap ? second.track_error[at] - first.track_error[near] : NaN; });
    lines.push({ type: "scatter", mode: "lines", name: "B − A", x: second.track_t, y, yaxis: "y2", line: { color: "#8a8a8a" } });
  }
  await draw(byId("difference"), { data: lines, layout: { height: 380, hovermode: "x", legend: { orientation: "h", y: 1.02, yanchor: "bottom" }, xaxis: { title: { text: "time (s)" }, anchor: "y2" }, yaxis: { title: { text: "error (mm)" }, domain: [0.42, 1], rangemode: "tozero" }, yaxis2: { title: { text: "B − A (mm)" }, domain: [0, 0.36] } } });
  address.write({ sequence: pair.sequence });
}

async function startCompare() {
  const [board, ratios] = await Promise.all([side("board"), side("ratios")]), view = address.read();
  const sides = board.pairs, usual = sides ? sides[0] : [board.referenceAt ?? 0, board.trackers.findIndex((_, at) => at !== (board.referenceAt ?? 0))];
  const [a, b] = [+(view.get("a") ?? usual[0]), +(view.get("b") ?? usual[1])];
  const names = [board.trackers[a]?.label ?? "", board.trackers[b]?.label ?? ""];
  const go = (one, other) => { address.write({ a: one, b: other, sequence: "" }); startCompare(); };
  const all = board.trackers.map(({ label }, at) => [at, label]);
  byId("pair").hidden = true;
  byId("choice").replaceChildren(...(sides
    ? [chooser("Tracker", sides.map(([one, other]) => [`${one}.${other}`, board.trackers[one].label.replace(/^A: /, "")]), `${a}.${b}`, (key) => go(...key.split(".")))]
    : [["A", a, (key) => go(key, b)], ["B", b, (key) => go(a, key)]].map(([name, at, to]) => make("label", {}, `${name}: `, chooser(name, all, at, to)))));
  const pairs = board.trackers[b] ? pairsOf(board, a, b) : [];
  byId("sentence").textContent = board.trackers[b] ? sentenceOf(ratios, a, b, names) : "There is only one tracker.";
  const settings = board.trackers[b] ? [...new Set([...Object.keys(board.trackers[a].settings), ...Object.keys(board.trackers[b].settings)])].map((name) => [name, board.trackers[a].settings[name] ?? "default", board.trackers[b].settings[name] ?? "default"]).filter(([, one, other]) => one !== other) : [];
  byId("differences").replaceChildren(settings.length ? rowsOf(["setting that differs", "A", "B"], settings) : make("p", { className: "caption", textContent: "Both ran with their default settings, or with the same changes of them." }));
  byId("hidden-pairs").textContent = pairs.length > MOST ? ` Drawn are ${MOST} of ${pairs.length} sequences; the sentence counts all that rank.` : "";
  await draw(byId("dumbbells"), dumbbells(board, pairs, names));
  const has = (pair) => pair.cells.every((cell) => board.runs.some((run) => run[0] === cell[6] && run[5] & 1));
  byId("dumbbells").removeAllListeners("plotly_click");
  byId("dumbbells").on("plotly_click", ({ points }) => { const pair = pairs.find(({ sequence }) => safe(board.sequences[sequence].short) === points[0].y); if (pair && has(pair)) showPair(board, pair, names); });
  const wanted = pairs.find(({ sequence }) => String(sequence) === view.get("sequence"));
  if (wanted && has(wanted)) await showPair(board, wanted, names);
}
if (byId("dumbbells")) addEventListener("DOMContentLoaded", startCompare);
