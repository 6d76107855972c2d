/** Starts the page. */

import "./styles/main.css";

import { h, render } from "preact";

import { Api } from "./api.ts";
import { Controller } from "./controller.ts";
import { listen } from "./keys.ts";
import { listenForDrops } from "./drops.ts";
import { drawing, shownTheme, Stage } from "./stage.ts";
import { Page } from "./views/page.tsx";
import { keepFocus } from "./views/panels.ts";

import { KIND_COLOURS, STATE_COLOURS, TILE_COLOURS } from "../scene/colours.ts";
import type { Scene } from "../scene/scene.ts";
import type { Theme } from "../scene/types.ts";

declare global {
  interface Window {
    spicd?: { scene: Scene };
  }
}

/** Give the styles the colours that the scene has. */
function paint(theme: Theme): void {
  const { dataset, style } = document.documentElement;
  if (dataset["theme"] === theme) return;
  dataset["theme"] = theme;
  for (const [name, colour] of Object.entries({ ...STATE_COLOURS, ...TILE_COLOURS[theme], ...KIND_COLOURS }))
    style.setProperty(`--${name}`, colour);
}

const root = document.createElement("div");
root.id = "app";
document.body.append(root);

const app = new Controller(new Api(document.baseURI), (state) => {
  paint(shownTheme(state));
  const name = state.map.value?.name ?? state.place.map;
  document.title = name ? `${name} · SPICD` : "SPICD";
  const focused = document.activeElement !== document.body;
  render(h(Page, { app, stage, state }), root);
  if (focused) keepFocus();
  stage.sync(state);
});
const stage = new Stage(app);

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => app.update({}));
listen(app, stage);
listenForDrops(app);
if (app.state.place.map) drawing().catch(() => {}); // the stage says why, if it cannot
app.update({});
app.start();
