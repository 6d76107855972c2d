"""Says which pinned packages have known weaknesses (`make check`); fails for those alone, never for want of a network.

The source is the index's own list, asked by pip-audit for each pin of docker/constraints.txt.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

PINS = Path(__file__).resolve().parents[1] / "docker" / "constraints.txt"
LONGEST_S = 20.0
COMMAND = [
    *(sys.executable, "-m", "pip_audit", "--requirement", str(PINS), "--no-deps", "--disable-pip"),
    *("--timeout", "5", "--progress-spinner", "off", "--format", "json"),
]


def main() -> int:
    """Print one line, or one for each weakness; the exit status is 1 where there is one."""
    try:
        run = subprocess.run(COMMAND, capture_output=True, text=True, timeout=LONGEST_S, check=False)
        packages = json.loads(run.stdout)["dependencies"]
    except subprocess.TimeoutExpired:
        return _skipped(f"no answer within {LONGEST_S:.0f} s")
    except (ValueError, KeyError, OSError):
        return _skipped("its source cannot be reached")
    audited = [package for package in packages if "vulns" in package]
    if not audited:
        return _skipped("its source knows none of the packages")
    weak = [(package, one) for package in audited for one in package["vulns"]]
    for package, one in weak:
        mended = ", ".join(one.get("fix_versions", ())) or "no release yet"
        print(f"{package['name']} {package['version']}: {one['id']}, mended in {mended}")
    if not weak:
        print(f"audit: no known weakness in {len(audited)} of {len(packages)} packages")
    return 1 if weak else 0


def _skipped(why: str) -> int:
    print(f"audit skipped: {why}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
