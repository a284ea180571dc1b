// Figures of the exploring part: they follow its search and its choice of sequences.
const MOST_BOXES = 6;

/** Box plots of frame errors: a group of boxes for every sequence, one for every tracker. */
function boxFigure(explore, trackers, sequences) {
  const shown = trackers.filter((tracker) => sequences.some((sequence) => explore.cells.get(`${tracker.at},${sequence.at}`)?.runs.some((run) => run.quartiles.length && !run.ending))).slice(0, MOST_BOXES);
  const data = shown.map((tracker, at) => {
    const names = [], quartiles = [];
    for (const sequence of sequences) {
      const cell = explore.cells.get(`${tracker.at},${sequence.at}`), run = cell && standing(cell);
      if (!run?.quartiles.length || run.ending) continue;
      names.push(verbatim(sequence.short));
      quartiles.push(run.quartiles.map((value) => Math.max(value, 1e-3)));
    }
    return { type: "box", name: verbatim(tracker.label), x: names, quartiles, marker: { color: tracker.colour }, width: 0.9 / shown.length, shift: ((at + 0.5) / shown.length - 0.5) * 0.84 };
  });
  const known = sequences.map((sequence) => verbatim(sequence.short)).filter((name) => data.some((trace) => trace.x.includes(name)));
  return {
    data,
    layout: { height: 420, xaxis: { type: "category", categories: known }, yaxis: { type: "log", title: { text: "frame-to-frame error (mm)" } } },
  };
}

/** RMSE of the frame errors by the share of dynamic pixels, a line for every tracker. */
function shareFigure(explore, trackers) {
  const { shareEdges: edges, byShare } = explore.data;
  const percent = (value) => `${Math.round(100 * value)}`;
  const names = edges.slice(0, -1).map((low, at) => `${percent(low)}–${percent(edges[at + 1])} %`);
  const with_ = trackers.filter((tracker) => byShare[tracker.at]);
  const data = with_.map((tracker, at) => ({
    mode: "lines+markers", name: verbatim(tracker.label), visible: at < 10 ? true : "legendonly", x: names,
    y: byShare[tracker.at].map(([rmse]) => rmse), text: byShare[tracker.at].map(([, count]) => `${count} frames`),
    line: { color: tracker.colour, width: 2 }, marker: { color: tracker.colour, size: 8 },
    hovertemplate: "%{x} of the image: %{y} mm<br>%{text}<extra>%{fullData.name}</extra>",
  }));
  const used = names.filter((_, at) => with_.some((tracker) => byShare[tracker.at][at][0] !== null));
  return {
    data: data.map((trace) => ({ ...trace, ...only(trace, used) })),
    layout: { height: 420, xaxis: { type: "category", categories: used, title: { text: "share of the image that shows people" } }, yaxis: { type: "log", title: { text: "frame-to-frame error, RMSE (mm)" } } },
  };
}

function only(trace, names) {
  const kept = trace.x.map((name, at) => [name, at]).filter(([name]) => names.includes(name));
  return { x: kept.map(([name]) => name), y: kept.map(([, at]) => trace.y[at]), text: kept.map(([, at]) => trace.text[at]) };
}

function drawExploreFigures(explore, trackers, sequences) {
  for (const [id, figure, why] of [
    ["explore-boxes", boxFigure(explore, trackers, sequences), "No run shown has frames with ground truth."],
    ["explore-share", shareFigure(explore, trackers), "No run shown knows the exact share of dynamic pixels: the sequences have no exact masks, or the runs are older than this figure."],
  ]) {
    $(id).nextElementSibling.hidden = !figure.data.length;
    if (figure.data.length) drawChart($(id), figure);
    else $(id).replaceChildren(make("p", { className: "waiting", textContent: why }));
  }
}
