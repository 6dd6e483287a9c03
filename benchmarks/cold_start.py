"""A cold start: how long a command takes from nothing, over the import of Numba alone, all in one run.

    python benchmarks/cold_start.py [--rounds 5] [--json]

It simulates three views of 684 x 456 pixels, scans them once so that all kernels are compiled, then takes turns. Ratios
come first, of times by the clock and of processor time; medians.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

try:
    import resource
except ImportError:  # not a POSIX system: no processor time
    resource = None  # type: ignore[assignment]

COMMAND = [sys.executable, "-m", "fringescope"]


def processor_s() -> float:
    if resource is None:
        return 0.0
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def timed(command: list[str]) -> tuple[float, float]:
    before, start = processor_s(), time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - start, processor_s() - before


def measured(rounds: int, folder: Path) -> dict[str, dict[str, float]]:
    capture = folder / "capture"
    simulate = ["simulate", "tissue-domed", "--scale", "0.125", "--out", str(capture)]
    subprocess.run([*COMMAND, *simulate], check=True, capture_output=True)
    scan = ["reconstruct", str(capture), "--rig", str(capture / "truth" / "rig.json"), "--out"]
    subprocess.run([*COMMAND, *scan, str(folder / "first")], check=True, capture_output=True)
    times: dict[str, list[tuple[float, float]]] = {}
    for n in range(rounds):
        lines = {
            "import numba": [sys.executable, "-c", "import numba"],
            "--help": [*COMMAND, "--help"],
            "settings": [*COMMAND, "settings"],
            "reconstruct": [*COMMAND, *scan, str(folder / f"scan{n}")],
        }
        for name, line in lines.items():
            times.setdefault(name, []).append(timed(line))
    medians = {name: [statistics.median(one) for one in zip(*all_, strict=True)] for name, all_ in times.items()}
    base = medians["import numba"]
    out = {}
    for name, (clock, processor) in medians.items():
        ratios = {"over_numba": clock / base[0], "processor_over_numba": processor / base[1] if base[1] else 0.0}
        out[name] = {**ratios, "clock_s": clock, "processor_s": processor}
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = measured(asked.rounds, Path(folder))
    if asked.json:
        print(json.dumps(result))
        return
    print("over `import numba`: clock, processor; seconds: clock, processor")
    for name, r in result.items():
        print(f"{name:14}{r['over_numba']:8.2f}{r['processor_over_numba']:8.2f}"
              f"{r['clock_s']:9.2f}{r['processor_s']:8.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
