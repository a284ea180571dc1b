// All trackers on all sequences: which number, in which unit, of which sequences; a cell leads to its run.
async function startErrors() {
  const data = await side("board"), view = { number: "0", scale: "abs", kind: "", ...Object.fromEntries(address.read()) };
  const known = data.metrics.map((metric, at) => ({ ...metric, at })).filter(({ at }) => data.cells.some((cell) => cell[5][at] !== null));
  const cells = new Map(data.cells.map((cell) => [`${cell[0]},${cell[1]}`, cell]));
  const tags = [...new Set(data.sequences.flatMap((sequence) => sequence.tags))].sort();
  byId("metric").append(...known.map(({ name, which, at }) => make("option", { value: at, textContent: `${name}, ${which}` })));
  byId("kind").append(make("option", { value: "", textContent: "all" }), ...tags.map((tag) => make("option", { value: tag, textContent: tag })));
  let table = null;

  function cellOf(tracker, sequence, metric, base) {
    const cell = cells.get(`${tracker},${sequence}`);
    if (!cell) return { text: "–", value: "" };
    const [, , runs, failed, doubt, medians, run] = cell, value = medians[metric.at];
    const link = `run.html#${run}`, wrong = failed ? ` ✕${failed}` : "";
    if (value === null) return { text: failed ? `${failed} failed` : "", value: "", link, bad: failed };
    const reference = base === null ? data.sequences[sequence].static : cells.get(`${base},${sequence}`)?.[5][metric.at];
    const ratio = reference ? value / reference : null, failing = failed === runs;
    const doubted = (metric.key.startsWith("ape_rot") && doubt & 1) || doubt & 2;
    const shown = view.scale === "ratio" ? ratio : value * (metric.unit.startsWith("m") ? 1000 : 1);
    const text = shown === null ? "" : shown.toPrecision(3).replace(/e\+?.*/, () => "").replace(/\.$/, "");
    const still = metric.key === "ate_rmse_m" && value >= (data.sequences[sequence].static || Infinity); // no better than not moving
    const shade = ratio === null || failing || doubted ? null : Math.max(still ? 0 : -1, Math.min(1, Math.log(Math.max(ratio, 1e-9)) / Math.log(4)));
    return { text: failing ? `${failed} failed` : (Math.abs(shown) >= 1000 ? Math.round(shown).toString() : text) + (doubt & 2 ? data.seen : ""), value: shown ?? "", link, bad: failing, small: failing ? "" : wrong, shade };
  }

  function render() {
    byId("metric").value = view.number; byId("scale").value = view.scale; byId("kind").value = view.kind;
    const metric = known.find(({ at }) => at === +view.number) ?? known[0];
    const sequences = data.sequences.map((sequence, at) => ({ ...sequence, at })).filter(({ tags: own }) => !view.kind || own.includes(view.kind));
    const trackers = data.trackers.map((tracker, at) => ({ ...tracker, at }));
    const base = metric.at === 0 ? data.referenceAt : data.referenceAt ?? -1;
    table?.destroy();
    const head = make("thead", {}, make("tr", {}, make("th", { textContent: "tracker" }), ...sequences.map(({ name, short }) => make("th", { className: "n", title: name }, ...short.split(/(?<=[/_.?])/).flatMap((part) => [part, make("wbr")])))));
    const body = make("tbody", {}, ...trackers.map(({ label, at, ranked }) => make("tr", { className: ranked ? "" : "muted" }, make("td", { className: "name", textContent: label }),
      ...sequences.map((sequence) => {
        const { text, value, link, bad, small, shade } = cellOf(at, sequence.at, metric, base);
        const cell = make("td", { className: bad ? "n failed" : "n" }, link ? make("a", { href: link, textContent: text }) : text, ...(small ? [make("small", { textContent: small, title: "runs that failed" })] : []));
        cell.dataset.order = value;
        if (shade !== null && shade !== undefined) { cell.dataset.shade = ""; cell.style.cssText = `--s: ${Math.round(46 * Math.abs(shade))}%; --h: var(--${shade < 0 ? "better" : "worse"})`; }
        return cell;
      }))));
    byId("explore-table").replaceChildren(head, body);
    table = sortable(byId("explore-table"), { paging: trackers.length > 60, pageLength: 50, layout: { ...TABLE.layout, bottomEnd: trackers.length > 60 ? "paging" : null, topStart: { buttons: [{ extend: "colvis", text: "Columns" }] }, topEnd: "search" } });
    const unit = view.scale === "ratio" ? `ratio to ${data.reference}` : { m: "mm", "m/s": "mm/s", deg: "°", "deg/s": "°/s" }[metric.unit];
    byId("explore-caption").textContent = `${metric.name} of the ${metric.which} trajectory (${unit}), median over repeats. Blue is better than ${data.reference}, orange worse. A cell leads to its run with the median error; ✕ counts failures, which enter the ATE as a static camera or worse. ${data.protocol}.`;
  }

  const set = (name, value) => { view[name] = value; address.write({ [name]: value === { number: "0", scale: "abs" }[name] ? "" : value }); render(); };
  for (const [id, name] of [["metric", "number"], ["scale", "scale"], ["kind", "kind"]]) byId(id).onchange = ({ target }) => set(name, target.value);
  render();
}
startErrors();
