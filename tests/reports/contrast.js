// How many elements have text of their own, and which of them contrast with their ground by less than 4.5 (WCAG).
(() => {
  const pen = Object.assign(document.createElement("canvas"), {width: 1, height: 1}).getContext("2d", {willReadFrequently: true});
  const layers = (element) => { const found = []; for (let at = element; at; at = at.parentElement) found.unshift(getComputedStyle(at)); return found; };
  const paint = (colours) => { pen.fillStyle = "white"; pen.fillRect(0, 0, 1, 1); for (const each of colours) { pen.fillStyle = each; pen.fillRect(0, 0, 1, 1); } return pen.getImageData(0, 0, 1, 1).data; };
  const light = (data) => { const [r, g, b] = [...data].map((v) => v / 255).map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)); return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const bad = []; let seen = 0;
  for (const element of document.querySelectorAll("body *")) {
    const own = [...element.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim());
    if (!own || element.closest("script, style, option, canvas, .tip, :disabled") || !element.getClientRects().length) continue;
    const styles = layers(element), ground = styles.map((style) => style.backgroundColor), mine = styles.at(-1);
    const text = element.namespaceURI.endsWith("svg") ? mine.fill : mine.color;
    const hatched = styles.some((style) => style.backgroundImage !== "none");
    if (hatched) ground.push(getComputedStyle(document.documentElement).colorScheme.includes("dark") && DARK ? "#3a201b" : "#fbe4df");
    const [a, b] = [light(paint([...ground, text])), light(paint(ground))].sort((x, y) => y - x);
    seen += 1;
    if ((a + 0.05) / (b + 0.05) < 4.5) bad.push([element.tagName, element.className.baseVal ?? element.className, element.textContent.slice(0, 30), ((a + 0.05) / (b + 0.05)).toFixed(2)].join(" | "));
  }
  return [seen, [...new Set(bad)]];
})()
