// The table of all trackers on all sequences: what is shown stands in the address, every cell leads to its runs.
const KINDS = [["ate", "ATE"], ["rpe", "RPE"], ["rotation", "Rotation"]];
const EXTRA = [["rank", "rank"], ["ratio", "ATE ratio"], ["success", "success"], ["coverage", "coverage"], ["speed", "× real time"], ["memory", "MB"]];
const SHOWN_AT_FIRST = ["rank", "success"];
const $ = (id) => document.getElementById(id);

/** What is known of all runs of a cell, by "tracker,sequence", with those of them that are listed. */
function cellsOf(data) {
  const cells = new Map(data.cells.map(([t, s, count, failed, against, medians]) => [`${t},${s}`, { t, s, count, failed, doubt: against & 1, seen: against & 2, medians, runs: [] }]));
  for (const [id, t, s, repeat, ending, flags, values, quartiles] of data.runs)
    cells.get(`${t},${s}`).runs.push({ id, repeat, ending, kept: flags & 1, pictured: flags & 2, paged: !(flags & 4), values, quartiles });
  return cells;
}

/** The kinds of sequences to choose from: static, dynamic, and how dynamic where there are several of that. */
function tagsOf(sequences) {
  const known = [...new Set(sequences.flatMap((sequence) => sequence.tags))].sort();
  const dynamic = known.filter((tag) => tag.endsWith("-dynamic")), others = known.filter((tag) => !dynamic.includes(tag));
  const all = [...others, ...(dynamic.length ? ["dynamic"] : []), ...(dynamic.length > 1 ? dynamic : [])];
  return all.length > 1 ? all : [];
}

/** Whether a sequence is of a kind; "dynamic" is any degree of it, and no kind is all. */
const hasTag = (sequence, tag) => !tag || sequence.tags.some((own) => own === tag || own.endsWith(`-${tag}`));

/** The run of a cell that stands for it: the successful one with the (lower) median of its errors. */
function standing(cell, metric = 0) {
  const good = cell.runs.filter((run) => !run.ending && run.kept && run.values[metric] !== null).sort((a, b) => a.values[metric] - b.values[metric]);
  return good[Math.floor((good.length - 1) / 2)] ?? cell.runs[0];
}

class Explore {
  constructor(data) {
    this.data = data;
    this.cells = cellsOf(data);
    this.view = { q: "", tag: "", ranked: "", kind: "ate", metric: "0", which: "online", scale: "mm", hide: "", extra: SHOWN_AT_FIRST.join("."), sort: "" };
    this.defaults = { ...this.view };
    for (const [name, value] of address.read().view) if (name in this.view) this.view[name] = value;
  }

  set(name, value) {
    this.view[name] = value;
    const changed = Object.entries(this.view).filter(([key, now]) => now !== this.defaults[key]);
    address.write(new Map(changed));
    this.render();
  }

  /** Metrics of the kind and trajectory that are chosen and that any run has. */
  get choices() {
    return this.data.metrics.map((metric, at) => ({ ...metric, at })).filter((metric) =>
      metric.kind === this.view.kind && metric.which === this.view.which && [...this.cells.values()].some((cell) => cell.medians[metric.at] !== null));
  }

  get sequences() {
    const hidden = new Set(this.view.hide.split(".").filter(Boolean)), query = this.view.q.toLowerCase();
    const inGroup = this.data.sequences.map((sequence, at) => ({ ...sequence, at })).filter((sequence) => hasTag(sequence, this.view.tag) && !hidden.has(String(sequence.at)));
    const found = inGroup.filter((sequence) => query && sequence.name.toLowerCase().includes(query));
    return found.length && found.length < inGroup.length ? found : inGroup;
  }

  get trackers() {
    const query = this.view.q.toLowerCase();
    const all = this.data.trackers.map((tracker, at) => ({ ...tracker, at })).filter((tracker) => !this.view.ranked || tracker.ranked);
    const found = all.filter((tracker) => `${tracker.label} ${tracker.id}`.toLowerCase().includes(query));
    const bySequence = query && this.data.sequences.some((sequence) => sequence.name.toLowerCase().includes(query));
    return found.length || !bySequence ? found : all;
  }

  get metric() { return this.choices[Math.min(+this.view.metric, this.choices.length - 1)]; }

