/** Files that are dropped anywhere on the page. */

import type { Controller } from "./controller.ts";
import { addFiles } from "./submit.ts";

/** Take files that are dropped, and show while they are over the page that it takes them. */
export function listenForDrops(app: Controller): void {
  let depth = 0; // of elements that the files entered and did not leave
  const over = (by: number) => {
    depth = Math.max(0, depth + by);
    document.documentElement.classList.toggle("dropping", depth > 0);
  };
  addEventListener("dragenter", (event) => hasFiles(event) && over(1));
  addEventListener("dragleave", (event) => hasFiles(event) && over(-1));
  addEventListener("dragover", (event) => hasFiles(event) && event.preventDefault());
  addEventListener("drop", (event) => {
    if (!hasFiles(event)) return;
    event.preventDefault();
    over(-depth);
    void addFiles(app, [...(event.dataTransfer?.files ?? [])]);
  });
}

function hasFiles({ dataTransfer }: DragEvent): boolean {
  return dataTransfer?.types.includes("Files") ?? false;
}
