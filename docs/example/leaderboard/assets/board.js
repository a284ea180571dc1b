// The board: categories, selection, search, sort and columns, all in the address.
function startBoard() {
  const tables = new Map();
  const view = address.read();
  let sure = view.get("sure") === "1";
  const selected = new Set((view.get("select") ?? "").split(".").filter(Boolean)), panel = () => select("[data-panel]").find((each) => !each.hidden);

  /** The table of a category, made when it is first shown. */
  function tableOf(place) {
    if (tables.has(place)) return tables.get(place);
    const element = place.querySelector("table"), paging = element.rows.length > 60;
    const made = sortable(element, {
      paging, pageLength: 50, orderFixed: [0, "asc"],
      layout: { ...TABLE.layout, bottomStart: { buttons: [{ extend: "colvis", text: "Columns", columns: ":gt(1)" }] }, bottomEnd: "search", bottom2End: paging ? "paging" : null },
      columnDefs: [{ targets: 0, visible: false }, { targets: [".n", 2], type: "number" }],
      search: { search: view.get("q") ?? "" },
    });
    showSure(made);
    made.columns((view.get("hide") ?? "").split(".").filter(Boolean).map(Number)).visible(false);
    const [at, way] = (view.get("sort") ?? "").split(".");
    if (way) made.order([+at, way]).draw();
    made.on("search", () => address.write({ q: made.search() }));
    made.on("order", () => address.write({ sort: made.order().filter(([column, to]) => column && to).map(([column, to]) => `${column}.${to}`)[0] ?? "" }));
    made.on("column-visibility", () => address.write({ hide: made.columns(":not(.sure)").indexes().toArray().filter((column) => column && !made.column(column).visible()).join(".") }));
    tables.set(place, made.on("draw", ticks));
    return made;
  }

  /** The statistical columns, which one button shows and hides. */
  function showSure(made) {
    made.columns(".sure").visible(sure);
    byId("sure").setAttribute("aria-pressed", sure);
  }

  function showTab(name) {
    const panels = select("[data-panel]").map((each) => each.dataset.panel), chosen = panels.includes(name) ? name : panels[0];
    select("[data-tab]").forEach((each) => each.setAttribute("aria-selected", each.dataset.tab === chosen));
    for (const part of ["panel", "answers", "quotes"]) select(`[data-${part}]`).forEach((each) => { each.hidden = each.dataset[part] !== chosen; });
    tableOf(panel());
    ticks();
  }

  function ticks() {
    select("td input").forEach((box) => { box.checked = selected.has(box.value); });
    const button = byId("compare");
    button.disabled = selected.size !== 2;
    button.textContent = selected.size === 2 ? "Compare selected" : `Select two to compare (${selected.size})`;
  }

  select("[data-tab]").forEach((tab) => { tab.onclick = () => { showTab(tab.dataset.tab); address.write({ tab: tab === select("[data-tab]")[0] ? "" : tab.dataset.tab }); }; });
  document.addEventListener("change", ({ target }) => {
    if (!target.matches("table.board input")) return;
    target.checked ? selected.add(target.value) : selected.delete(target.value);
    address.write({ select: [...selected].join(".") });
    ticks();
  });
  byId("sure").onclick = () => { sure = !sure; address.write({ sure: sure ? "1" : "" }); tables.forEach(showSure); };
  byId("compare").onclick = () => { const [a, b] = selected; location.href = `compare.html#a=${a}&b=${b}`; };
  byId("copy-link").onclick = ({ target }) => navigator.clipboard.writeText(location.href).then(() => { target.textContent = "Link copied"; });
  showTab(view.get("tab"));
}
startBoard();
