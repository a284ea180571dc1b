// The page of one run: whichever its address names.
const $ = (id) => document.getElementById(id);
const section = (id, title, ...children) => make("section", { id }, make("h2", { textContent: title }), ...children);
const figure = (id, caption) => {
  const place = make("div", { id, className: "figure" });
  place.dataset.label = caption;
  return make("figure", {}, place, make("figcaption", { textContent: caption }));
};
const show = (id, specification) => { FIGURES[id] = specification; inSight.observe($(id)); };
const table = (heads, rows, kind = "n") => {
  const made = make("table", {}, make("thead", {}, make("tr", {}, ...heads.map((name, at) => make("th", { className: at ? kind : "", scope: "col", textContent: name })))),
    make("tbody", {}, ...rows.map((row) => make("tr", {}, ...row.map((value, at) => make("td", { className: at ? kind : "sticky" }, ...(at ? [value] : breakable(value))))))));
  return make("div", { className: "scroll", tabIndex: 0 }, made);
};

/** Choices that lead to the other runs of this tracker and this sequence, and to the same cell of others. */
function addChoices(all, id) {
  const here = all.runs.find((run) => run[0] === id);
  if (!here) return null;
  const [, tracker, sequence] = here, paged = all.runs.filter((run) => run === here || !(run[5] & 4));
  const nearest = (fits) => paged.filter(fits).sort((a, b) => (b[3] === here[3]) - (a[3] === here[3]))[0];
  const choice = (name, entries, chosen) => {
    const select = make("select", { ariaLabel: name }, ...entries.map(([value, text]) => make("option", { value, textContent: text, selected: value === chosen })));
    select.addEventListener("change", () => { location.hash = select.value; });
    return make("label", { className: "check" }, `${name} `, select);
  };
  const trackers = all.trackers.flatMap((entry, at) => { const run = nearest((r) => r[1] === at && r[2] === sequence); return run ? [[run[0], entry.label]] : []; });
  const sequences = all.sequences.flatMap((entry, at) => { const run = nearest((r) => r[2] === at && r[1] === tracker); return run ? [[run[0], entry.name]] : []; });
  const repeats = paged.filter((run) => run[1] === tracker && run[2] === sequence).map((run) => [run[0], run[3] + (run[4] ? ` (${run[4]})` : "")]);
  const own = (entries, at) => entries.find(([value]) => all.runs.find((run) => run[0] === value)[at] === here[at])?.[0];
  $("run-choice").replaceChildren(choice("Tracker", trackers, own(trackers, 1)), choice("Sequence", sequences, own(sequences, 2)), choice("Repeat", repeats, id));
  return { label: all.trackers[tracker].label, colour: all.trackers[tracker].colour, sequence: all.sequences[sequence].name, repeat: here[3], pictured: here[5] & 2, paged: !(here[5] & 4) };
}

function factsOf(run) {
  const cards = run.facts.map(([name, value, unit]) => make("div", { className: "card" }, make("b", { textContent: `${Number.isInteger(value) ? value : digits(value)}${unit && ` ${unit}`}` }), make("span", { textContent: name })));
  const parts = [make("div", { className: "cards" }, ...cards)];
  if (run.reason || run.ending) parts.unshift(make("p", { className: "note", textContent: [run.ending, run.reason].filter(Boolean).join(": ") }));
  if (run.command) parts.push(make("h3", { textContent: "Make it again" }), make("pre", { tabIndex: 0, textContent: run.command }));
  if (run.notes.length) parts.push(make("ul", { className: "plain" }, ...run.notes.map((note) => make("li", { textContent: note }))));
  return section("s-facts", "Numbers", ...parts);
}

function settingsOf(run) {
  const asked = new Set(run.overrides);
  const rows = Object.entries(run.settings).map(([name, value]) => [name + (asked.has(name) ? " *" : ""), String(value)]);
  if (!rows.length) return section("s-settings", "Settings", make("p", { className: "waiting", textContent: "None are recorded." }));
  return section("s-settings", "Settings", table(["setting", "value"], rows, "words"), make("p", { className: "caption", textContent: "* asked for in place of the default." }));
}

const logOf = (run) => section("s-log", "Log", make("pre", { tabIndex: 0, textContent: run.log || "The run wrote nothing." }),
  make("p", { className: "caption", textContent: [`Started ${run.started}`, run.machine, run.asked && `asked for by: ${run.asked}`].filter(Boolean).join(". ") }));

function stagesOf(run) {
  if (!run.stages.length) return [];
  const rows = run.stages.map(([name, ...times]) => [name, ...times.map((time) => digits(time))]);
  const parts = [table(["stage", "median ms", "p95 ms", "mean ms"], rows), make("p", { className: "caption", textContent: "total is the frame time: segmentation included, read (decoding) excluded; processor is what all its threads took." })];
  if (run.frames.stages) parts.unshift(figure("stage-stack", "Time of every frame, stage above stage; the first frames, which load and compile, may rise above the figure."));
  return [section("s-stages", "Time by stage", ...parts)];
}

