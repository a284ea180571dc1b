// The page of a run: picture, track and time move together.
const NUMBERS = { f4: Float32Array, i4: Int32Array };
function decode({ dtype, bdata }) {
  return new NUMBERS[dtype](Uint8Array.from(atob(bdata), (character) => character.charCodeAt(0)).buffer);
}

/** A figure whose "@name" are the run's series. */
function filled(value, series) {
  return JSON.parse(JSON.stringify(value), (_, each) => (typeof each === "string" && each[0] === "@" ? series[each.slice(1)] : each));
}

async function loadRun(id) {
  const run = await side(`run-${id}`);
  if (!run.read) {
    run.series = Object.fromEntries(Object.entries(run.series).map(([name, packed]) => [name, decode(packed)]));
    run.figures = filled(run.figures, run.series);
    run.read = true;
  }
  return run;
}

const nearest = (values, value) => values.reduce((best, each, at) => (Math.abs(each - value) < Math.abs(values[best] - value) ? at : best), 0);
const pictureOf = (id, frame) => `frames/${id}/frame_${String(frame).padStart(6, "0")}.webp`;

/** The position on the track at a time; nothing far from any pose. */
function marker(run, t) {
  const { track_t: times, track_x: x, track_y: y, track_z: z } = run.series;
  const at = times ? nearest(times, t) : -1;
  return { type: "scatter3d", mode: "markers", x: at < 0 ? [] : [x[at]], y: at < 0 ? [] : [y[at]], z: at < 0 ? [] : [z[at]], marker: { size: 6, color: "#e69f00", line: { width: 1, color: "#000" } }, showlegend: false, hoverinfo: "skip" };
}

/** Two unseen corners around paths: a straight one, too, has a box that fits the view. */
function corners(paths) {
  const sides = ["x", "y", "z"].map((axis) => paths.flatMap((path) => [...path[axis]]).filter(Number.isFinite)).map((values) => [Math.min(...values), Math.max(...values)]);
  const least = 0.4 * Math.max(...sides.map(([low, high]) => high - low));
  if (!Number.isFinite(least)) return [];
  const [x, y, z] = sides.map(([low, high]) => [-0.5, 0.5].map((side) => (low + high) / 2 + side * Math.max(high - low, least)));
  return [{ type: "scatter3d", mode: "markers", x, y, z, marker: { opacity: 0 }, showlegend: false, hoverinfo: "skip" }];
}

const chooser = (name, options, value, onchange) => {
  const list = make("select", { ariaLabel: name, onchange: ({ target }) => onchange(target.value) }, ...options.map(([key, text]) => make("option", { value: key, textContent: text })));
  list.value = value;
  return list;
};
const rowsOf = (heads, rows) => make("div", { className: "scroll" }, make("table", { className: "plain-table" }, make("thead", {}, make("tr", {}, ...heads.map((text) => make("th", { textContent: text })))), make("tbody", {}, ...rows.map((row) => make("tr", {}, ...row.map((text) => make("td", { textContent: text ?? "" })))))));
const fold = (title, ...parts) => make("details", { className: "fold" }, make("summary", { textContent: title }), ...parts);

class RunView {
  static clock = 0; // of the run that plays
  second = null; // the run of another tracker
  constructor(run) {
    this.run = run;
    this.frames = run.series.index ?? run.series.track_t ?? [];
    this.times = run.series.t ?? run.series.track_t ?? [];
  }

  async show() {
    const { run } = this, slider = byId("frame");
    slider.max = Math.max(this.times.length - 1, 0);
    slider.oninput = () => this.move(+slider.value);
    document.onkeydown = (event) => {
      if (event.target.matches("input, select") || !["ArrowLeft", "ArrowRight"].includes(event.key)) return;
      event.preventDefault();
      this.move(this.at + (event.key === "ArrowRight" ? 1 : -1));
    };
    byId("worst").replaceChildren(...(run.worst.length ? ["worst frames: "] : []), ...run.worst.map(([frame, error]) => make("button", { type: "button", textContent: `${frame} (${error} mm)`, onclick: () => this.move(nearest(this.frames, frame)) })));
    for (const [name, there] of [["picture", run.pictures.length], ["track", run.figures.track], ["time", run.figures.time]]) byId(name).hidden = !there;
    byId("drawn").textContent = run.caption.join(" ");
    byId("play").onclick = () => this.play(!this.playing);
    this.play(false);
    const wanted = address.read().get("frame");
    this.at = wanted ? nearest(this.frames, +wanted) : run.moment === null ? this.worst() : nearest(this.frames, run.moment);
    await this.drawTrack();
    if (run.figures.time) {
      const t = this.times[this.at] ?? 0;
      const cursor = { type: "line", x0: t, x1: t, y0: 0, y1: 1, yref: "paper", line: { color: "#e69f00", width: 3 }, editable: true };
      await draw(byId("time"), { ...run.figures.time, layout: { ...run.figures.time.layout, shapes: [...run.figures.time.layout.shapes, cursor] } });
      byId("time").removeAllListeners?.("plotly_click");
      byId("time").on("plotly_click", ({ points }) => this.move(nearest(this.times, points[0].x)));
      byId("time").on("plotly_relayout", (change) => {
        const moved = Object.entries(change).find(([name]) => name === `shapes[${run.figures.time.layout.shapes.length}].x0`);
        if (moved) this.move(nearest(this.times, moved[1]));
      });
    }
    this.move(this.at, false);
  }

