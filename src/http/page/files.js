// Files that are dropped or picked: their paths, which of them are models, and what models name that is not there.

const MODEL = /\.(glb|gltf|obj|b3dm|i3dm|zip)$/i;
const MOST = 2000;

/** `[{path, file}]` of a drop, folders walked. */
export async function fromDrop(transfer) {
  const entries = [...transfer.items].filter((i) => i.kind === "file").map((i) => i.webkitGetAsEntry?.() ?? i.getAsFile());
  const found = [];
  const walk = async (entry, path) => {
    if (!entry || found.length >= MOST) return;
    if (entry instanceof File) found.push({ path: entry.name, file: entry });
    else if (entry.isFile) found.push({ path: path + entry.name, file: await new Promise((yes, no) => entry.file(yes, no)) });
    else {
      const reader = entry.createReader();
      for (;;) {
        const some = await new Promise((yes, no) => reader.readEntries(yes, no));
        if (!some.length) break;
        for (const child of some) await walk(child, `${path}${entry.name}/`);
      }
    }
  };
  for (const entry of entries) await walk(entry, "");
  return found;
}

/** The same of a picker. */
export const fromInput = (input) => [...input.files].slice(0, MOST).map((file) => ({ path: file.webkitRelativePath || file.name, file }));

export const isModel = (path) => MODEL.test(path);

const clean = (path) => {
  const parts = [];
  for (const part of path.replaceAll("\\", "/").split("/")) {
    if (part === "..") parts.pop();
    else if (part && part !== ".") parts.push(part);
  }
  return parts.join("/");
};
const folder = (path) => path.slice(0, path.lastIndexOf("/") + 1);
const decoded = (text) => { try { return decodeURIComponent(text); } catch { return text; } };

/** Side files that models name and that are not among the files: `[{model, name}]`. Files are found by their path, or by their name where only one has it. */
export async function missing(files) {
  const paths = new Map(files.map((f) => [clean(f.path).toLowerCase(), f]));
  const names = new Map();
  for (const f of files) {
    const name = clean(f.path).split("/").pop().toLowerCase();
    names.set(name, (names.get(name) ?? 0) + 1);
  }
  const find = (from, name) => paths.get(clean(folder(from) + name).toLowerCase()) ?? (names.get(clean(name).split("/").pop().toLowerCase()) === 1 ? files.find((f) => clean(f.path).split("/").pop().toLowerCase() === clean(name).split("/").pop().toLowerCase()) : undefined);
  const absent = [];
  const want = (model, from, name) => {
    const found = find(from, name);
    if (!found && !absent.some((a) => a.model === model && a.name === name)) absent.push({ model, name });
    return found;
  };
  for (const { path, file } of files) {
    if (/\.gltf$/i.test(path)) {
      const json = await file.text().then(JSON.parse).catch(() => null);
      for (const kind of ["buffers", "images"]) for (const o of Array.isArray(json?.[kind]) ? json[kind] : []) if (typeof o?.uri === "string" && !/^data:/i.test(o.uri)) want(path, path, decoded(o.uri));
    } else if (/\.obj$/i.test(path)) {
      const head = await file.slice(0, 262144).text();
      for (const [, names] of head.matchAll(/^[ \t]*mtllib[ \t]+(.+?)[ \t]*\r?$/gm)) {
        const mtl = want(path, path, names);
        if (!mtl) continue;
        const text = await mtl.file.text();
        // Options stand before the name: `-bm 0.5 bump.png`.
        for (const [, rest] of text.matchAll(/^[ \t]*(?:map_\w+|bump|norm|disp|decal|refl)[ \t]+(.+?)[ \t]*\r?$/gim)) {
          const name = rest.replace(/^(?:-(?:o|s|t)(?:[ \t]+-?[\d.]+){1,3}[ \t]+|-(?:mm)(?:[ \t]+-?[\d.]+){2}[ \t]+|-\w+[ \t]+\S+[ \t]+)*/, "");
          want(path, mtl.path, name);
        }
      }
    }
  }
  return absent;
}
