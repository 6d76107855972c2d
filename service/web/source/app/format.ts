/** Numbers, times and sizes as people read them. */

const MINUTE = 60_000;
const HOUR = 60 * MINUTE;
const DAY = 24 * HOUR;

/** Write a length with two digits behind a metre's point, in centimetres or millimetres where it is short. */
export function metres(length: number): string {
  const size = Math.abs(length);
  if (size >= 0.995) return `${length.toFixed(size < 10 ? 1 : 0)} m`;
  return size >= 0.095 ? `${(length * 100).toFixed(0)} cm` : `${(length * 100).toFixed(1)} cm`;
}

/** Write a height in the map's frame, which may lie below its origin. */
export function height(z: number): string {
  return `${z.toFixed(2).replace("-", "−")} m`;
}

/** Write the heights of a section: `0 to 1.03 m`. */
export function heights([low, high]: readonly [number, number]): string {
  const plain = (z: number) => String(Math.round(z * 100) / 100).replace("-", "−");
  return `${plain(low)} to ${plain(high)} m`;
}

/** Name a device beside other words, so that `robot-7` is known for one. */
export function deviceWords(id: string): string {
  return `device ${id}`;
}

/** Write a share or a probability; what is nearly sure does not read as sure, nor what is nearly nothing as nothing. */
export function percent(share: number | null | undefined): string {
  if (share == null) return "not told";
  if (share > 0.99 && share < 1) return ">99 %";
  if (share > 0 && share < 0.01) return "<1 %";
  return `${Math.round(share * 100)} %`;
}

/** Write a count with its noun. */
export function count(number: number, noun: string, nouns = `${noun}s`): string {
  return `${whole(number)} ${number === 1 ? noun : nouns}`;
}

/** Write a whole number with thin spaces between thousands. */
export function whole(number: number): string {
  return String(number).replace(/\B(?=(\d{3})+$)/g, " ");
}

/** Write a size of a file. */
export function bytes(size: number): string {
  if (size < 1000) return `${size} B`;
  const power = Math.min(3, Math.floor(Math.log10(size) / 3));
  const value = size / 1000 ** power;
  return `${value.toFixed(value < 10 ? 1 : 0)} ${["", "kB", "MB", "GB"][power]}`;
}

/** Write an instant in local time, with the year where it is not this one. */
export function instant(text: string, now = new Date(), zone?: string): string {
  const at = new Date(text);
  const year = at.getFullYear() === now.getFullYear() ? undefined : "numeric";
  return at.toLocaleString("en-GB", {
    weekday: "short",
    day: "numeric",
    month: "short",
    year,
    hour: "2-digit",
    minute: "2-digit",
    timeZone: zone,
  });
}

/** Write how long ago an instant was, roughly. */
export function ago(text: string, now = new Date()): string {
  const past = now.getTime() - new Date(text).getTime();
  if (past < MINUTE) return past < -MINUTE ? "in the future" : "just now";
  if (past < HOUR) return `${Math.floor(past / MINUTE)} min ago`;
  if (past < DAY) return `${Math.floor(past / HOUR)} h ago`;
  return past < 2 * DAY ? "a day ago" : `${Math.floor(past / DAY)} days ago`;
}

/** Write the sides of a map: `10 × 8 m, 2.7 m high`. */
export function extent(bounds: { min: number[]; max: number[] } | null): string {
  if (!bounds) return "";
  const [x, y, z] = [0, 1, 2].map((axis) => bounds.max[axis]! - bounds.min[axis]!) as [
    number,
    number,
    number,
  ];
  return `${x.toFixed(x < 10 ? 1 : 0)} × ${y.toFixed(y < 10 ? 1 : 0)} m, ${z.toFixed(1)} m high`;
}

/** Write an ordinal: `1st`, `2nd`, `11th`. */
export function ordinal(number: number): string {
  const teens = number % 100 >= 11 && number % 100 <= 13;
  return `${number}${teens ? "th" : (["th", "st", "nd", "rd"][number % 10] ?? "th")}`;
}
