/** Small parts that every view uses. */

import { createContext, Fragment, h, type ComponentChildren } from "preact";

import type { Controller } from "../controller.ts";
import type { ProblemDocument, ScanWarning } from "../documents.ts";
import { percent } from "../format.ts";
import { adviceOn, plainOf, withNames } from "../problems.ts";
import { capital, REASONS } from "../words.ts";

/** Names of files by the ids of their scans, for the service's sentences, which have the ids. */
export const Names = createContext<Readonly<Record<string, string>>>({});

/** Show an error in plain words, or in the service's where those are plain, and what to do about it. */
export function Problem({ problem, again }: { problem: ProblemDocument; again?: () => void }) {
  const advice = adviceOn(problem);
  const plain = plainOf(problem);
  const [title, ...more] = plain ?? [problem.title];
  const detail = <Names.Consumer>{(names) => withNames(problem.detail, names)}</Names.Consumer>;
  return (
    <div class="problem" role="alert">
      <strong>{title}</strong>
      {more.map((line) => (
        <p>{line}</p>
      ))}
      {!plain && <p>{detail}</p>}
      {problem.errors?.map(({ place, detail }) => (
        <p>
          <code>{place}</code>: {detail}
        </p>
      ))}
      {advice && <p class="advice">{advice}</p>}
      {plain && <Folded>{detail}</Folded>}
      {problem.instance && (
        <p>
          Named in the service's log: <code>{problem.instance}</code>
        </p>
      )}
      {again && <button onClick={again}>Try again</button>}
    </div>
  );
}

/** What experts ask for, folded under its summary. */
export function Folded({ summary, children }: { summary?: string; children: ComponentChildren }) {
  return (
    <details class="folded">
      <summary>{summary ?? "Details"}</summary>
      <div>{children}</div>
    </details>
  );
}

/** What the columns of a table mean, opened by a click, tap or key: each with its word. */
export function Meanings({ of }: { of: readonly (readonly [string, string])[] }) {
  return (
    <Folded summary="What the columns mean">
      <dl class="meanings">
        {of.map(([word, meaning]) => (
          <>
            <dt>{word}</dt>
            <dd>{meaning}</dd>
          </>
        ))}
      </dl>
    </Folded>
  );
}

/** Show what is odd about a scan or a survey. */
export function Warnings({ warnings }: { warnings: readonly ScanWarning[] }) {
  return (
    <>
      {warnings.map(({ reason, detail }) => (
        <div class="warning">
          <strong>{capital(REASONS[reason]?.[0] ?? reason)}.</strong>
          {REASONS[reason]?.[1] && <p class="advice">{capital(REASONS[reason][1])}.</p>}
          <Folded>{detail}</Folded>
        </div>
      ))}
    </>
  );
}

/** Show a share as a bar with its number. */
export function Share({ value, label }: { value: number | null; label: string }) {
  if (value === null) return <span class="faint">not told</span>;
  return (
    <span class="share">
      <meter min={0} max={1} value={value} aria-label={label} />
      {percent(value)}
    </span>
  );
}

/** Show a name with its value; nothing where there is no value. What the name means opens by a click, tap or key. */
export function Fact({ name, children, hint }: { name: string; children: ComponentChildren; hint?: string }) {
  if (children === null || children === undefined || children === "") return null;
  return (
    <>
      <dt title={hint}>
        {hint ? (
          <details>
            <summary>{name}</summary>
            <span>{hint}</span>
          </details>
        ) : (
          name
        )}
      </dt>
      <dd>{children}</dd>
    </>
  );
}

/** Show a dot in the colour of a kind, with a sign for who does not see colours. */
export function Kind({ kind }: { kind: string }) {
  return <span class={`kind kind-${kind}`} aria-hidden="true" />;
}

interface DownloadProps {
  app: Controller;
  path: string;
  name: string; // of the file
  children: ComponentChildren;
}

/** A link to a file; where a key is needed, which a plain link cannot bring, the page fetches the file. */
export function Download({ app, path, name, children }: DownloadProps) {
  const fetched = (event: Event) => {
    event.preventDefault();
    void app.attempt(async () => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(await (await app.api.fetch(path)).blob());
      link.download = name;
      link.click();
      URL.revokeObjectURL(link.href);
    });
  };
  return (
    <a href={path} download={name} onClick={(event) => app.state.hasKey && fetched(event)}>
      {children}
    </a>
  );
}

/** A place of the same size that says what is waited for. */
export function Waiting({ children }: { children: ComponentChildren }) {
  return (
    <p class="waiting" role="status">
      {children}
    </p>
  );
}

/** What is there where a list is empty: why, and what to do. */
export function Empty({ title, children }: { title: string; children?: ComponentChildren }) {
  return (
    <div class="empty">
      <strong>{title}</strong>
      {children}
    </div>
  );
}
