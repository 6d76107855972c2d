// An esbuild plugin that leaves out of the bundle what the viewer never draws or reads with.
//
// three's renderer names every built-in shader, lights and shadows among them, so that no tree-shaking drops one; the
// scene has shaders of its own alone. And the renderer of tiles brings three's loader of glTF, with skins, animations and
// materials; our tiles are points, which scene/glb.ts reads.

import { readFile } from "node:fs/promises";

const LITERAL = /^(?:var|const) ([\w$]+) = ("(?:[^"\\\n]|\\.)*");$/gm;

/** Return three's module with an empty text for every built-in shader. Throws where it is made otherwise. */
export function withoutShaders(source) {
  const table = /^const ShaderChunk = \{\n([^}]*)\};$/m.exec(source)?.[1];
  const variables = new Set([...(table ?? "").matchAll(/^\t\w+: ([\w$]+),?$/gm)].map(([, variable]) => variable));
  if (variables.size < 100) throw new Error("three's ShaderChunk is not where it was; look at unused.mjs");
  return source.replace(LITERAL, (line, variable) => (variables.has(variable) ? `var ${variable} = "";` : line));
}

export const unusedParts = {
  name: "unused-parts",
  setup(build) {
    build.onLoad({ filter: /three[\\/]build[\\/]three\.module\.js$/ }, async ({ path }) => ({
      contents: withoutShaders(await readFile(path, "utf8")),
      loader: "js",
    }));
    build.onLoad({ filter: /three[\\/]examples[\\/]jsm[\\/]loaders[\\/]GLTFLoader\.js$/ }, () => ({
      contents: "export class GLTFLoader {}",
      loader: "js",
    }));
  },
};
