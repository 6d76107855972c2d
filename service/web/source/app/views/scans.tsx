/** What became of each scan of a map or a survey: how well it was registered, or why it was left out. */

import { Fragment, h } from "preact";

import type { ScanOutcome } from "../documents.ts";
import { count, metres, percent } from "../format.ts";
import { capital, REASONS } from "../words.ts";
import { Folded, Warnings } from "./parts.tsx";

const ASKING = "…"; // in place of a file's name until it is known

interface ScansProps {
  scans: readonly ScanOutcome[];
  names: Record<string, string>;
  placing?: boolean; // they are being registered
}

export function Scans({ scans, names, placing }: ScansProps) {
  const refused = scans.filter(({ accepted }) => accepted === false);
  const accepted = scans.filter((scan) => scan.accepted);
  const sure = accepted.some(({ confidence }) => confidence !== null); // it is not asked of the scans of a map
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
              <th title="share of its points that lie on the map">Fitness</th>
              <th title="root mean square distance of those points">RMSE</th>
              {sure && <th title="that it stands where it was taken">Sure</th>}
              <th title="where it stands, one sigma in the direction that is held worst">±</th>
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
