/** Starts the page. */

import "./main.css";

import { Scene } from "../scene/scene.ts";

declare global {
  interface Window {
    spicd?: { scene: Scene };
  }
}

const container = document.createElement("main");
document.body.append(container);
window.spicd = { scene: new Scene(container, { fetch: (...given) => fetch(...given) }) };
