"""The benches against figures of an earlier day: what became slower, larger or less accurate.

    python tools/bench/baseline.py [--data ../shared/data] [--only refraction,sparse] [--ceres FOLDER] [--write]

Runs the benches, each in a process of its own with `--json FILE`, and prints for every figure its value, that of
baseline.json, their ratio and a verdict; ends with status 1 where one is worse than its tolerance. `--write` puts the
values measured into baseline.json instead: a tolerance that stands there stays. Times mean something on an idle machine
alone; figures that are ratios to a peer, measured at the same time, are worth more than seconds.
"""

import argparse
import json
import math
import platform
import subprocess
import sys
import tempfile
from datetime import date
from pathlib import Path
from typing import Any, Literal

HERE = Path(__file__).resolve().parent
BASELINE = HERE / "baseline.json"

_target: list[Path] = []


def bench_parser(description: str) -> argparse.ArgumentParser:
    """A parser of arguments with `--json FILE`, where `figure` writes to."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--json", type=lambda name: _target.append(Path(name)), help="file to append figures to")
    return parser


def figure(name: str, value: float, unit: str, better: Literal["lower", "higher"], tolerance: float = 0.05) -> None:
    """Append a figure, one JSON object a line, to the file given as `--json`; what is not finite was not measured.

    tolerance: by what share it may become worse, where baseline.json does not know the figure yet.
    """
    if _target and math.isfinite(value):
        content = {"name": name, "value": float(value), "unit": unit, "better": better, "tolerance": tolerance}
        line = json.dumps(content)
        with _target[-1].open("a", encoding="utf-8") as file:
            file.write(line + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description="Runs the benches and compares their figures with baseline.json.")
    parser.add_argument("--data", type=Path, default=HERE.parents[2] / "shared" / "data", help="folder of data sets")
    parser.add_argument("--ceres", type=Path, help="folder of the Ceres program; see bundle.py")
    parser.add_argument("--only", default="", help="names of benches, by commas; by default all")
    parser.add_argument("--write", action="store_true", help="put the values into baseline.json")
    options = parser.parse_args()
    known = json.loads(BASELINE.read_text(encoding="utf-8"))["figures"] if BASELINE.exists() else {}
    found = _measure(_benches(options.data, options.ceres), [name for name in options.only.split(",") if name])
    if options.write:
        _write(known, found)
    elif _compare(known, found):
        sys.exit(1)


def _benches(data: Path, ceres: Path | None) -> dict[str, list[str]]:
    """The arguments of each bench; those whose data are not there are left out."""
    tank, photographs = data / "tank", data / "two_view_photos"
    with_tank = [str(tank)] if tank.is_dir() else []
    benches = {
        "refraction": [],
        "solvers": ["--problems", "100"],
        "sparse": with_tank,
        "dense": with_tank,
        "uncertainty": [],
        "rendering": [],
        "correct": [],
        "tracks": [],
        "matching": [],
        "many": [],
        "fusing": ["--side", "4", "--width", "800"],
        "pairs": [],
        "verification": [],
        "scale": ["--views", "50,100"],
    }
    if photographs.is_dir():
        benches["photographs"] = [str(photographs)]
    if (data / "shore_flight").is_dir():
        benches["features"] = [str(data / "shore_flight" / "images")]
    if ceres is not None:
        benches["bundle"] = ["--ceres", str(ceres)]
    return benches


def _measure(benches: dict[str, list[str]], only: list[str]) -> dict[str, dict[str, Any]]:
    """Run the benches; their figures by name, that of the bench in front."""
    unknown = set(only) - set(benches)
    if unknown:
        sys.exit(f"--only names {', '.join(sorted(unknown))}, but can name {', '.join(benches)}")
    found = {}
    for bench in only or benches:
        print(f"\n== {bench} ==", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "figures.json"
            file.touch()
            command = [sys.executable, HERE / f"{bench}.py", *benches[bench], "--json", file]
            subprocess.run(command, check=True)
            for line in file.read_text(encoding="utf-8").splitlines():
                entry = json.loads(line)
                found[f"{bench}: {entry.pop('name')}"] = entry
    return found


def _write(known: dict[str, dict[str, Any]], found: dict[str, dict[str, Any]]) -> None:
    """Values that were not measured this time stay as they are."""
    today, machine = date.today().isoformat(), f"{platform.machine()}, {platform.python_version()}"
    for name, entry in found.items():
        rounded, tolerance = float(f"{entry['value']:.4g}"), known.get(name, entry)["tolerance"]
        known[name] = entry | {"value": rounded, "tolerance": tolerance, "measured": today}
    lines = [f"    {json.dumps(name)}: {json.dumps(entry)}" for name, entry in known.items()]
    text = f'{{\n  "machine": {json.dumps(machine)},\n  "figures": {{\n' + ",\n".join(lines) + "\n  }\n}\n"
    BASELINE.write_text(text, encoding="utf-8")
    print(f"\n{len(found)} figures of {len(known)} are written to {BASELINE}")


def _compare(known: dict[str, dict[str, Any]], found: dict[str, dict[str, Any]]) -> bool:
    """Print the table; whether anything is worse than its tolerance."""
    print(f"\n{'figure':<64} {'now':>10} {'baseline':>10} {'unit':<12} {'ratio':>6}  verdict")
    verdicts = []
    for name in {**known, **found}:
        entry, before = found.get(name), known.get(name)
        now = f"{entry['value']:.4g}" if entry else ""
        then = f"{before['value']:.4g}" if before else ""
        ratio, verdict = ("", "not measured" if before else "new") if not (entry and before) else _judged(entry, before)
        verdicts.append(verdict)
        print(f"{name:<64} {now:>10} {then:>10} {(entry or before or {})['unit']:<12} {ratio:>6}  {verdict}")
    worse = verdicts.count("WORSE")
    print(f"{worse} of {len(found)} figures are worse than their tolerance allows")
    return worse > 0


def _judged(entry: dict[str, Any], before: dict[str, Any]) -> tuple[str, str]:
    """Ratio to the baseline, and what it means."""
    now, then, tolerance = entry["value"], before["value"], before["tolerance"]
    ratio = now / then if then else math.inf if now else 1.0
    loss = ratio - 1.0 if before["better"] == "lower" else 1.0 - ratio
    return f"{ratio:.3f}", "WORSE" if loss > tolerance else "better" if loss < -tolerance else "same"


if __name__ == "__main__":
    main()
