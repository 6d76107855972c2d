/** The scene: clouds, marks and one camera in a canvas. It draws, and knows no API. */

import type { Box, CloudSource, Layer, Mark, Point, SceneOptions, Shown, Theme, TileMark, View } from "./types.ts";

export class Scene {
  #container: HTMLElement;

  /** Put a canvas into `container`, which it fills and follows in size. */
  constructor(container: HTMLElement, _options: SceneOptions) {
    this.#container = container;
    this.#container.append(document.createElement("canvas"));
  }

  /** Load a cloud into a layer, in place of what was there. Rejects where it cannot be read, or was aborted. */
  async load(_layer: Layer, _source: CloudSource, _progress: (share: number) => void, _signal?: AbortSignal): Promise<void> {}

  unload(_layer: Layer): void {}

  show(_which: Shown): void {}

  setMarks(_marks: Mark[]): void {}

  setTiles(_tiles: TileMark[]): void {}

  /** Outline a mark or tile and dim the others; null: none. */
  select(_id: string | null): void {}

  flyTo(_box: Box): void {}

  topDown(): void {}

  /** Cut what lies below `low` and above `high`; metres, map frame. */
  setSection(_low: number, _high: number): void {}

  /** Bounds of what is loaded. */
  get extent(): Box | null {
    return null;
  }

  /** Return a height just under the ceiling, by the histogram of heights; null where there is no ceiling. */
  get suggestedCeiling(): number | null {
    return null;
  }

  get view(): View {
    return { position: [0, 0, 1], target: [0, 0, 0] };
  }

  set view(_view: View) {}

  setTheme(_theme: Theme): void {}

  /** Call a listener on each event; returns what stops that. */
  on(event: "pick", listener: (id: string | null) => void): () => void;
  on(event: "view" | "drawn", listener: () => void): () => void;
  on(_event: string, _listener: (id: string | null) => void): () => void {
    return () => {};
  }

  /** Read back what was drawn, row by row from the top. */
  pixels(): { width: number; height: number; rgba: Uint8Array } {
    return { width: 0, height: 0, rgba: new Uint8Array() };
  }

  /** Return where a point is seen, in CSS pixels of the container; null where it is not. */
  project(_point: Point): [number, number] | null {
    return null;
  }

  dispose(): void {
    this.#container.replaceChildren();
  }
}
