/** What became of each scan of a map or a survey: how well it was registered, or why it was left out. */

import { Fragment, h } from "preact";

import type { ScanOutcome } from "../documents.ts";
import { count, metres, percent } from "../format.ts";
import { capital, REASONS } from "../words.ts";
import { Folded, Meanings, Warnings } from "./parts.tsx";

const ASKING = "…"; // in place of a file's name until it is known

const COLUMNS: readonly (readonly [string, string])[] = [
  ["Fitness", "share of its points that lie on the map"],
  ["RMSE", "root mean square distance of those points"],
  ["Sure", "how sure it is that it stands where it was taken"],
  ["±", "where it stands, one sigma in the direction that is held worst"],
];

interface ScansProps {
  scans: readonly ScanOutcome[];
  names: Record<string, string>;
  placing?: boolean; // they are being registered
}

export function Scans({ scans, names, placing }: ScansProps) {
  const refused = scans.filter(({ accepted }) => accepted === false);
  const accepted = scans.filter((scan) => scan.accepted);
  const sure = accepted.some(({ confidence }) => confidence !== null); // it is not asked of the scans of a map
  const columns = COLUMNS.filter(([word]) => sure || word !== "Sure");
  const waiting = scans.length - refused.length - accepted.length;
  return (
    <section>
      <h3>Registration</h3>
      <p>
        {accepted.length} of {count(scans.length, "scan")} registered
        {refused.length > 0 && `, ${refused.length} left out`}
        {waiting > 0 && `, ${waiting} ${placing ? "wait" : "not tried"}`}.
      </p>
      {refused.map((scan) => (
        <Refused key={scan.scan_id} scan={scan} name={names[scan.scan_id] ?? ASKING} />
      ))}
      {accepted.length > 0 && (
        <table class="scans">
          <thead>
            <tr>
              <th>Scan</th>
              {columns.map(([word, meaning]) => (
                <th title={meaning}>{word}</th>
              ))}
            </tr>
          </thead>
          <tbody>
            {accepted.map((scan) => (
              <Accepted
                key={scan.scan_id}
                scan={scan}
                sure={sure}
                name={names[scan.scan_id] ?? ASKING}
              />
            ))}
          </tbody>
        </table>
      )}
      {accepted.length > 0 && <Meanings of={columns} />}
    </section>
  );
}

function Accepted({ scan, name, sure }: { scan: ScanOutcome; name: string; sure: boolean }) {
  return (
    <>
      <tr>
        <td class="name" title={scan.scan_id}>
          {name}
        </td>
        <td>{scan.fitness === null ? "" : percent(scan.fitness)}</td>
        <td>{scan.rmse === null ? "" : metres(scan.rmse)}</td>
        {sure && <td>{scan.confidence === null ? "not asked" : percent(scan.confidence)}</td>}
        <td>{scan.translation_sigma === null ? "" : metres(scan.translation_sigma)}</td>
      </tr>
      {scan.warnings.length > 0 && (
        <tr>
          <td colSpan={5}>
            <Warnings warnings={scan.warnings} />
          </td>
        </tr>
      )}
    </>
  );
}

function Refused({ scan, name }: { scan: ScanOutcome; name: string }) {
  const [what, advice] = REASONS[scan.reason ?? ""] ?? [scan.reason ?? "left out", ""];
  const numbers = [
    scan.fitness !== null && `fitness ${percent(scan.fitness)}`,
    scan.rmse !== null && `inlier RMSE ${metres(scan.rmse)}`,
    scan.confidence !== null && `confidence ${percent(scan.confidence)}`,
  ].filter(Boolean);
  return (
    <div class="refused">
      <strong title={scan.scan_id}>
        {name}: {what}
      </strong>
      {advice && <p class="advice">{capital(advice)}.</p>}
      {(scan.detail || numbers.length > 0) && (
        <Folded>
          {scan.detail && <p>{scan.detail}</p>}
          {numbers.length > 0 && <p class="faint">{capital(numbers.join(", "))}</p>}
        </Folded>
      )}
      <Warnings warnings={scan.warnings} />
    </div>
  );
}
