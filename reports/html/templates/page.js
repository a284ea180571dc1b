// What every page has: theme, the view in the address, figures drawn when they come into sight, tables that sort.
const make = (tag, properties = {}, ...children) => {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
};

/** A name that may be broken behind its dots, underlines and slashes. */
const breakable = (name) => name.split(/(?<=[/_.])/).flatMap((piece, at) => (at ? [make("wbr"), piece] : [piece]));

/** The address behind #: an anchor, and the view as name=value pairs. */
const address = {
  read() {
    const [anchor, ...rest] = location.hash.slice(1).split("&");
    return { anchor: anchor.includes("=") ? "" : anchor, view: new URLSearchParams(anchor.includes("=") ? location.hash.slice(1) : rest.join("&")) };
  },
  write(view, anchor = this.read().anchor) {
    const kept = new URLSearchParams([...view].filter(([, value]) => value !== ""));
    history.replaceState(null, "", `#${[anchor, kept.toString()].filter(Boolean).join("&")}`);
  },
};

function useTheme() {
  const root = document.documentElement, button = document.querySelector(".theme");
  const themes = ["auto", "light", "dark"];
  const stored = () => { try { return localStorage.getItem("dynslam-theme"); } catch { return null; } };
  const set = (theme) => {
    if (theme === "auto") delete root.dataset.theme; else root.dataset.theme = theme;
    button.textContent = { auto: "◐ Auto", light: "☀ Light", dark: "☾ Dark" }[theme];
    dispatchEvent(new Event("themechange"));
  };
  let now = themes.includes(stored()) ? stored() : "auto";
  set(now);
  button.addEventListener("click", () => {
    now = themes[(themes.indexOf(now) + 1) % themes.length];
    try { localStorage.setItem("dynslam-theme", now); } catch { button.title = "This browser keeps nothing for pages of a folder"; }
    set(now);
  });
}

function draw(element) {
  if (element.dataset.drawn) return;
  const figure = FIGURES[element.id];
  if (!figure) return;
  element.dataset.drawn = "1";
  drawChart(element, figure);
}

const inSight = new IntersectionObserver((entries) => {
  for (const entry of entries) if (entry.isIntersecting) { draw(entry.target); inSight.unobserve(entry.target); }
}, { rootMargin: "500px" });

function sortBy(table, column, header) {
  const body = table.tBodies[0], up = header.getAttribute("aria-sort") !== "ascending";
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

function makeSortable(table) {
  const heads = [...table.tHead.rows].at(-1).cells;
  [...heads].forEach((head, column) => head.querySelector("button")?.addEventListener("click", () => sortBy(table, column, head)));
}

/** Everything is drawn and unfolded for print; tables that are too wide for the sheet are made smaller. */
function preparePrint() {
  document.querySelectorAll("main details:not(.toolbar details, .tracks)").forEach((fold) => { if (!fold.open) { fold.open = true; fold.dataset.shut = "1"; } });
  document.querySelectorAll(".figure").forEach(draw);
  const room = 1045;  // the inner width of A4 across, in CSS pixels
  for (const table of document.querySelectorAll("main table")) table.style.zoom = String(Math.min(1, room / Math.max(table.scrollWidth, 1)));
}

function startPage() {
  useTheme();
  document.querySelectorAll(".figure").forEach((element) => inSight.observe(element));
  document.querySelectorAll("main table").forEach(makeSortable);
  addEventListener("beforeprint", preparePrint);
  addEventListener("afterprint", () => {
    document.querySelectorAll("main table").forEach((table) => { table.style.zoom = ""; });
    document.querySelectorAll("details[data-shut]").forEach((fold) => { fold.open = false; delete fold.dataset.shut; });
  });
  const links = [...document.querySelectorAll("nav a[href^='#']")];
  for (const link of links)
    link.addEventListener("click", (event) => {
      event.preventDefault();
      address.write(address.read().view, link.hash.slice(1));
      document.getElementById(link.hash.slice(1))?.scrollIntoView();
    });
  const wanted = document.getElementById(address.read().anchor);
  if (wanted) wanted.scrollIntoView();
  const seen = new IntersectionObserver((entries) => entries.forEach((entry) => {
    if (entry.isIntersecting) links.forEach((link) => link.classList.toggle("here", link.hash === `#${entry.target.id}`));
  }), { rootMargin: "-20% 0px -70%" });
  links.forEach((link) => { const part = document.getElementById(link.hash.slice(1)); if (part) seen.observe(part); });
}
