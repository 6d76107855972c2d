/** The scene: clouds, marks and one camera in a canvas. It draws, and knows no API. */

import "./scene.css";

import { ColorManagement, LinearSRGBColorSpace, MathUtils, Scene as Group, Vector4, WebGLRenderer } from "three";

import { around, grown } from "./boxes.ts";
import { Rig } from "./camera.ts";
import { FileLayer, fetchWhole } from "./layers.ts";
import type { LoadedLayer } from "./layers.ts";
import { Marks } from "./marks.ts";
import { Pace } from "./pace.ts";
import { EyeDome, pointUniforms } from "./shading.ts";
import type { Box, CloudSource, Layer, Mark, Point, SceneOptions, Shown, Theme, TileMark, View } from "./types.ts";

type Event = "pick" | "view" | "drawn";
type Listener = (id: string | null) => void;

const CLICK = 5; // CSS pixels that a pointer may go for it to be a click
const AROUND = 1.4; // metres around what is flown to
const REST_MS = 180; // without a change: the camera has come to rest
const SPARED = 4; // times as long as a frame takes, between frames while tiles come
const MOST_PIXEL_RATIO = 2;

/** Draws on demand: a frame is drawn where something has changed, and none while nothing does. */
export class Scene {
  readonly #container: HTMLElement;
  readonly #fetch: typeof fetch;
  readonly #renderer: WebGLRenderer;
  readonly #uniforms = pointUniforms();
  readonly #eyeDome = new EyeDome();
  readonly #marks = new Marks();
  readonly #rig: Rig;
  readonly #points = new Group();
  readonly #layers = new Map<Layer, LoadedLayer>();
  readonly #loading = new Map<Layer, object>();
  readonly #listeners = new Map<Event, Set<Listener>>();
  readonly #divider = document.createElement("div");
  readonly #resized: ResizeObserver;
  #shown: Shown = "both";
  #lost = true;
  #sectionChosen = false;
  #viewChosen = false;
  #frame = 0;
  #rest: ReturnType<typeof setTimeout> | undefined;
  readonly #pace = new Pace();
  #moving = false;
  #movingMs = 0; // of a frame while the camera moves
  #frameMs = 0; // of a frame with all points
  #sharpness = 1;
  #blank = true; // no cloud has come yet, and none was refused
  #announced = false;
  #drawnAt = 0;
  #refreshing: ReturnType<typeof setTimeout> | undefined;
  #late: ReturnType<typeof setTimeout> | undefined;