function timeOf(run) {
  if (!run.frames.t && !run.track.t) return [];
  const share = run.frames.share ? `, and the share of the image that shows people (${run.frames.share_source})` : "";
  return [section("s-time", "Over time", figure("over-time", `Errors frame by frame${share}; features and matches where the tracker tells them. Lines have gaps where frames were lost.`),
    ...(run.track.xyz ? [figure("poses", `Position, and rotation from the first true pose; the truth in grey.${run.track.doubt ? ` ${run.track.doubt}` : ""}`)] : []))];
}

function spreadOf(run) {
  return run.track.error_mm ? [section("s-spread", "How the error is spread", figure("spread", "Absolute error of the tracked frames: how many frames have it, and the share of frames below it."))] : [];
}

function trackOf(run) {
  if (!run.track.xyz) return [section("s-track", "Track", make("p", { className: "waiting", textContent: run.track.reason ?? "Nothing was tracked." }))];
  const canvas = make("canvas", { className: "view3d", tabIndex: 0, ariaLabel: "The track in a 3-D view, coloured by its error; arrow keys turn it" });
  canvas.setAttribute("role", "img");
  const most = run.track.error_mm ? Math.max(quantile(run.track.error_mm.filter((value) => value !== null).sort((a, b) => a - b), 0.98), 1e-3) : 0;
  const ramp = make("span", { className: "ramp" });
  ramp.style.background = `linear-gradient(90deg, ${[0, 0.25, 0.5, 0.75, 1].map(rampColour).join(", ")})`;
  const keys = run.track.error_mm ? [make("div", { className: "keys" }, "0", ramp, `${digits(most)} mm and more`, make("span", {}, "grey: true path"))] : [];
  return [section("s-track", "Track", make("div", { className: "grid-2" },
    make("div", {}, canvas, ...keys, make("p", { className: "caption", textContent: `Drag or use the arrow keys to turn it. ${run.track.alignment ? `Aligned (${run.track.alignment}).` : "No ground truth: as the tracker gave it."}` })),
    make("div", { id: "annotations" })))];
}

async function render(id) {
  const main = $("run");
  try {
    const all = await side("explore"), where = addChoices(all, id);
    if (!where && id && all.unlisted) throw new Error(`Run ${id} has no page here, if it is in this report at all. ${all.pageless}`);
    if (!where) throw new Error(id ? `There is no run ${id} in this report.` : "No run is named behind # in the address.");
    if (!where.paged) throw new Error(`Run ${id} has no page here. ${all.pageless}`);
    const run = unpacked(await side(`run-${id}`));
    document.title = `${where.label} on ${where.sequence}`;
    $("run-title").textContent = document.title;
    const tag = make("span", { className: `tag ${run.status === "ok" ? "here" : "bad"}`, textContent: run.ending || run.status });
    $("run-line").replaceChildren(tag, ` ${where.repeat} · run ${id} · ${run.protocol}`);
    main.replaceChildren(factsOf(run), ...trackOf(run), ...timeOf(run), ...spreadOf(run), ...stagesOf(run),
      section("s-frames", "Frames", make("div", { id: "frames" })), settingsOf(run), logOf(run));
    drawRunFigures(run, where);
    main.querySelectorAll("table").forEach((each) => each.classList.add("plain-table"));
    await showAnnotations(id, run, where, startView3D(run));
    document.querySelectorAll("nav a").forEach((link) => { link.hidden = !document.querySelector(link.getAttribute("href")); });
  } catch (error) { main.replaceChildren(make("p", { className: "note", textContent: error.message })); }
}

function startView3D(run) {
  const canvas = document.querySelector(".view3d");
  if (!canvas) return null;
  const errors = run.track.error_mm ?? null;
  const view3d = new View3D(canvas, run.track.xyz, run.track.true_xyz ?? null, errors, errors ? Math.max(quantile(errors.filter((value) => value !== null).sort((a, b) => a - b), 0.98), 1e-3) : 1);
  view3d.draw();
  return view3d;
}

function startRun() {
  const now = () => address.read().anchor;
  const known = (id) => /^[0-9a-f]{16}$/.test(id);
  let shown = known(now()) ? now() : "";
  document.querySelectorAll("nav a").forEach((link) => link.addEventListener("click", () => history.replaceState(null, "", `#${shown}`)));
  addEventListener("hashchange", () => { if (known(now()) && now() !== shown) { shown = now(); render(shown); } });
  render(shown);
}
