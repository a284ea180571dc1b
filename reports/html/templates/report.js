const options = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d"],
                  toImageButtonOptions: { format: "svg" } };
function draw(element) {
  const figure = FIGURES[element.id];
  if (!figure || element.dataset.drawn) return;
  element.dataset.drawn = "1";
  Plotly.newPlot(element, figure.data, figure.layout, options);
}
const seen = new IntersectionObserver((entries) => {
  for (const entry of entries) if (entry.isIntersecting) { draw(entry.target); seen.unobserve(entry.target); }
}, { rootMargin: "600px" });
document.querySelectorAll(".figure").forEach((element) => {
  element.style.minHeight = (FIGURES[element.id]?.layout.height ?? 48) + "px";
  seen.observe(element);
});
addEventListener("beforeprint", () => document.querySelectorAll(".figure").forEach(draw));
function sortBy(table, column, header) {
  const body = table.tBodies[0];
  const up = header.getAttribute("aria-sort") !== "ascending";
  table.querySelectorAll("th").forEach((th) => th.removeAttribute("aria-sort"));
  header.setAttribute("aria-sort", up ? "ascending" : "descending");
  const key = (row) => {
    const cell = row.cells[column];
    if (cell.dataset.v !== undefined) return Number(cell.dataset.v);
    const text = cell.textContent.trim();
    return text === "" || text === "–" ? null : text;
  };
  const rows = [...body.rows];
  rows.sort((a, b) => {
    const x = key(a), y = key(b);
    if (x === null || y === null) return (x === null) - (y === null);
    const order = typeof x === "number" && typeof y === "number" ? x - y : String(x).localeCompare(String(y), "en", { numeric: true });
    return up ? order : -order;
  });
  rows.forEach((row) => { row.classList.remove("line"); body.append(row); });
}
document.querySelectorAll("table").forEach((table) => {
  const heads = [...table.tHead.rows].at(-1).cells;
  [...heads].forEach((head, column) => head.querySelector("button").addEventListener("click", () => sortBy(table, column, head)));
});
