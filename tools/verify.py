"""Runs the long statistical tests (marker `verify`), goes on where it stopped, and writes a dated result.

What passed is remembered per state of the sources in `build/verify/`: an interrupted run loses one test at most. When
all have run, the result goes to `docs/evidence/DATE-verify.md`, with the figures that the tests recorded
(`record_property`).

    python tools/verify.py [pytest arguments]
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("src", "tests", "constraints", "pyproject.toml")
REPORTED = ("numpy", "numba", "scipy", "opencv-python-headless", "pytest")


def source_state() -> str:
    """Hash of the sources as they lie on the disk, committed or not."""
    (ROOT / "build").mkdir(exist_ok=True)
    index = ROOT / "build" / "verify-index"
    index.unlink(missing_ok=True)
    env = {**os.environ, "GIT_INDEX_FILE": str(index)}
    subprocess.run(["git", "add", "--", *SOURCES], cwd=ROOT, env=env, check=True)
    tree = subprocess.run(["git", "write-tree"], cwd=ROOT, env=env, check=True, capture_output=True, text=True)
    return tree.stdout.strip()


class Progress:
    """A pytest plugin: leaves out what has passed already and notes every outcome at once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.results: dict[str, dict[str, Any]] = json.loads(path.read_text()) if path.exists() else {}

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Deselects the tests that have passed on these sources."""
        done = {name for name, r in self.results.items() if r["outcome"] == "passed"}
        left = [item for item in items if item.nodeid not in done]
        config.hook.pytest_deselected(items=[item for item in items if item.nodeid in done])
        items[:] = left

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Writes one outcome down, so that nothing is lost if the run ends here."""
        if report.when != "call" and report.passed:
            return
        outcome = "error" if report.when != "call" and report.failed else report.outcome
        self.results[report.nodeid] = {
            "outcome": outcome,
            "seconds": round(report.duration, 1),
            "figures": {str(k): str(v) for k, v in report.user_properties},
        }
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(self.results, indent=1))


def write_evidence(results: dict[str, dict[str, Any]], state: str) -> Path:
    """The dated page with one line per test."""
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    counts = {o: sum(r["outcome"] == o for r in results.values()) for o in ("passed", "failed", "error", "skipped")}
    lines = [
        f"# Long tests, {today}",
        "",
        f"Sources `{state[:12]}` · {platform.system()} {platform.machine()}, {os.cpu_count()} cores · "
        f"Python {platform.python_version()} · " + ", ".join(f"{p} {version(p)}" for p in REPORTED),
        "",
        ", ".join(f"{n} {o}" for o, n in counts.items() if n) + ".",
        "",
        "| test | outcome | seconds | figures |",
        "|---|---|---|---|",
    ]
    for name, r in sorted(results.items()):
        figures = ", ".join(f"{k} = {v}" for k, v in r["figures"].items())
        lines.append(f"| `{name.removeprefix('tests/')}` | {r['outcome']} | {r['seconds']} | {figures} |")
    path = ROOT / "docs" / "evidence" / f"{today}-verify.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")
    return path


def main(arguments: list[str]) -> int:
    """Runs what is left and returns pytest's status."""
    os.chdir(ROOT)
    state = source_state()
    progress = Progress(ROOT / "build" / "verify" / f"{state[:12]}.json")
    before = len(progress.results)
    if before:
        print(f"{before} long tests have run already on these sources")
    status = int(pytest.main(["-m", "verify", "--timeout", "3600", *arguments], plugins=[progress]))
    if status == pytest.ExitCode.NO_TESTS_COLLECTED and before:
        status = 0
    if progress.results and status in (0, 1):
        print(write_evidence(progress.results, state).relative_to(ROOT))
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
