// An esbuild plugin that leaves out of three's bundle the shaders of materials which the viewer does not draw with.
//
// three's renderer names every built-in shader, lights and shadows among them, so that no tree-shaking drops one. The
// scene has shaders of its own; of three's those of points stay, which a loader of tiles may make.

import { readFile } from "node:fs/promises";

const KEPT = ["points_vert", "points_frag"];
const LITERAL = /^(?:var|const) ([\w$]+) = ("(?:[^"\\\n]|\\.)*");$/gm;

/** Return the names of the chunks that the kept shaders include, themselves among them. */
function included(textOf) {
  const names = new Set();
  const take = (name) => {
    if (names.has(name)) return;
    names.add(name);
    for (const [, other] of textOf(name).matchAll(/#include <([\w.]+)>/g)) take(other);
  };
  KEPT.forEach(take);
  return names;
}

/** Return three's module with an empty text for every shader that is not kept. Throws where it is made otherwise. */
export function withoutUnusedShaders(source) {
  const texts = new Map([...source.matchAll(LITERAL)].map(([, variable, text]) => [variable, JSON.parse(text)]));
  const table = /^const ShaderChunk = \{\n([^}]*)\};$/m.exec(source)?.[1];
  const variables = new Map([...(table ?? "").matchAll(/^\t(\w+): ([\w$]+),?$/gm)].map(([, name, variable]) => [name, variable]));
  if (variables.size < 100) throw new Error("three's ShaderChunk is not where it was; look at shaders.mjs");
  const kept = included((name) => texts.get(variables.get(name)) ?? "");
  const dropped = new Set([...variables].filter(([name]) => !kept.has(name)).map(([, variable]) => variable));
  return source.replace(LITERAL, (line, variable) => (dropped.has(variable) ? `var ${variable} = "";` : line));
}

export const unusedShaders = {
  name: "unused-shaders",
  setup(build) {
    build.onLoad({ filter: /three[\\/]build[\\/]three\.module\.js$/ }, async ({ path }) => ({
      contents: withoutUnusedShaders(await readFile(path, "utf8")),
      loader: "js",
    }));
  },
};
