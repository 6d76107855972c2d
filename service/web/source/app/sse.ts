/** Server-Sent Events as a stream of text (HTML Living Standard, Section 9.2.6), read without EventSource. */

export interface Message {
  id: string; // the last that was told, also by a message before
  data: string; // empty where only the id moved on
}

/** Reads chunks as they come; a chunk may end anywhere. */
export class SseParser {
  #rest = "";
  #id = "";
  #data: string[] = [];

  /** Return the messages that are complete now. One that moves the id alone has no data. */
  feed(chunk: string): Message[] {
    const messages: Message[] = [];
    const text = this.#rest + chunk;
    const end = text.endsWith("\r") ? text.length - 1 : text.length; // an LF may follow in the next chunk
    const lines = text.slice(0, end).split(/\r\n|\n|\r/);
    this.#rest = (lines.pop() ?? "") + text.slice(end);
    for (const line of lines) {
      if (line) this.#take(line);
      else messages.push(this.#flush());
    }
    return messages;
  }

  #take(line: string): void {
    const colon = line.indexOf(":");
    if (colon === 0) return; // a comment
    const name = colon < 0 ? line : line.slice(0, colon);
    const value = colon < 0 ? "" : line.slice(colon + 1).replace(/^ /, "");
    if (name === "data") this.#data.push(value);
    if (name === "id" && !value.includes("\0")) this.#id = value;
  }

  #flush(): Message {
    const message = { id: this.#id, data: this.#data.join("\n") };
    this.#data = [];
    return message;
  }
}
