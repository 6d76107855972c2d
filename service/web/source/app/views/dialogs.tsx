/** What lies over the page: keys, the key of the API, a link to copy, a question before something is done. */

import { Fragment, h } from "preact";

import type { Controller } from "../controller.ts";
import { KEYS } from "../keys.ts";
import type { Question } from "../state.ts";
import { capital } from "../words.ts";
import { ThemeButton, type Props } from "./page.tsx";
import { shown } from "./upload.tsx";

export function Dialogs({ app, state }: Props) {
  const { dialog, question } = state;
  const close = () => app.update({ dialog: null });
  return (
    <>
      <dialog
        ref={(element) => shown(element, dialog === "help")}
        onClose={() => dialog === "help" && close()}
        aria-labelledby="help-title"
      >
        {dialog === "help" && <Help app={app} state={state} close={close} />}
      </dialog>
      <dialog
        ref={(element) => shown(element, dialog === "key")}
        onClose={() => dialog === "key" && close()}
        aria-labelledby="key-title"
      >
        {dialog === "key" && <KeyForm app={app} refused={state.asksKey?.detail ?? ""} had={state.hasKey} />}
      </dialog>
      <dialog
        ref={(element) => shown(element, dialog === "share")}
        onClose={() => dialog === "share" && close()}
        aria-labelledby="share-title"
      >
        <form method="dialog">
          <h2 id="share-title">Link to this view</h2>
          <input
            readOnly
            aria-label="Link"
            value={location.href}
            onFocus={({ currentTarget }) => currentTarget.select()}
          />
          <div class="row end">
            <button class="primary">Close</button>
          </div>
        </form>
      </dialog>
      <dialog
        ref={(element) => shown(element, question !== null)}
        onClose={() => app.update({ question: null })}
        aria-labelledby="question-title"
      >
        {question && <Ask app={app} question={question} />}
      </dialog>
    </>
  );
}

function Help({ app, state, close }: Pick<Props, "app" | "state"> & { close: () => void }) {
  return (
    <form method="dialog">
      <h2 id="help-title">Keys</h2>
      <dl class="keys">
        {KEYS.map(([keys, what]) => (
          <>
            <dt>
              {keys.split(" ").map((key) => (
                <kbd>{key}</kbd>
              ))}
            </dt>
            <dd>{what}</dd>
          </>
        ))}
      </dl>
      <p class="faint">
        In the scene: drag to turn, right-drag or two fingers to shift, wheel or pinch to come nearer.{" "}
        <a href="docs">The API</a> has all that is shown here.
      </p>
      <div class="row end">
        <ThemeButton app={app} state={state} always />
        <button class="primary" autofocus onClick={close}>
          Close
        </button>
      </div>
    </form>
  );
}

function KeyForm({ app, refused, had }: { app: Controller; refused: string; had: boolean }) {
  const take = (event: SubmitEvent) => {
    event.preventDefault();
    const key = new FormData(event.currentTarget as HTMLFormElement).get("key") as string;
    if (key.trim()) app.useKey(key.trim());
  };
  return (
    <form onSubmit={take}>
      <h2 id="key-title">This service asks for an API key</h2>
      {had && <p class="warning">{capital(refused)}.</p>}
      <p>
        Whoever runs the service makes one with <code>spicd keys add</code>. It stays in this tab and goes
        when the tab is closed.
      </p>
      <label>
        Key
        <input
          name="key"
          type="password"
          autocomplete="current-password"
          placeholder="spicd_…"
          required
          autofocus
        />
      </label>
      <div class="row end">
        <button class="primary">Use it</button>
      </div>
    </form>
  );
}

function Ask({ app, question }: { app: Controller; question: Question }) {
  const act = () => void app.attempt(question.act);
  return (
    <form method="dialog">
      <h2 id="question-title">{question.title}</h2>
      <p>{question.text}</p>
      <div class="row end">
        <button autofocus>Cancel</button>
        <button class="primary" onClick={act}>
          {question.yes}
        </button>
      </div>
    </form>
  );
}
