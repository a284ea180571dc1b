// What belongs to a figure besides its traces: the legend that shows and hides, and the values where the pointer rests.
function addLegend(element, figure, hidden, keyOf, render) {
  const entries = new Map();
  for (const trace of figure.data) if (trace.showlegend !== false && trace.name && !entries.has(keyOf(trace))) entries.set(keyOf(trace), trace);
  if (figure.layout?.showlegend === false || entries.size < 2) return;
  const legend = document.createElement("div");
  legend.className = "legend";
  const refresh = () => [...legend.children].forEach((button) => button.setAttribute("aria-pressed", String(!hidden.has(button.key))));
  for (const [key, trace] of entries) {
    const button = document.createElement("button"), mark = svg("svg", { viewBox: "-8 -8 16 16", width: 14, height: 14, "aria-hidden": "true" });
    const symbol = each(trace.marker?.symbol, 0) ?? "circle", style = `--c: ${inkOf(each(trace.marker?.color ?? trace.line?.color, 0))}`;
    const line = !(trace.mode ?? "").includes("markers") && trace.type !== "bar" && trace.type !== "box";
    mark.append(line ? svg("path", { d: "M-8 0H8", class: "line", "stroke-width": 3, style })
      : svg("path", { d: SHAPES[symbol.replace("-open", "")] ?? SHAPES.circle, class: symbol.endsWith("-open") ? "point open" : "point", style }));
    button.type = "button";
    button.key = key;
    button.append(mark, linesOf(trace.name).join(" "));
    button.title = "Click to show or hide, double-click to show alone";
    button.addEventListener("click", () => { if (!hidden.delete(key)) hidden.add(key); refresh(); render(); });
    button.addEventListener("dblclick", () => {
      for (const other of entries.keys()) if (other === key) hidden.delete(other); else hidden.add(other);
      refresh();
      render();
    });
    legend.append(button);
  }
  refresh();
  element.append(legend);
}

function tipText(trace, at) {
  const values = { x: (trace.x ?? [])[at], y: (trace.y ?? [])[at], text: each(trace.text, at), "fullData.name": trace.name };
  const fill = (text) => linesOf(text.replace(/%\{([^}:]+)(?::\.(\d)f)?\}/g, (_, name, places) => {
    const value = values[name];
    return places !== undefined && typeof value === "number" ? value.toFixed(+places) : typeof value === "number" ? digits(value, 4) : value ?? "";
  })).filter(Boolean);
  const template = trace.hovertemplate ?? "%{x}, %{y}<extra>%{fullData.name}</extra>", extra = template.match(/<extra>(.*)<\/extra>/)?.[1] ?? "";
  return [...(extra ? fill(extra) : []), ...fill(template.replace(/<extra>.*<\/extra>/, ""))];
}

function spotsOf(chart, shown) {
  const spots = [];
  for (const panel of chart.panels)
    for (const trace of panel.traces.filter(shown)) {
      if (trace.hoverinfo === "skip" || trace.quartiles) continue;
      const across = trace.type === "box" && trace.orientation === "h";
      const count = (trace.x ?? trace.y).length;
      for (let at = 0; at < count; at++) {
        const point = across ? panel.place(trace.x[at], trace.name) : panel.place(trace.x[at], trace.y[at]);
        if (point) spots.push({ x: point[0], y: point[1], trace, at });
      }
    }
  return spots;
}

function addHover(canvas, tip, chart, shown) {
  canvas.addEventListener("pointermove", (event) => {
    const frame = canvas.getBoundingClientRect(), x = event.clientX - frame.left, y = event.clientY - frame.top;
    let best = null, nearest = 30 ** 2;
    for (const spot of spotsOf(chart, shown)) {
      const distance = (spot.x - x) ** 2 + (spot.y - y) ** 2;
      if (distance < nearest) [best, nearest] = [spot, distance];
    }
    tip.classList.toggle("on", best !== null);
    if (best === null) return;
    tip.replaceChildren(...tipText(best.trace, best.at).map((line) => Object.assign(document.createElement("div"), { textContent: line })));
    tip.style.left = `${Math.max(4, Math.min(best.x + 12, frame.width - tip.offsetWidth - 4))}px`;
    tip.style.top = `${Math.max(0, best.y - tip.offsetHeight - 10)}px`;
  });
  canvas.addEventListener("pointerleave", () => tip.classList.remove("on"));
}
