// What all pages share: the system's theme, figures, sortable tables, data beside the page, the view in the address.
const byId = (id) => document.getElementById(id);
const select = (selector, from = document) => [...from.querySelectorAll(selector)];

function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

// -- the view in the address: #anchor&name=value
const address = {
  read() { return new URLSearchParams(location.hash.slice(1)); },
  write(changes) {
    const view = address.read();
    for (const [name, value] of Object.entries(changes)) value === "" || value === null ? view.delete(name) : view.set(name, value);
    history.replaceState(null, "", `#${view.toString().replace(/=(?=&|$)/g, "")}`);
  },
};

// -- data that lie beside the page: a page in a folder may load scripts, but no JSON
const loading = {}, loaded = {};
function keep(name, value) { loaded[name](value); }
function side(name) {
  loading[name] ??= new Promise((done, fail) => {
    loaded[name] = done;
    document.head.append(make("script", { src: `data/${name}.js`, onerror: () => fail(new Error(`data/${name}.js is missing beside this page.`)) }));
  });
  return loading[name];
}

// -- figures, in the theme of the reader's system
const drawn = new Map();
const dark = matchMedia("(prefers-color-scheme: dark)");

async function draw(element, figure) {
  drawn.set(element, figure);
  const layout = { ...figure.layout, template: THEMES[dark.matches ? "dark" : "light"], autosize: true };
  if (element.clientWidth < 500) layout.font = { size: 10 };
  if (element.clientWidth < 500 && layout.showlegend !== false) layout.legend = { orientation: "h", y: 1.02, yanchor: "bottom", ...layout.legend };
  const options = { format: "png", scale: 2, filename: element.id };
  await Plotly.react(element, figure.data, layout, { responsive: true, displaylogo: false, toImageButtonOptions: options });
  // points that stand for a run open it
  element.removeAllListeners("plotly_click");
  element.on("plotly_click", ({ points: [point] }) => { if (String(point?.customdata).startsWith("run.html#")) location.href = point.customdata; });
}

/** The figures of the page, each when it comes into sight. */
function drawFigures() {
  const sight = new IntersectionObserver((entries) => entries.filter((entry) => entry.isIntersecting).forEach(({ target }) => {
    sight.unobserve(target);
    draw(target, FIGURES[target.id]);
  }), { rootMargin: "300px" });
  select(".figure").filter((element) => FIGURES[element.id]).forEach((element) => sight.observe(element));
  for (const place of select(".save")) {
    for (const format of ["png", "svg"]) {
      const save = () => Plotly.downloadImage(byId(place.dataset.figure), { format, scale: 2, filename: place.dataset.figure });
      place.append(make("button", { type: "button", textContent: format.toUpperCase(), onclick: save }));
    }
  }
}

function followTheme() {
  document.documentElement.classList.toggle("dark", dark.matches); // DataTables' own switch
  drawn.forEach((figure, element) => element.isConnected && draw(element, figure));
}

// -- tables: what is missing stays last, a third click restores the order
const last = (way) => (a, b) => (a === "" || b === "" ? (a === "") - (b === "") : way * (a - b));
Object.assign(DataTable.ext.type.order, { "number-asc": last(1), "number-desc": last(-1) });
const TABLE = { paging: false, info: false, autoWidth: false, order: [], layout: { topStart: null, topEnd: null, bottomStart: null, bottomEnd: null } };

/** Tables that are wider than their place say so. */
const widths = new ResizeObserver((entries) => entries.forEach(({ target }) => {
  const whole = target.closest(".scroll"), place = whole?.querySelector(".dt-layout-table > div") ?? whole; // DataTables' own scroller
  place?.classList.toggle("wide", place.scrollWidth > place.clientWidth + 1);
}));

function sortable(table, options = {}) {
  widths.observe(table);
  if (table.closest(".scroll")) widths.observe(table.closest(".scroll"));
  return new DataTable(table, { ...TABLE, columnDefs: [{ targets: ".n", type: "number", className: "n" }], ...options });
}

for (const button of select("[data-copy]")) {
  button.onclick = () => navigator.clipboard.writeText(button.nextElementSibling.textContent).then(() => { button.textContent = "Copied"; });
}
dark.addEventListener("change", followTheme);
followTheme();
const sorts = (table) => sortable(table, table.rows.length > 25 ? { layout: { ...TABLE.layout, topEnd: "search" } } : {});
for (const table of select("table.sorts")) { // those of closed folds once they are opened: thousands of cells take seconds
  const fold = table.closest("details:not([open])");
  fold ? fold.addEventListener("toggle", () => sorts(table), { once: true }) : sorts(table);
}
addEventListener("DOMContentLoaded", drawFigures);

// -- paper: folds open, whole tables with all columns, figures at the width of a page
const PAPER_PX = 980;
const whole = []; // what puts tables back as they were
addEventListener("beforeprint", () => {
  select("details").forEach((fold) => { fold.open = true; });
  for (const element of select("table.dataTable")) {
    const table = new DataTable.Api(element), length = table.page.len(), hidden = table.columns(".sure").indexes().filter((column) => !table.column(column).visible()).toArray();
    table.columns(hidden).visible(true);
    if (length > 0) table.page.len(-1).draw(false);
    whole.push(() => { table.columns(hidden).visible(false); if (length > 0) table.page.len(length).draw(false); });
  }
  for (const element of select(".figure")) {
    if (FIGURES[element.id] && !drawn.has(element)) draw(element, FIGURES[element.id]);
    if (element.layout) Plotly.relayout(element, { width: PAPER_PX, template: THEMES.light });
  }
});
addEventListener("afterprint", () => {
  whole.splice(0).forEach((restore) => restore());
  drawn.forEach((figure, element) => element.isConnected && element.layout && draw(element, figure));
});
