/** How much is drawn while the camera moves: as much as the machine draws smoothly. */

const SMOOTH_MS = 40; // of a frame, aimed at
const SLOW_MS = 100; // of a frame: leaving points out is not enough
const LEAST = 0.02; // of the points
const FEW = 0.25; // of the points: with fewer the picture has fewer pixels too
const BLURRED = 0.5;

/** Follows how long frames take; what it has found holds for the next move as well. */
export class Pace {
  #share = 1;
  #sharpness = 1;

  /** Part of the points to draw, 0..1. */
  get share(): number {
    return this.#share;
  }

  /** Pixels a side of the picture, for one that it has at rest; within a move it falls and never rises, which would flicker. */
  get sharpness(): number {
    return this.#sharpness;
  }

  /** Take note that the camera begins to move. */
  begins(): void {
    this.#sharpness = this.#share < FEW ? BLURRED : 1;
  }

  /** Take note how long a frame took while the camera moved, milliseconds: draw less where it was long, more where it was short. */
  took(ms: number): void {
    if (ms > 1.4 * SMOOTH_MS) this.#share = Math.max(this.#share * Math.max(Math.min(SMOOTH_MS / ms, 0.7), 0.2), LEAST);
    else if (ms < 0.6 * SMOOTH_MS) this.#share = Math.min(this.#share * 1.15, 1);
    if (ms > SLOW_MS || this.#share < FEW) this.#sharpness = BLURRED;
  }
}
