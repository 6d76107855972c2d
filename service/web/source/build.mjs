// Builds the viewer: `node build.mjs` writes ../built anew (index.html, hashed scripts and styles, licences).

import { mkdir, readFile, readdir, rename, rm, writeFile } from "node:fs/promises";
import { dirname, join, relative } from "node:path";
import { fileURLToPath } from "node:url";

import { build } from "esbuild";

import { unusedParts } from "./unused.mjs";

const SOURCE = dirname(fileURLToPath(import.meta.url));
const BUILT = join(SOURCE, "..", "built");
const MAKING = `${BUILT}.making`;

/** Return the names of the packages that a bundle has something of. */
function bundledPackages(inputs) {
  const names = Object.keys(inputs).map((path) => /node_modules\/((?:@[^/]+\/)?[^/]+)\//.exec(path)?.[1]);
  return [...new Set(names)].filter((name) => name !== undefined).sort();
}

/** Return the licence of a package as text. Throws where it brings none. */
async function licenceOf(name) {
  const folder = join(SOURCE, "node_modules", name);
  const { version, license } = JSON.parse(await readFile(join(folder, "package.json"), "utf8"));
  const file = (await readdir(folder)).find((entry) => /^licen[cs]e(\.|$)/i.test(entry));
  const text = file === undefined ? `Licence: ${license}` : await readFile(join(folder, file), "utf8");
  return `${name} ${version} (${license})\n\n${text.trim()}\n`;
}

/** Return index.html with the addresses of its script and style, relative to <base>. */
async function page(outputs) {
  const [script, { cssBundle }] = Object.entries(outputs).find(([, output]) => output.entryPoint);
  const address = (path) => `web/${relative(MAKING, join(SOURCE, path))}`;
  const lines = [`<script type="module" src="${address(script)}"></script>`];
  if (cssBundle !== undefined) lines.unshift(`<link rel="stylesheet" href="${address(cssBundle)}" />`);
  const html = await readFile(join(SOURCE, "index.html"), "utf8");
  return html.replace("<!-- assets -->", lines.join("\n    "));
}

await rm(MAKING, { recursive: true, force: true });
const { metafile } = await build({
  absWorkingDir: SOURCE,
  entryPoints: [{ in: "app/main.ts", out: "main" }],
  outdir: MAKING,
  entryNames: "[name]-[hash]",
  chunkNames: "[name]-[hash]",
  assetNames: "[name]-[hash]",
  bundle: true,
  splitting: true,
  format: "esm",
  target: "es2022",
  minify: true,
  metafile: true,
  plugins: [unusedParts],
  legalComments: "none", // all licences are in licences.txt
  logLevel: "warning",
});
await mkdir(MAKING, { recursive: true });
const licences = await Promise.all(bundledPackages(metafile.inputs).map(licenceOf));
await writeFile(join(MAKING, "licences.txt"), licences.join(`\n${"-".repeat(80)}\n\n`));
await writeFile(join(MAKING, "index.html"), await page(metafile.outputs));
await rm(BUILT, { recursive: true, force: true });
await rename(MAKING, BUILT);