  render() {
    const { metric, sequences, trackers } = this;
    this.renderControls();
    const extra = this.view.extra.split(".").filter(Boolean), ratio = this.view.scale === "ratio";
    const columns = [...extra.map((name) => ({ extra: name })), ...sequences.map((sequence) => ({ sequence }))];
    if (matchMedia("(max-width: 700px)").matches) columns.sort((a, b) => Boolean(a.extra) - Boolean(b.extra)); // errors in sight
    const heads = ["tracker", ...columns.map((column) => (column.extra ? EXTRA.find(([name]) => name === column.extra)[1] : column.sequence.short))];
    const table = $("explore-table");
    table.tHead.rows[0].replaceChildren(...heads.map((name, at) => this.head(name, at, columns[at - 1])));
    const best = new Map(sequences.map((sequence) => [sequence.at, this.best(trackers, sequence, metric)]));
    const rows = trackers.map((tracker) => make("tr", { className: tracker.ranked ? "" : "muted" },
      make("td", { className: "sticky" }, tracker.label, ...(tracker.imported ? [" ", make("span", { className: "tag", textContent: "imported" })] : [])),
      ...columns.map((column) => (column.extra ? this.extraCell(tracker, column.extra) : this.cell(tracker, column.sequence, metric, ratio, best)))));
    table.tBodies[0].replaceChildren(...rows);
    if (!rows.length) table.tBodies[0].append(make("tr", {}, make("td", { colSpan: heads.length, textContent: "No tracker fits the search." })));
    this.sortAgain();
    const all = this.data;
    $("explore-count").textContent = `${trackers.length} of ${all.trackers.length} trackers, ${sequences.length} of ${all.sequences.length} sequences`;
    const unit = ratio ? `ratio to ${all.referenceName}` : { m: "millimetres", deg: "degrees" }[metric?.unit ?? "m"];
    const base = metric?.key === "ate_rmse_m" && metric.which === "online" ? "lost frames held, failures counted as a static camera or worse" : "over the runs that succeeded";
    $("explore-caption").textContent = metric ? `${metric.name} of the ${metric.which} trajectory, ${unit}: median over the repeats, ${base}. Bold: best of the ranked trackers shown.${[...this.cells.values()].some((cell) => cell.seen) ? ` ${this.data.seen} masks of a network that was trained on this scene: takes no part in bold and colour.` : ""} A cell leads to the run with the median error, the numbers behind it to the others. ${all.protocol}.` : "No run has this number.";
    drawExploreFigures(this, trackers, sequences);
  }

  head(name, at, column) {
    const group = column?.sequence?.name ?? "";
    const label = make("button", { type: "button" }, ...breakable(name));
    const head = make("th", { className: at ? "n" : "sticky", scope: "col", title: group }, label);
    label.addEventListener("click", () => {
      const up = this.view.sort !== `${name}:up`;
      this.set("sort", `${name}:${up ? "up" : "down"}`);
    });
    return head;
  }

  sortAgain() {
    const [name, way] = [this.view.sort.slice(0, this.view.sort.lastIndexOf(":")), this.view.sort.split(":").at(-1)];
    const heads = [...$("explore-table").tHead.rows[0].cells], at = heads.findIndex((head) => head.textContent === name);
    if (at < 0) return;
    if (way === "down") heads[at].setAttribute("aria-sort", "ascending");
    sortBy($("explore-table"), at, heads[at]);
  }

  best(trackers, sequence, metric) {
    const values = trackers.filter((tracker) => tracker.ranked).map((tracker) => this.cells.get(`${tracker.at},${sequence.at}`))
      .filter((cell) => cell && !cell.failed && !cell.seen && metric && !this.doubted(cell, metric)).map((cell) => cell.medians[metric.at]).filter((value) => value !== null);
    return values.length > 1 ? Math.min(...values) : null;
  }

  doubted(cell, metric) { return metric.key.startsWith("ape_rot") && cell.doubt; }

  base(sequence, metric) {
    const cell = this.data.reference === null ? null : this.cells.get(`${this.data.reference},${sequence.at}`);
    return cell ? cell.medians[metric.at] : this.data.reference === null && metric.kind === "ate" ? this.data.static[sequence.at] : null;
  }

  cell(tracker, sequence, metric, ratio, best) {
    const cell = this.cells.get(`${tracker.at},${sequence.at}`);
    if (!cell || !metric) return make("td", { className: "n muted", textContent: "–", title: "not run" });
    const td = make("td", { className: "n" }), runs = cell.runs, chosen = standing(cell, metric.at);
    const link = (run, text) => make("a", { href: `run.html#${run.id}`, textContent: text, title: run.repeat + (run.ending ? `, ${run.ending}` : "") });
    if (cell.failed === cell.count) {
      td.className = "n failed";
      td.append(link(chosen, chosen.ending));
    } else {
      const value = cell.medians[metric.at], under = ratio ? this.base(sequence, metric) : 1;
      const shown = value === null || !under ? null : ratio ? value / under : metric.unit === "m" ? 1000 * value : value;
      td.append(link(chosen, digits(shown) + (this.doubted(cell, metric) ? "‡" : "") + (cell.seen ? this.data.seen : "")));
      if (shown !== null) td.dataset.v = shown;
      if (value !== null && value === best.get(sequence.at) && !cell.failed && !cell.seen && tracker.ranked && !this.doubted(cell, metric)) td.classList.add("best");
      this.shade(td, cell, sequence, metric);
    }
    const others = runs.filter((run) => run !== chosen && run.paged).slice(0, 9);
    if (others.length) td.append(" ", make("small", {}, ...others.flatMap((run, at) => [at ? " " : "", link(run, run.ending ? "✕" : String(at + 2))])));
    return td;
  }