  async drawTrack() {
    const { figures } = this.run;
    if (!figures.track) return;
    const other = this.second?.figures.track?.data.filter(({ name }) => name === "estimate").map((trace) => ({ ...trace, name: this.second.label.replace(/</g, "&lt;"), showlegend: true, line: { color: "#cc79a7", width: 4 } })) ?? [];
    await draw(byId("track"), { data: [...figures.track.data, ...other, ...corners([...figures.track.data, ...other]), marker(this.run, this.times[this.at] ?? 0)], layout: figures.track.layout });
  }

  /** Of a run of which only the track is known: the place with the largest error. */
  worst() {
    const errors = this.run.series.track_error ?? [];
    return errors.reduce((worst, error, at) => (error > (errors[worst] || 0) ? at : worst), 0);
  }

  /** Go on frame by frame until the end, in about ten seconds, or stop. */
  play(on) {
    clearInterval(RunView.clock);
    this.playing = on;
    byId("play").textContent = on ? "Pause" : "Play";
    byId("play").setAttribute("aria-pressed", on);
    if (!on) return;
    if (this.at >= this.times.length - 1) this.move(0);
    const step = Math.max(1, Math.round(this.times.length / 100));
    RunView.clock = setInterval(() => { this.move(this.at + step); if (this.at >= this.times.length - 1) this.play(false); }, 100);
  }

  move(at, write = true) {
    if (!this.times.length) return;
    const { run } = this;
    this.at = Math.max(0, Math.min(this.times.length - 1, at));
    byId("frame").value = this.at;
    const t = this.times[this.at], frame = run.series.index?.[this.at], caption = document.querySelector("#picture figcaption");
    if (run.pictures.length) {
      const shown = run.pictures[nearest(run.pictures, frame ?? 0)];
      Object.assign(byId("image"), { src: pictureOf(run.id, shown), alt: `Frame ${shown} as the tracker saw it` });
      caption.textContent = `Frame ${frame} at ${t.toFixed(2)} s${shown === frame ? "" : `; the nearest picture is of frame ${shown}`}`;
    }
    if (run.figures.time && byId("time").layout) {
      const cursor = run.figures.time.layout.shapes.length, place = `shapes[${cursor}]`;
      if (byId("time").layout.shapes[cursor].x0 !== t) Plotly.relayout(byId("time"), { [`${place}.x0`]: t, [`${place}.x1`]: t });
    }
    if (run.figures.track) {
      const last = byId("track").data.length - 1, { x, y, z } = marker(run, t);
      Plotly.restyle(byId("track"), { x: [x], y: [y], z: [z] }, [last]);
    }
    if (write && frame !== undefined) address.write({ frame });
  }
}

function showFolds(run) {
  const figure = (name) => make("div", { className: "figure", id: name });
  const times = run.stages.map(([name, ...values]) => [name, ...values.map((value) => value?.toPrecision(3))]);
  const parts = [
    ...(run.quote.length ? [fold(`Quote it (${run.quote.length - 1} reservation${run.quote.length === 2 ? "" : "s"})`, make("ul", { className: "plain" }, ...run.quote.map((textContent) => make("li", { textContent }))))] : []),
    fold("Make it again", make("pre", { tabIndex: 0, textContent: run.command || "It was imported." }), make("p", { className: "caption", textContent: `Started ${run.started}. ${run.machine}. ${run.asked ? `Asked for by: ${run.asked}` : ""}` })),
    fold(`Settings (${run.settings.filter(([, , changed]) => changed).length} changed)`, rowsOf(["setting", "value", "changed"], run.settings.map(([name, value, changed]) => [name, String(value), changed ? "changed" : ""]))),
    fold("More numbers and diagnostics", rowsOf(["number", "value"], run.more), make("ul", { className: "plain" }, ...run.notes.map((note) => make("li", { textContent: note }))), make("p", { className: "caption", textContent: run.protocol })),
    ...(run.figures.poses ? [fold("Position and rotation", figure("poses"))] : []),
    ...(times.length ? [fold("Time by stage", ...(run.figures.stages ? [figure("stages")] : []), rowsOf(["stage", "median ms", "p95 ms", "mean ms"], times))] : []),
    fold("Log", make("pre", { tabIndex: 0, textContent: run.log || "The run wrote nothing." })),
    ...(run.files.length ? [make("p", { className: "caption" }, "Files: ", ...run.files.flatMap(([name, href]) => [make("a", { href, textContent: name }), " "]))] : []),
  ];
  byId("folds").replaceChildren(...parts);
  for (const name of ["poses", "stages"]) byId(name)?.closest("details").addEventListener("toggle", ({ target }) => target.open && draw(byId(name), run.figures[name]), { once: true });
}

