// Frames of a run as its tracker saw them: a slider over time, the worst frames, and before against after culling.
const KEPT = "#2fd27a", CULLED = "#ff4d3d", MASK = "#ff9d1f";

const loaded = new Map();
const picture = (url) => {
  if (!loaded.has(url))
    loaded.set(url, new Promise((resolve, reject) => {
      const image = new Image();
      image.onload = () => resolve(image);
      image.onerror = () => reject(new Error(`${url} is missing beside this page`));
      image.src = url;
    }));
  return loaded.get(url);
};

/** Draw a frame: the image, the mask if `masked`, and the features that `which` names ("all", "kept" or "both"). */
async function drawFrame(canvas, frame, { masked = true, which = "both" } = {}) {
  const shape = [frame.width ?? 640, frame.height ?? 480], pen = canvas.getContext("2d");
  const image = frame.image ? await picture(frame.image) : null, mask = masked && frame.mask ? await picture(frame.mask) : null;
  const width = (canvas.width = 960), height = (canvas.height = Math.round((960 * (image?.height ?? shape[1])) / (image?.width ?? shape[0])));
  if (image) pen.drawImage(image, 0, 0, width, height);
  if (mask) pen.drawImage(tinted(mask), 0, 0, width, height);
  if (!frame.points) return;
  const places = Uint8Array.from(atob(frame.points), (letter) => letter.charCodeAt(0));
  for (let at = 0; at < places.length / 2; at++) {
    const culled = at < frame.culled;
    if (culled && which === "kept") continue;
    pen.fillStyle = culled && which === "both" ? CULLED : KEPT;
    pen.beginPath();
    pen.arc((places[2 * at] / 255) * width, (places[2 * at + 1] / 255) * height, 4, 0, 7);
    pen.fill();
  }
}

/** The mask as an orange veil. */
function tinted(mask) {
  const veil = make("canvas", { width: mask.width, height: mask.height }), pen = veil.getContext("2d");
  pen.drawImage(mask, 0, 0);
  const pixels = pen.getImageData(0, 0, mask.width, mask.height);
  const colour = [1, 3, 5].map((at) => parseInt(MASK.slice(at, at + 2), 16));
  for (let at = 0; at < pixels.data.length; at += 4) {
    const inside = pixels.data[at];
    colour.forEach((value, channel) => { pixels.data[at + channel] = value; });
    pixels.data[at + 3] = inside * 0.5;
  }
  pen.putImageData(pixels, 0, 0);
  return veil;
}

const keyRow = (entries) => make("div", { className: "keys" }, ...entries.map(([colour, text]) => {
  const dot = make("i");
  dot.style.background = colour;
  return make("span", {}, dot, text);
}));

const words = (frame) => [
  `frame ${frame.index}`, frame.error_mm === null || frame.error_mm === undefined ? "" : `${digits(frame.error_mm)} mm off the frame before`,
  frame.points ? `${frame.culled} of ${atob(frame.points).length / 2} features culled` : "", frame.share == null ? "" : `mask ${digits(frame.share)} %`,
].filter(Boolean).join(" · ");

function viewOf(frame, options) {
  const canvas = make("canvas"), view = make("div", { className: "view" }, canvas);
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", words(frame));
  view.style.setProperty("--shape", `${frame.width ?? 4} / ${frame.height ?? 3}`);
  drawFrame(canvas, frame, options).catch((error) => view.replaceChildren(make("p", { className: "note", textContent: error.message })));
  return view;
}

