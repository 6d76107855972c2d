/** One camera and its controls: mouse, touch and keyboard; z is up. */

import { MathUtils, PerspectiveCamera, Ray, Vector2, Vector3 } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";

import { across, centreOf, grown, sizeOf } from "./boxes.ts";
import type { Box, Point, View } from "./types.ts";

const FIELD_OF_VIEW = 45; // degrees, upright
const CENTRED = 0.05; // metres between the middles of the picture and of a box
const FLIGHT_MS = 350;
const TURN = Math.PI / 24; // a key press
const AZIMUTH = -Math.PI * 0.36; // where the first view stands, from the middle of the map: south, and a bit east
const ELEVATION = Math.PI * 0.3;
const STEEP = Math.PI * 0.31;

/** Moves the camera; calls `changed` on each change, and `rested` when it has come to rest. */
export class Rig {
  readonly camera = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.1, 1000);
  readonly #controls: OrbitControls;
  readonly #changed: () => void;
  readonly #rested: () => void;
  #flight: { from: View; to: View; began: number } | null = null;
  #extent: Box | null = null;

  constructor(element: HTMLElement, changed: () => void, rested: () => void) {
    [this.#changed, this.#rested] = [changed, rested];
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(0, -10, 8);
    this.#controls = new OrbitControls(this.camera, element);
    this.#controls.screenSpacePanning = false;
    this.#controls.zoomToCursor = true;
    this.#controls.maxPolarAngle = Math.PI * 0.98;
    this.#controls.addEventListener("change", changed);
    this.#controls.addEventListener("start", () => (this.#flight = null));
    this.#controls.addEventListener("end", rested);
    element.addEventListener("wheel", () => rested(), { passive: true });
    element.addEventListener("keydown", (event) => this.#key(event));
  }

  get view(): View {
    return { position: this.camera.position.toArray(), target: this.#controls.target.toArray() };
  }

  set view(view: View) {
    this.#flight = null;
    this.#place(view);
    this.#rested();
  }

  /** Bounds that clipping planes and distances are chosen for; metres. */
  set extent(extent: Box) {
    this.#extent = extent;
    const size = sizeOf(extent);
    this.#controls.maxDistance = 4 * size + 10;
    this.#controls.minDistance = 0.3;
    this.clip();
  }

  resize(width: number, height: number): void {
    this.camera.aspect = width / Math.max(height, 1);
    this.camera.updateProjectionMatrix();
  }

  /** Return the view that shows a box whole, from where the camera looks now, or from the first side. */
  viewOf(box: Box, from: "here" | "first" | "above"): View {
    const target = new Vector3(...centreOf(box));
    const half = new Vector3(...across(box)).multiplyScalar(0.5);
    const direction = this.#direction(from);
    const slope = Math.tan(MathUtils.degToRad(FIELD_OF_VIEW / 2));
    const distance = Math.max(fitted(half, direction, slope, this.camera.aspect) * 1.03, 2);
    return { position: target.clone().addScaledVector(direction, distance).toArray(), target: target.toArray() };
  }

  /**
   * Return the view that shows a box with `room` metres around it, fewer where the picture is narrow. Where the camera
   * looks at its middle already it goes no farther away than it takes to show the box whole.
   */
  viewAround(box: Box, room: number): View {
    const wide = this.viewOf(grown(box, room * Math.min(1, this.camera.aspect)), "here");
    const target = new Vector3(...wide.target);
    if (this.#controls.target.distanceTo(target) > CENTRED) return wide;
    const away = (view: View) => target.distanceTo(new Vector3(...view.position));
    const reach = Math.max(away(this.viewOf(box, "here")), Math.min(away(wide), away(this.view)));
    const position = new Vector3(...wide.position).sub(target).setLength(reach).add(target);
    return { position: position.toArray(), target: wide.target };
  }

  /** Go to a view, in a short flight unless the reader wants no motion or frames are slow. */
  fly(to: View, frameMs: number): void {
    if (frameMs > 60 || matchMedia("(prefers-reduced-motion: reduce)").matches) {
      this.view = to;
      return;
    }
    this.#flight = { from: this.view, to, began: performance.now() };
    this.#changed();
  }

  /** Go on with a flight; returns whether there is one, so that a further frame is wanted. */
  advance(): boolean {
    if (this.#flight === null) return false;
    const { from, to, began } = this.#flight;
    const part = Math.min((performance.now() - began) / FLIGHT_MS, 1);
    const eased = part * part * (3 - 2 * part);
    const between = (a: Point, b: Point) => a.map((value, axis) => MathUtils.lerp(value, b[axis] as number, eased)) as Point;
    this.#place({ position: between(from.position, to.position), target: between(from.target, to.target) });
    if (part === 1) {
      this.#flight = null;
      this.#rested();
    }
    return part < 1;
  }

  /** Return the ray through a point of the picture, -1..1 to the right and upwards. */
  rayThrough(x: number, y: number): Ray {
    const through = new Vector3(x, y, 0.5).unproject(this.camera);
    return new Ray(this.camera.position.clone(), through.sub(this.camera.position).normalize());
  }

  /** Return where in the picture a point is, -1..1 to the right and upwards; null where it is behind or outside. */
  project(point: Point): Vector2 | null {
    const at = new Vector3(...point).project(this.camera);
    return Math.abs(at.x) <= 1 && Math.abs(at.y) <= 1 && Math.abs(at.z) <= 1 ? new Vector2(at.x, at.y) : null;
  }

  dispose(): void {
    this.#controls.dispose();
  }

  #place({ position, target }: View): void {
    this.#controls.target.set(...target);
    this.camera.position.set(...position);
    this.#controls.update();
    this.clip();
    this.#changed();
  }

  /** Set the clipping planes around what there is, so that depths keep their precision. */
  clip(): void {
    const size = this.#extent === null ? 100 : sizeOf(this.#extent);
    const away = this.#extent === null ? 10 : this.camera.position.distanceTo(new Vector3(...centreOf(this.#extent)));
    this.camera.far = away + size;
    this.camera.near = Math.max(0.05, Math.min(away - size, this.camera.far / 100), this.camera.far / 4000);
    this.camera.updateProjectionMatrix();
    this.camera.updateMatrixWorld();
  }

  #direction(from: "here" | "first" | "above"): Vector3 {
    if (from === "above") return new Vector3(0, -0.0001, 1).normalize();
    const here = this.camera.position.clone().sub(this.#controls.target);
    if (from === "here" && here.lengthSq() > 0) return steep(here);
    const flat = Math.cos(ELEVATION);
    return new Vector3(flat * Math.cos(AZIMUTH), flat * Math.sin(AZIMUTH), Math.sin(ELEVATION));
  }

  #key(event: KeyboardEvent): void {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const turns: Record<string, [number, number]> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const turn = turns[event.key];
    if (turn !== undefined) this.#moveBy(...turn, event.shiftKey);
    else if (event.key === "+" || event.key === "=") this.#zoomBy(1 / 1.2);
    else if (event.key === "-") this.#zoomBy(1.2);
    else if (event.key === "Home" && this.#extent !== null) this.view = this.viewOf(this.#extent, "first");
    else if (event.key === "End" && this.#extent !== null) this.view = this.viewOf(this.#extent, "above");
    else return;
    event.preventDefault();
  }

  /** Turn around the target, or with Shift go along the ground. */
  #moveBy(right: number, up: number, shift: boolean): void {
    const { target } = this.#controls;
    const away = this.camera.position.clone().sub(target);
    if (shift) {
      const ahead = new Vector3(-away.x, -away.y, 0);
      if (ahead.lengthSq() < 1e-6) ahead.set(0, 1, 0);
      ahead.normalize();
      const aside = new Vector3(ahead.y, -ahead.x, 0);
      const step = ahead.multiplyScalar(up).add(aside.multiplyScalar(right)).multiplyScalar(0.08 * away.length());
      this.view = { position: this.camera.position.clone().add(step).toArray(), target: target.clone().add(step).toArray() };
      return;
    }
    const turned = away.applyAxisAngle(this.camera.up, right * TURN);
    const aside = new Vector3(-turned.y, turned.x, 0).normalize();
    const polar = Math.acos(MathUtils.clamp(turned.z / turned.length(), -1, 1));
    const wanted = MathUtils.clamp(polar - up * TURN, 0.001, Math.PI * 0.98);
    if (aside.lengthSq() > 0) turned.applyAxisAngle(aside, wanted - polar);
    this.view = { position: turned.add(target).toArray(), target: target.toArray() };
  }

  #zoomBy(factor: number): void {
    const { target } = this.#controls;
    const away = this.camera.position.clone().sub(target).multiplyScalar(factor);
    away.clampLength(this.#controls.minDistance, this.#controls.maxDistance);
    this.view = { position: away.add(target).toArray(), target: target.toArray() };
  }
}

/** Return a direction, at least steep enough to look into a room over its walls. */
function steep(direction: Vector3): Vector3 {
  const flat = Math.hypot(direction.x, direction.y);
  return direction.setZ(Math.max(direction.z, flat * Math.tan(STEEP))).normalize();
}

/** Return how far a box of these half sides has to be for all of its corners to be in the picture. */
function fitted(half: Vector3, direction: Vector3, slope: number, aspect: number): number {
  const right = new Vector3(-direction.y, direction.x, 0).normalize();
  if (right.lengthSq() === 0) right.set(1, 0, 0);
  const up = direction.clone().cross(right);
  let distance = 0;
  for (let bits = 0; bits < 8; bits++) {
    const corner = new Vector3(bits & 1 ? half.x : -half.x, bits & 2 ? half.y : -half.y, bits & 4 ? half.z : -half.z);
    const wide = Math.abs(corner.dot(right)) / (slope * aspect);
    const tall = Math.abs(corner.dot(up)) / slope;
    distance = Math.max(distance, Math.max(wide, tall) + corner.dot(direction));
  }
  return distance;
}