  shade(td, cell, sequence, metric) {
    const base = this.base(sequence, metric), value = cell.medians[metric.at];
    if (!base || value === null || cell.seen || this.doubted(cell, metric)) return;
    let strength = Math.max(-1, Math.min(1, Math.log(Math.max(value / base, 1e-9)) / Math.log(4)));
    if (cell.failed) strength = Math.max(strength, 0);
    td.dataset.shade = "";
    td.style.setProperty("--s", `${Math.round(46 * Math.abs(strength))}%`);
    td.style.setProperty("--h", strength < 0 ? "var(--better)" : "var(--worse)");
  }

  extraCell(tracker, name) {
    const value = tracker[name], td = make("td", { className: "n" });
    if (name === "success") { td.textContent = value.join("/"); td.dataset.v = value[0] / value[1]; }
    else if (name === "rank") td.textContent = value;
    else if (value === null) td.textContent = "–";
    else { td.textContent = name === "coverage" ? `${digits(100 * value)} %` : digits(value); td.dataset.v = value; }
    return td;
  }

  renderControls() {
    const { view } = this, segments = (id, entries, name) => $(id).replaceChildren(...entries.map(([value, text, off]) => {
      const button = make("button", { type: "button", textContent: text, disabled: Boolean(off) });
      button.setAttribute("aria-pressed", String(view[name] === value));
      button.addEventListener("click", () => this.set(name, value));
      return button;
    }));
    if ($("explore-search").value !== view.q) $("explore-search").value = view.q;
    $("explore-ranked").checked = view.ranked === "1";
    segments("explore-tags", [["", "all"], ...tagsOf(this.data.sequences).map((tag) => [tag, tag.replace("-", " ")])], "tag");
    $("explore-tags").hidden = !tagsOf(this.data.sequences).length;
    segments("explore-kind", KINDS, "kind");
    const final = this.data.metrics.some((metric, at) => metric.which === "final" && [...this.cells.values()].some((cell) => cell.medians[at] !== null));
    segments("explore-which", [["online", "online"], ["final", "final", !final]], "which");
    segments("explore-scale", [["mm", view.kind === "rotation" ? "degrees" : "mm"], ["ratio", "ratio"]], "scale");
    $("explore-metric").hidden = this.choices.length < 2;
    $("explore-metric").replaceChildren(...this.choices.map((metric, at) => make("option", { value: String(at), textContent: metric.name, selected: this.metric === metric || +view.metric === at })));
  }

  wire() {
    $("explore-search").addEventListener("input", (event) => this.set("q", event.target.value));
    $("explore-ranked").addEventListener("change", (event) => this.set("ranked", event.target.checked ? "1" : ""));
    $("explore-metric").addEventListener("change", (event) => this.set("metric", event.target.value));
    $("explore-reset").addEventListener("click", () => { this.view = { ...this.defaults }; address.write(new Map()); this.columns(); this.render(); });
    this.columns();
  }

  /** The column chooser: numbers of a tracker, and sequences. */
  columns() {
    const box = (text, on, change) => {
      const input = make("input", { type: "checkbox", checked: on });
      input.addEventListener("change", () => change(input.checked));
      return make("label", {}, input, ` ${text}`);
    };
    const toggle = (name, value, on) => {
      const now = new Set(this.view[name].split(".").filter(Boolean));
      if (on) now.add(value); else now.delete(value);
      this.set(name, [...now].join("."));
    };
    const extra = new Set(this.view.extra.split(".")), hidden = new Set(this.view.hide.split("."));
    $("explore-columns").replaceChildren(
      ...EXTRA.map(([name, text]) => box(text, extra.has(name), (on) => toggle("extra", name, on))),
      make("hr"),
      ...this.data.sequences.map((sequence, at) => box(sequence.short, !hidden.has(String(at)), (on) => toggle("hide", String(at), !on))));
  }
}

async function startExplore() {
  startTracks();
  try {
    const explore = new Explore(await side("explore"));
    explore.wire();
    explore.render();
    addEventListener("hashchange", () => { for (const [name, value] of address.read().view) if (name in explore.view) explore.view[name] = value; explore.render(); });
  } catch (error) { $("explore").replaceChildren(make("p", { className: "note", textContent: error.message })); }
}