/** The slider: image, mask and features of a frame; the track's marker and the figures' cursors follow it. */
function addSlider(place, frames, run, view3d) {
  const canvas = make("canvas"), view = make("div", { className: "view" }, canvas), line = make("p", { className: "caption" });
  const slider = make("input", { type: "range", min: 0, max: frames.length - 1, value: frames.length - 1, ariaLabel: "Frame" });
  const veil = make("input", { type: "checkbox", checked: true });
  canvas.setAttribute("role", "img");
  view.style.setProperty("--shape", `${frames[0].width ?? 4} / ${frames[0].height ?? 3}`);
  const step = () => {
    const frame = frames[+slider.value], share = run.frames.count > 1 ? frame.index / (run.frames.count - 1) : 0;
    const t = run.frames.t[Math.min(Math.round(frame.index / run.frames.step), run.frames.t.length - 1)];
    line.textContent = `${digits(t)} s · ${words(frame)}`;
    canvas.setAttribute("aria-label", line.textContent);
    drawFrame(canvas, frame, { masked: veil.checked }).catch((error) => { line.textContent = error.message; });
    if (view3d) {
      const moment = t - ((run.track.start ?? 0) - run.frames.start);
      view3d.at = run.track.t.findIndex((value) => value >= moment - 1e-6);
      if (view3d.at < 0) view3d.at = Math.round(share * (run.track.t.length - 1));
      view3d.draw();
    }
    if (!FIGURES["over-time"]) return;
    FIGURES["over-time"].cursor = t;
    $("over-time").chart?.cursor(t);
  };
  slider.addEventListener("input", step);
  veil.addEventListener("change", step);
  const pointed = frames.some((frame) => frame.points), masked = frames.some((frame) => frame.mask);
  const keys = keyRow([...(pointed ? [[KEPT, "kept"], [CULLED, "culled"]] : []), ...(masked ? [[MASK, "mask"]] : [])]);
  if (masked) keys.append(make("label", { className: "check no-print" }, veil, "show the mask"));
  place.replaceChildren(view, slider, line, keys);
  step();
}

/** Before against after: all features on the left of the divider, only the kept ones on the right. */
function addCompare(place, frame) {
  const before = viewOf(frame, { masked: false, which: "all" }), after = viewOf(frame, { masked: false, which: "kept" });
  const slider = make("input", { type: "range", min: 0, max: 100, value: 50, ariaLabel: "Divider between before and after culling" });
  after.style.position = "absolute";
  after.style.inset = "0";
  const divider = make("div", { className: "divider" });
  const move = () => {
    after.style.clipPath = `inset(0 0 0 ${slider.value}%)`;
    divider.style.left = `calc(${slider.value}% - 1px)`;
  };
  slider.addEventListener("input", move);
  move();
  const pair = make("div", {}, before, after, divider);
  pair.style.position = "relative";
  place.append(make("h3", { textContent: "Before and after culling" }), pair, slider,
    make("p", { className: "caption", textContent: `Left of the divider all features, right of it those that were kept; ${words(frame)}.` }));
}

async function showAnnotations(id, run, where, view3d) {
  const beside = $("annotations"), below = $("frames");
  if (!where.pictured) {
    const why = "There are no pictures of this run. They are drawn of the run with the median error of each cell and of failed ones, where the sequence is on the machine and there is time; imported tracks have none.";
    (beside ?? below).append(make("p", { className: "waiting", textContent: why }));
    if (beside) $("s-frames").remove();
    return;
  }
  const { frames, stored } = await side(`annotations-${id}`);
  if (beside) addSlider(beside, frames, run, view3d);
  const worst = frames.filter((frame) => frame.error_mm != null).sort((a, b) => b.error_mm - a.error_mm).slice(0, 4);
  const culling = frames.filter((frame) => frame.culled).sort((a, b) => b.culled - a.culled)[0];
  const thumbs = worst.map((frame) => make("figure", { className: "thumb" }, viewOf(frame), make("figcaption", { textContent: words(frame) })));
  below.append(make("h3", { textContent: "Worst frames" }), make("div", { className: "thumbs" }, ...thumbs));
  if (!stored) below.append(make("p", { className: "caption", textContent: "This run was made by an older version or its tracker shows no features: only the images are known." }));
  if (!frames.some((frame) => frame.image)) below.append(make("p", { className: "caption", textContent: "The sequence is not on the machine that made this report, so there are no images." }));
  if (culling) {
    const place = make("div");
    place.style.maxWidth = "46rem";
    below.append(place);
    addCompare(place, culling);
  }
}