/** What the report's tables know of a run without a page. */
function showRow(board, [id, tracker, sequence, , ending]) {
  const cell = board.cells.find((each) => each[6] === id && each[0] === tracker && each[1] === sequence), ate = cell?.[5][0];
  const verdict = byId("verdict"), words = ending || (ate == null ? `Run ${id}` : `ATE ${(1000 * ate).toPrecision(3)} mm${cell[2] > 1 ? `, the median of ${cell[2]} runs` : ""}`);
  verdict.className = `verdict ${ending ? "red" : "amber"}`;
  verdict.textContent = `${words}. ${board.pageless}`;
}

async function showRun(id) {
  const verdict = byId("verdict");
  try {
    const board = await side("board"), own = board.runs.find((run) => run[0] === id);
    if (!own) throw new Error(board.unlisted ? `Run ${id} has no page here, if it is in this report at all. ${board.pageless}` : id ? `There is no run ${id} in this report.` : "No run is named behind # in the address.");
    const [, tracker, sequence] = own, run = own[5] & 1 ? await loadRun(id) : null;
    const go = (to) => { location.hash = to; };
    const first = (test) => board.runs.find((each) => each[5] & 1 && test(each))?.[0];
    const options = (at, names, test) => [...new Set(board.runs.filter((each) => each === own || (each[5] & 1 && test(each))).map((each) => each[at]))].map((key) => [key, names[key]]);
    const labels = board.trackers.map(({ label }) => label), names = board.sequences.map(({ name }) => name);
    const same = board.runs.filter((each) => each[1] === tracker && each[2] === sequence && (each[5] & 1 || each === own));
    document.title = `${labels[tracker]} on ${names[sequence]}`;
    byId("run-title").textContent = document.title;
    byId("run-choice").replaceChildren(
      chooser("Tracker", options(1, labels, (each) => each[2] === sequence), tracker, (key) => go(first((each) => each[1] === +key && each[2] === sequence))),
      chooser("Sequence", options(2, names, (each) => each[1] === tracker), sequence, (key) => go(first((each) => each[1] === tracker && each[2] === +key))),
      chooser("Repeat", same.map((each) => [each[0], `${each[3]}${each[4] ? `: ${each[4]}` : ""}`]), id, go));
    byId("run").hidden = !run;
    if (!run) return showRow(board, own);
    verdict.className = `verdict ${run.level}`;
    verdict.textContent = run.verdict;
    byId("numbers").replaceChildren(...run.numbers.map(([name, value]) => make("div", { className: "card" }, make("b", { textContent: value }), make("span", { textContent: name }))));
    const view = new RunView(run);
    const others = board.cells.filter((cell) => cell[1] === sequence && cell[0] !== tracker && board.runs.some((each) => each[0] === cell[6] && each[5] & 1));
    byId("second").replaceWith(Object.assign(chooser("Second tracker", [["", "none"], ...others.map((cell) => [cell[6], labels[cell[0]]])], "", async (other) => {
      view.second = other ? { ...(await loadRun(other)), label: labels[others.find((cell) => cell[6] === other)[0]] } : null;
      view.drawTrack();
    }), { id: "second" }));
    showFolds(run);
    await view.show();
  } catch (error) {
    verdict.className = "verdict red";
    verdict.textContent = error.message;
    byId("run").hidden = true;
  }
}

function startRun() {
  const wanted = () => [...address.read().keys()].find((key) => /^[0-9a-f]{16}([0-9a-f]{4})?$/.test(key)) ?? "";
  let shown = wanted();
  addEventListener("hashchange", () => { if (wanted() !== shown) showRun((shown = wanted())); });
  addEventListener("DOMContentLoaded", () => showRun(shown));
}
if (byId("run")) startRun();
