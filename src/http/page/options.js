// What is asked for: a preset, the options that matter, and all others as JSON. Names, defaults and documentation come from the service.

import { h } from "./dom.js";

/** The options that have a field of their own: by their path. */
const SHOWN = ["pack.rotation", "pack.gutter", "texture.size", "texture.format", "texture.max_size", "atlas.merge", "output"];

const LABELS = { "pack.rotation": "Rotation of charts", "pack.gutter": "Gutter", "texture.size": "Size of textures", "texture.format": "Format of textures", "texture.max_size": "Longest side", "atlas.merge": "Merge atlases", output: "Output" };

/** A schema with what it refers to. */
function resolved(root, schema) {
  const target = schema?.$ref && root.$defs?.[schema.$ref.split("/").pop()];
  return target ? { ...resolved(root, target), ...schema } : schema ?? {};
}

/** Words that may be chosen, wherever in a schema they stand. */
function words(root, schema) {
  const s = resolved(root, schema);
  return s.enum?.filter((v) => typeof v === "string") ?? (s.oneOf ?? s.anyOf ?? []).flatMap((part) => words(root, part));
}

export function buildOptions(recipes) {
  const root = recipes.options, defaults = root.default ?? {};
  const recipe = h("select", { id: "recipe", "aria-describedby": "recipe-doc", onchange: () => describe() }, recipes.recipes.map((r) => h("option", { value: r.name }, r.name.replaceAll("_", " "))));
  const doc = h("p", { className: "doc", id: "recipe-doc" });
  const describe = () => { doc.textContent = recipes.recipes.find((r) => r.name === recipe.value)?.description ?? ""; };
  describe();
  const fields = SHOWN.map((path) => {
    const keys = path.split(".");
    const schema = keys.reduce((s, key) => resolved(root, resolved(root, s).properties?.[key]), root);
    if (!schema || !Object.keys(schema).length) return null;
    const standard = keys.reduce((d, key) => d?.[key], defaults), id = `option-${keys.join("-")}`, known = words(root, schema);
    const number = schema.type === "integer" || schema.type === "number" || (schema.oneOf ?? []).some((s) => s.type === "integer");
    const described = { id, "aria-describedby": `${id}-doc` };
    let field, read;
    if (schema.type === "boolean") {
      field = h("select", described, h("option", { value: "" }, `As the preset has it`), h("option", { value: "true" }, "Yes"), h("option", { value: "false" }, "No"));
      read = () => (field.value === "" ? undefined : field.value === "true");
    } else if (number) {
      field = h("input", { ...described, type: "text", inputMode: "numeric", placeholder: `${standard ?? "auto"}` });
      read = () => (field.value.trim() === "" ? undefined : /^\d+$/.test(field.value.trim()) ? Number(field.value) : field.value.trim());
    } else {
      field = h("select", described, h("option", { value: "" }, "As the preset has it"), known.map((w) => h("option", { value: w }, w.replaceAll("_", " "))));
      read = () => field.value || undefined;
    }
    const text = (schema.description ?? "").split("\n").join(" ");
    return { path, read, element: h("div", { className: "field" }, h("label", { htmlFor: id }, LABELS[path]), field, h("p", { className: "doc", id: `${id}-doc` }, text)) };
  }).filter(Boolean);
  const gates = h("textarea", { id: "require", rows: 3, spellcheck: false, placeholder: "atlas.packing_efficiency >= 0.8\nmodel.texture_pixels <= 4000000", "aria-describedby": "require-doc" });
  const more = h("textarea", { id: "more", rows: 5, spellcheck: false, placeholder: '{ "pack": { "search": "thorough" } }', "aria-describedby": "more-doc" });
  const element = h("fieldset", {}, h("legend", { className: "hidden" }, "Options"),
    h("div", { className: "field" }, h("label", { htmlFor: "recipe" }, "What is to be done"), recipe, doc),
    h("details", {}, h("summary", {}, "Options"), fields.map((f) => f.element)),
    h("details", {}, h("summary", {}, "Requirements"), h("div", { className: "field" }, h("label", { htmlFor: "require" }, "The job fails unless"), gates, h("p", { className: "doc", id: "require-doc" }, "One bound a line: a figure of the report, >= or <=, and a number."))),
    h("details", {}, h("summary", {}, "All options as JSON"), h("div", { className: "field" }, h("label", { htmlFor: "more" }, "Options"), more, h("p", { className: "doc", id: "more-doc" }, "Any option by its name; these win over the fields above. Their schema is at ", h("a", { href: "v1/recipes" }, "/v1/recipes"), "."))));
  return {
    element,
    /** The options as the service takes them; throws where a field cannot be read. */
    read() {
      const out = { recipe: recipe.value };
      const put = (keys, value) => {
        let at = out;
        for (const key of keys.slice(0, -1)) at = at[key] ??= {};
        at[keys.at(-1)] = value;
      };
      for (const f of fields) {
        const value = f.read();
        if (value !== undefined) put(f.path.split("."), value);
      }
      for (const line of gates.value.split("\n").map((l) => l.trim()).filter(Boolean)) {
        const [, path, sign, bound] = line.match(/^([\w.]+)\s*(>=|<=)\s*(-?[\d.]+(?:e-?\d+)?)$/i) ?? [];
        if (!path) throw new Error(`The requirement “${line}” is not read: write it like atlas.packing_efficiency >= 0.8`);
        ((out.require ??= {})[path] ??= {})[sign === ">=" ? "min" : "max"] = Number(bound);
      }
      if (more.value.trim()) {
        let given;
        try { given = JSON.parse(more.value); } catch (error) { throw new Error(`The options are not JSON: ${error.message}`); }
        const merge = (into, from) => { for (const [k, v] of Object.entries(from)) into[k] = v && typeof v === "object" && !Array.isArray(v) && into[k] && typeof into[k] === "object" ? merge(into[k], v) : v; return into; };
        merge(out, given);
      }
      return out;
    },
  };
}
