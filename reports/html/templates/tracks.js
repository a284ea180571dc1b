// Paths seen along the three axes and errors over time, of several runs on one sequence, from their side files.
const VIEWS = [["x", "y", 0, 1], ["x", "z", 0, 2], ["y", "z", 1, 2]];

/** The square window around the true path, and around those shown as far as they are not lost in space. */
function windowOf(truth, shown) {
  const ends = (list) => [Math.min(...list.filter((value) => value !== null)), Math.max(...list.filter((value) => value !== null))];
  const box = truth.map(ends), centre = box.map(([low, high]) => (low + high) / 2);
  const own = Math.max(...box.map(([low, high]) => (high - low) / 2)), reach = Math.max(own, ...shown.flatMap((xyz) => xyz.map((list, axis) => Math.max(...ends(list).map((end) => Math.abs(end - centre[axis]))))));
  return { centre, half: 1.06 * Math.max(Math.min(reach, 2.5 * own), 0.01) };
}

function pathFigure(runs) {
  const longest = [...runs].sort((a, b) => b.track.t.length - a.track.t.length)[0].track, data = [], layout = { height: 430 };
  const { centre, half } = windowOf(longest.true_xyz, runs.filter((run) => run.shown).map((run) => run.track.xyz));
  const lines = [{ name: "ground truth", colour: "ink", xyz: longest.true_xyz, shown: true, width: 2.4 }, ...runs.map((run) => ({ ...run, xyz: run.track.xyz, width: 1.4 }))];
  VIEWS.forEach(([a, b, i, j], at) => {
    const suffix = at ? String(at + 1) : "", around = (axis) => [centre[axis] - half, centre[axis] + half];
    for (const line of lines)
      data.push({ mode: "lines", name: line.name, x: line.xyz[i], y: line.xyz[j], xaxis: `x${suffix}`, yaxis: `y${suffix}`, visible: line.shown ? true : "legendonly", line: { color: line.colour, width: line.width }, hovertemplate: "%{fullData.name}<extra></extra>" });
    layout[`xaxis${suffix}`] = { title: { text: `${a} (m)` }, range: around(i) };
    layout[`yaxis${suffix}`] = { title: { text: `${b} (m)` }, range: around(j), scaleanchor: `x${suffix}` };
  });
  return { data, layout };
}

function errorFigure(runs) {
  const start = Math.min(...runs.map((run) => run.track.start));
  const data = runs.map(({ name, colour, shown, track }) => ({
    mode: "lines", name, x: track.t.map((t) => (t === null ? null : t + track.start - start)), y: track.error_mm, visible: shown ? true : "legendonly",
    line: { color: colour, width: 1.6 }, hovertemplate: "%{y} mm at %{x:.2f} s<extra>%{fullData.name}</extra>",
  }));
  return { data, layout: { height: 380, xaxis: { title: { text: "time (s)" } }, yaxis: { title: { text: "absolute error (mm)" }, rangemode: "tozero" } } };
}

async function openTracks(fold) {
  if (fold.dataset.loaded) return;
  fold.dataset.loaded = "1";
  const waiting = make("p", { className: "waiting", textContent: "Reading the runs ..." });
  fold.append(waiting);
  try {
    const wanted = JSON.parse(fold.dataset.tracks);
    const runs = (await Promise.all(wanted.map(async (each) => ({ ...each, ...unpacked(await side(`run-${each.run}`)) })))).filter((run) => run.track.true_xyz);
    const paths = make("div"), errors = make("div");
    paths.dataset.label = "Paths seen along the three axes";
    errors.dataset.label = "Absolute error over time";
    waiting.replaceWith(make("figure", {}, paths, make("figcaption", { textContent: "Paths seen along the three axes." })), make("figure", {}, errors, make("figcaption", { textContent: "Absolute translational error of the same runs, frame by frame." })));
    drawChart(paths, pathFigure(runs));
    drawChart(errors, errorFigure(runs));
  } catch (error) { waiting.replaceWith(make("p", { className: "note", textContent: error.message })); }
}

function startTracks() {
  for (const fold of document.querySelectorAll("details.tracks")) fold.addEventListener("toggle", () => { if (fold.open) openTracks(fold); });
  const near = new IntersectionObserver((entries) => entries.forEach((entry) => { if (entry.isIntersecting && entry.target.open) openTracks(entry.target); }), { rootMargin: "400px" });
  document.querySelectorAll("details.tracks").forEach((fold) => near.observe(fold));
}
