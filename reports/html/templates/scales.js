// Axes: from values to pixels, ticks at round numbers, and numbers as they are read.
const niceStep = (span, count) => {
  const raw = span / Math.max(count, 1), power = 10 ** Math.floor(Math.log10(raw));
  return power * ([1, 2, 2.5, 5, 10].find((step) => step * power >= raw * 0.999) ?? 10);
};

function linearTicks(low, high, count) {
  const step = niceStep(high - low || 1, count), ticks = [];
  for (let at = Math.ceil(low / step - 1e-9); at * step <= high + step * 1e-9; at++) ticks.push(at * step);
  return ticks;
}

function logTicks(low, high, count) {
  const span = high - low, multiples = span < 0.9 ? [1, 2, 3, 4, 5, 6, 7, 8, 9] : span < 3 ? [1, 2, 5] : [1];
  let ticks = [];
  for (let power = Math.floor(low); power <= Math.ceil(high); power++)
    for (const multiple of multiples) ticks.push(multiple * 10 ** power);
  ticks = ticks.filter((tick) => Math.log10(tick) >= low - 1e-9 && Math.log10(tick) <= high + 1e-9);
  if (ticks.length < 3) return linearTicks(10 ** low, 10 ** high, Math.min(count, 5));
  const every = Math.ceil(ticks.length / Math.max(count, 2));
  return every > 1 ? ticks.filter((_, at) => at % every === 0) : ticks;
}

/** A number with so many significant digits, without an exponent where that can be read. */
function digits(value, count = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 10 ** count) return value.toFixed(0);
  return size < 1e-4 ? value.toExponential(count - 1) : value.toPrecision(count);
}

const tickText = (value) => String(+value.toPrecision(6));

/** An axis over `values` (numbers, or names for categories): `at` gives a place between 0 and 1. */
function makeScale(spec, values, anchorZero) {
  const names = values.filter((value) => typeof value === "string");
  if (spec.type === "category" || names.length) {
    const categories = [...new Set(spec.categories ?? names)];
    const place = new Map(categories.map((name, at) => [name, (at + 0.5) / categories.length]));
    return { kind: "category", categories, at: (value) => place.get(String(value)) ?? NaN };
  }
  const log = spec.type === "log";
  const usable = values.filter((value) => Number.isFinite(value) && (!log || value > 0));
  const inside = usable.map((value) => (log ? Math.log10(value) : value));
  let [low, high] = spec.range ?? [Math.min(...inside), Math.max(...inside)];
  if (!Number.isFinite(low) || !Number.isFinite(high)) [low, high] = [0, 1];
  if (!spec.range) {
    const margin = (high - low || Math.abs(high) || 1) * 0.04;
    if (anchorZero || spec.rangemode === "tozero") low = Math.min(low, 0);
    low -= low === 0 ? 0 : margin;
    high += margin;
  }
  if (high === low) high = low + 1;
  return {
    kind: log ? "log" : "linear", low, high,
    at: (value) => ((log ? Math.log10(value) : value) - low) / (high - low),
    back: (share) => (log ? 10 ** (low + share * (high - low)) : low + share * (high - low)),
    ticks: (count) => {
      const all = spec.tickvals?.filter((tick) => tick !== null) ?? (log ? logTicks : linearTicks)(low, high, count);
      const found = spec.whole ? all.filter((tick) => Number.isInteger(tick)) : all;
      const every = Math.ceil(found.length / Math.max(count + 2, 3));
      return found.filter((_, at) => at % every === 0);
    },
  };
}
