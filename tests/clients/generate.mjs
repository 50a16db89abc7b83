// The types of the OpenAPI document: node generate.mjs DOCUMENT OUT.ts. As `npx openapi-typescript` makes them, but bytes are a Blob.
import { writeFile } from "node:fs/promises";
import { pathToFileURL } from "node:url";
import openapi, { astToString } from "openapi-typescript";
import ts from "typescript";

const [, , document, out] = process.argv;
const blob = ts.factory.createTypeReferenceNode("Blob");
const types = await openapi(pathToFileURL(document), {
  defaultNonNullable: false,
  transform: schema => (schema.format === "binary" ? blob : undefined),
});
await writeFile(out, astToString(types));