  /** Put a canvas into `container`, which it fills and follows in size. Throws an Error where there is no WebGL 2. */
  constructor(container: HTMLElement, options: SceneOptions) {
    ColorManagement.enabled = false; // colours of clouds and kinds are for the screen as they are
    this.#container = container;
    this.#fetch = options.fetch;
    this.#renderer = new WebGLRenderer({ antialias: false, powerPreference: "high-performance" });
    this.#renderer.outputColorSpace = LinearSRGBColorSpace;
    this.#renderer.autoClear = false;
    const canvas = this.canvas;
    canvas.style.opacity = "0"; // it is black until the first frame
    canvas.tabIndex = 0;
    canvas.className = "scene-canvas";
    canvas.setAttribute("role", "application");
    canvas.setAttribute("aria-label", "The map in 3D. Arrows turn, Shift and arrows move, plus and minus zoom, Home shows all, End from above.");
    this.#divider.className = "scene-divider";
    this.#divider.hidden = true;
    container.append(canvas, this.#divider);
    this.#rig = new Rig(canvas, () => this.#moved(), () => this.#moved());
    this.#listenForPicks(canvas);
    canvas.addEventListener("webglcontextrestored", () => this.#invalidate());
    this.#resized = new ResizeObserver(() => this.#resize());
    this.#resized.observe(container);
    this.setTheme("light");
    this.#resize();
  }

  get canvas(): HTMLCanvasElement {
    return this.#renderer.domElement;
  }

  /** Load a cloud into a layer, in place of what was there. Rejects where it cannot be read, or was aborted. */
  async load(layer: Layer, source: CloudSource, progress: (share: number) => void, signal?: AbortSignal): Promise<void> {
    try {
      await this.#put(layer, source, progress, signal);
    } finally {
      this.#blank = false;
      this.#invalidate();
    }
  }

  async #put(layer: Layer, source: CloudSource, progress: (share: number) => void, signal: AbortSignal | undefined): Promise<void> {
    const ticket = {};
    this.#loading.set(layer, ticket);
    const loaded = await this.#loaded(layer, source, progress, signal);
    if (signal?.aborted === true || this.#loading.get(layer) !== ticket) {
      loaded.dispose();
      throw new DOMException("another cloud was asked for", "AbortError");
    }
    this.unload(layer);
    this.#layers.set(layer, loaded);
    this.#points.add(loaded.group);
    loaded.paintMoved(this.#marks.moved);
    this.#fit();
    loaded.update(this.#rig.camera, this.#renderer); // a tileset asks for what the first view shows
    await loaded.ready;
    if (this.#layers.get(layer) === loaded) this.#fit();
    progress(1);
  }

  unload(layer: Layer): void {
    const loaded = this.#layers.get(layer);
    this.#loading.delete(layer);
    if (loaded === undefined) return;
    this.#layers.delete(layer);
    this.#points.remove(loaded.group);
    loaded.dispose();
    this.#announced = false;
    this.#invalidate();
  }

  /** Choose the clouds that are shown; `lost`: with the map also which of its points the survey tells as gone. */
  show(which: Shown, lost = true): void {
    [this.#shown, this.#lost] = [which, lost];
    this.#divider.hidden = which !== "split";
    this.#resize();
  }

  setMarks(marks: Mark[]): void {
    this.#marks.set(marks);
    for (const layer of this.#layers.values()) layer.paintMoved(this.#marks.moved);
    this.#highlight();
  }

  setTiles(tiles: TileMark[]): void {
    this.#marks.setTiles(tiles);
    this.#highlight();
  }

  /** Outline a mark or tile and dim the others; null: none. */
  select(id: string | null): void {
    this.#marks.select(id);
    this.#highlight();
  }

  flyTo(box: Box): void {
    this.#viewChosen = true;
    this.#rig.fly(this.#rig.viewAround(box, AROUND), this.#frameMs);
  }

  topDown(): void {
    const extent = this.extent;
    if (extent === null) return;
    this.#viewChosen = true;
    this.#rig.fly(this.#rig.viewOf(extent, "above"), this.#frameMs);
  }

  /** Cut what lies below `low` and above `high`; metres, map frame. */
  setSection(low: number, high: number): void {
    this.#sectionChosen = true;
    this.#uniforms.section.value.set(low, high);
    this.#invalidate();
  }

  /** Bounds of what is loaded. */
  get extent(): Box | null {
    const boxes = [...this.#layers.values()].map(({ bounds }) => bounds);
    return boxes.length === 0 ? null : around(boxes);
  }

  /** Return a height just under the ceiling, by the histogram of heights; null where there is no ceiling. */
  get suggestedCeiling(): number | null {
    return this.#main?.levels.ceiling ?? null;
  }

  get view(): View {
    return this.#rig.view;
  }

  set view(view: View) {
    this.#viewChosen = true;
    this.#rig.view = view;
  }

  setTheme(theme: Theme): void {
    this.#eyeDome.setTheme(theme, this.#uniforms);
    this.#marks.setTheme(theme);
    this.#container.dataset["theme"] = theme;
    this.#invalidate();
  }

  /** Call a listener on each event; returns what stops that. */
  on(event: "pick", listener: (id: string | null) => void): () => void;
  on(event: "view" | "drawn", listener: () => void): () => void;
  on(event: Event, listener: Listener): () => void {
    const listeners = this.#listeners.get(event) ?? new Set();
    this.#listeners.set(event, listeners.add(listener));
    return () => listeners.delete(listener);
  }

  /** Read back what was drawn, row by row from the top. */
  pixels(): { width: number; height: number; rgba: Uint8Array } {
    this.#moving = false;
    this.#draw();
    const { width, height } = this.canvas;
    const upwards = new Uint8Array(4 * width * height);
    const gl = this.#renderer.getContext();
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, upwards);
    const rgba = new Uint8Array(upwards.length);
    for (let row = 0; row < height; row++) {
      rgba.set(upwards.subarray(4 * width * (height - 1 - row), 4 * width * (height - row)), 4 * width * row);
    }
    return { width, height, rgba };
  }

  /** Return where a point is seen, in CSS pixels of the container (split: of its right half); null where it is not. */
  project(point: Point): [number, number] | null {
    const at = this.#rig.project(point);
    if (at === null) return null;
    const { left, width } = this.#half(this.#shown === "split" ? "after" : null);
    return [left + ((at.x + 1) / 2) * width, ((1 - at.y) / 2) * this.#container.clientHeight];
  }

  dispose(): void {
    cancelAnimationFrame(this.#frame);
    for (const timer of [this.#rest, this.#refreshing, this.#late]) clearTimeout(timer);
    this.#resized.disconnect();
    for (const layer of [...this.#layers.keys()]) this.unload(layer);
    for (const part of [this.#rig, this.#marks, this.#eyeDome, this.#renderer]) part.dispose();
    cancelAnimationFrame(this.#frame);
    this.#container.replaceChildren();
  }

  /** The layer that tells floors and ceilings: the map, without it the survey. */
  get #main(): LoadedLayer | undefined {
    return this.#layers.get("reference") ?? this.#layers.get("survey");
  }

  async #loaded(
    layer: Layer,
    source: CloudSource,
    progress: (share: number) => void,
    signal: AbortSignal | undefined,
  ): Promise<LoadedLayer> {
    if (source.kind === "tileset") {
      const { openTileset } = await import("./tileset.ts");
      return openTileset(source, layer, this.#fetch, this.#uniforms, () => this.#refresh(), signal);
    }
    const file = await fetchWhole(source, this.#fetch, progress, signal);
    return new FileLayer(file, source, this.#uniforms);
  }

  /** Have section, ramp of colours and, at first, the camera follow what is loaded. */
  #fit(): void {
    const [extent, main] = [this.extent, this.#main];
    if (extent === null || main === undefined) return;
    const { floor, ceiling } = main.levels;
    this.#uniforms.ramp.value.set(floor, ceiling ?? extent.max[2]);
    if (!this.#sectionChosen) this.#uniforms.section.value.set(-1e9, ceiling ?? 1e9);
    this.#rig.extent = extent;
    if (!this.#viewChosen) this.#rig.view = this.#rig.viewOf(extent, "first");
    this.#invalidate();
  }

  #highlight(): void {
    const boxes = this.#marks.selectedBoxes.map((box) => grown(box, 0.06));
    const [first, second] = [boxes[0], boxes[1] ?? boxes[0]];
    this.#uniforms.dim.value = first === undefined ? 0 : 1;
    if (first !== undefined && second !== undefined) {
      const corners = [first.min, first.max, second.min, second.max];
      for (const [i, corner] of this.#uniforms.chosen.value.entries()) corner.set(...(corners[i] as Point));
    }
    this.#invalidate();
  }

  #resize(): void {
    this.#size(1);
    this.#rig.resize(this.#half("after").width, Math.max(this.#container.clientHeight, 1));
    if (!this.#viewChosen && this.extent !== null) this.#fit();
    this.#invalidate();
  }

  /** Have the picture as many pixels as the screen, or `sharpness` of them a side. */
  #size(sharpness: number): void {
    const [width, height] = [Math.max(this.#container.clientWidth, 1), Math.max(this.#container.clientHeight, 1)];
    const ratio = Math.min(devicePixelRatio, MOST_PIXEL_RATIO) * sharpness;
    this.#renderer.setDrawingBufferSize(width, height, ratio);
    this.#eyeDome.target.setSize(Math.floor(width * ratio), Math.floor(height * ratio));
    this.#uniforms.scale.value = (height * ratio) / (2 * Math.tan(MathUtils.degToRad(this.#rig.camera.fov / 2)));
    this.#sharpness = sharpness;
  }

  /** Return where a half of the split view is, CSS pixels; without one: all. */
  #half(half: "before" | "after" | null): { left: number; width: number } {
    const width = Math.max(this.#container.clientWidth, 1);
    if (half === null || this.#shown !== "split") return { left: 0, width };
    const middle = Math.floor(width / 2);
    return half === "before" ? { left: 0, width: middle } : { left: middle, width: width - middle };
  }

  #invalidate(): void {
    if (this.#frame === 0) this.#frame = requestAnimationFrame((now) => this.#step(now));
  }

  /** Ask for further tiles, and draw those that came: not each by itself where a frame takes long. */
  #refresh(): void {
    this.#refreshing ??= setTimeout(() => {
      this.#refreshing = undefined;
      this.#update();
      clearTimeout(this.#late);
      const wait = this.#drawnAt + SPARED * this.#frameMs - performance.now();
      if (wait > 0) this.#late = setTimeout(() => this.#invalidate(), wait);
      else this.#invalidate();
    }, 10);
  }

  /** Take note that the camera moves; a while later, which is longer than a frame takes, it has come to rest. */
  #moved(): void {
    if (!this.#moving) this.#pace.begins();
    this.#moving = true;
    clearTimeout(this.#rest);
    this.#rest = setTimeout(() => {
      this.#moving = false;
      this.#invalidate();
      this.#emit("view", null);
    }, REST_MS + 2 * this.#movingMs);
    this.#invalidate();
  }

  #step(now: number): void {
    this.#frame = 0;
    const flying = this.#rig.advance();
    const drawable = [...this.#layers.values()].some((layer) => layer.drawable);
    if (this.#blank && !drawable) return this.#update(); // a frame of nothing would hold up what is on its way
    const moving = this.#moving;
    this.#draw();
    if (!this.#announced && drawable) this.#announce();
    for (const layer of this.#layers.values()) layer.drawn();
    requestAnimationFrame((next) => this.#took(next - now, moving));
    if (flying) this.#invalidate();
  }

  /** Take note how long it was until a further frame could be drawn, milliseconds. */
  #took(ms: number, moving: boolean): void {
    if (!moving) this.#frameMs = ms;
    else {
      this.#movingMs = ms;
      this.#pace.took(ms);
    }
  }

  #update(): void {
    for (const layer of this.#layers.values()) layer.update(this.#rig.camera, this.#renderer);
  }

  #draw(): void {
    const [share, sharpness] = this.#moving ? [this.#pace.share, this.#pace.sharpness] : [1, 1];
    if (sharpness !== this.#sharpness) this.#size(sharpness);
    this.#rig.clip();
    for (const layer of this.#layers.values()) layer.thin(share);
    this.#update();
    this.canvas.style.opacity = "";
    this.#eyeDome.grain = Math.max(0, ...[...this.#layers.values()].map(({ spacing }) => spacing));
    this.#drawnAt = performance.now();
    for (const half of this.#shown === "split" ? (["before", "after"] as const) : [null]) this.#drawHalf(half);
  }

  #drawHalf(half: "before" | "after" | null): void {
    const { left, width } = this.#half(half);
    const [height, ratio] = [this.#container.clientHeight, this.#renderer.getPixelRatio()];
    const area = new Vector4(left, 0, left + width, height).multiplyScalar(ratio).floor();
    const { target } = this.#eyeDome;
    this.#showLayers(half);
    target.viewport.set(area.x, area.y, area.z - area.x, area.w - area.y);
    target.scissor.copy(target.viewport);
    target.scissorTest = true;
    this.#renderer.setRenderTarget(target);
    this.#renderer.clear();
    this.#renderer.render(this.#points, this.#rig.camera);
    this.#renderer.setRenderTarget(null);
    this.#renderer.setViewport(left, 0, width, height);
    this.#eyeDome.paint(this.#renderer, this.#rig.camera, area, ratio);
    this.#marks.draw(this.#renderer, this.#rig.camera, half, width * ratio, height * ratio);
  }

  /** Points that were lost are the map's: they are seen with it. */
  #showLayers(half: "before" | "after" | null): void {
    const which = half === null ? this.#shown : half === "before" ? "reference" : "survey";
    this.#layers.get("reference")?.show(which !== "survey", false);
    this.#layers.get("survey")?.show(which !== "reference", which !== "survey" && this.#lost);
  }

  /** Tell once that the first points are on the screen; reading a pixel back waits for the graphics processor. */
  #announce(): void {
    this.#announced = true;
    const began = performance.now();
    const gl = this.#renderer.getContext();
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    this.#frameMs = performance.now() - began;
    this.#emit("drawn", null);
  }

  #emit(event: Event, id: string | null): void {
    for (const listener of this.#listeners.get(event) ?? []) listener(id);
  }

  #listenForPicks(canvas: HTMLCanvasElement): void {
    let [x, y, pointers, single] = [0, 0, 0, true];
    canvas.addEventListener("pointerdown", (event) => {
      pointers += 1;
      if (pointers > 1) single = false;
      else [x, y, single] = [event.clientX, event.clientY, event.button === 0];
    });
    const ended = () => (pointers = Math.max(0, pointers - 1));
    canvas.addEventListener("pointercancel", ended);
    canvas.addEventListener("pointerup", (event) => {
      ended();
      if (single && Math.hypot(event.clientX - x, event.clientY - y) <= CLICK) this.#pick(event.clientX, event.clientY);
    });
  }

  /** Tell what is at a place of the window, CSS pixels. */
  #pick(x: number, y: number): void {
    const frame = this.canvas.getBoundingClientRect();
    const half = this.#shown !== "split" ? null : x - frame.left < this.#half("before").width ? "before" : "after";
    const { left, width } = this.#half(half);
    const ray = this.#rig.rayThrough(((x - frame.left - left) / width) * 2 - 1, 1 - ((y - frame.top) / frame.height) * 2);
    this.#emit("pick", this.#marks.pick(ray));
  }
}
