// Side files: scripts, so that they load from a folder without any server; each hands its content over once.
const SIDE = new Map();

function keep(name, content) { (SIDE.get(name) ?? expect(name)).hand(content); }

function expect(name) {
  const entry = {};
  entry.promise = new Promise((resolve, reject) => Object.assign(entry, { hand: resolve, refuse: reject }));
  SIDE.set(name, entry);
  return entry;
}

/** The content of `data/<name>.js`; rejects where the file is missing. */
function side(name) {
  if (SIDE.has(name)) return SIDE.get(name).promise;
  const entry = expect(name), script = document.createElement("script");
  script.src = `data/${name}.js`;
  script.onerror = () => { SIDE.delete(name); entry.refuse(new Error(`data/${name}.js is missing beside this page`)); };
  document.head.append(script);
  return entry.promise;
}

/** Numbers that were packed into 16 bits between their smallest and largest; null for what is none. */
function unpack([low, step, text]) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return Array.from(new Uint16Array(bytes.buffer), (value) => (value === 65535 ? null : low + step * value));
}

/** Numbers that were packed, at any depth. */
function unpacked(value) {
  if (Array.isArray(value)) return value.length === 3 && typeof value[0] === "number" && typeof value[2] === "string" ? unpack(value) : value.map(unpacked);
  return value && typeof value === "object" ? Object.fromEntries(Object.entries(value).map(([key, part]) => [key, unpacked(part)])) : value;
}
