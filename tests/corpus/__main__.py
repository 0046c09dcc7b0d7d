"""Fit the corpus, and compare two runs of it.

``python -m tests.corpus fit TABLE [--quick] [--only TEXT]``: fit each rig with ``fit-params``, two at a time, and write
TABLE, a JSON file. A rig that stands in TABLE already is not fitted again. ``python -m tests.corpus compare BEFORE
AFTER`` prints what differs, one line each, and ends with 1 if there is a line.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from statistics import median
from typing import Any

from tests.corpus.rigs import QUICK, RIGS

#: A fit is given up after this time, s.
LONGEST = 900.0
#: A value may move by this share of its sd, or by so many of its Monte Carlo standard errors; an sd by this share.
SHARE, ERRORS, SD_SHARE = 0.1, 4.0, 0.1
#: A rig that takes longer than this ratio is named, and the median of the ratios may not be above the other number.
SLOWER, MEDIAN_SLOWER = 1.5, 1.2
#: What is kept of a parameter.
KEPT = ("value", "sd", "trust", "ess")


def fit_rig(name: str) -> dict[str, Any]:
    """Fit one rig: exit status, time and CPU time in s, values, sds, trust, codes of the findings."""
    with tempfile.TemporaryDirectory() as folder:
        place, out = Path(folder) / "rig", Path(folder) / "out"
        try:
            RIGS[name](place)
        except FileNotFoundError:
            return {"absent": True}
        program = str(Path(sys.executable).parent / "fit-params")
        env = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(Path.cwd())}
        words = [program, str(place), "--out", str(out), "--quiet"]
        start = time.monotonic()
        try:
            done = subprocess.run(
                words, env=env, cwd=folder, capture_output=True, text=True, timeout=LONGEST, check=False
            )
        except subprocess.TimeoutExpired:
            return {"status": 124, "time": LONGEST}
        found: dict[str, Any] = {"status": done.returncode, "time": round(time.monotonic() - start, 1)}
        if "internal failure" in done.stderr or "Traceback" in done.stderr:
            found["failure"] = done.stderr[-400:]
        if not (out / "parameters.json").exists():
            return found
        result = json.loads((out / "parameters.json").read_text(encoding="utf-8"))
    findings = result["verdict"]["findings"]
    found["parameters"] = {
        symbol: {key: own[key] if isinstance(own[key], str | None) else float(f"{own[key]:.6g}") for key in KEPT}
        for symbol, own in result["parameters"].items()
    }
    found["findings"] = sorted({one["code"] for one in findings if one["level"] != "ok"})
    return found


def fit_all(table: Path, names: list[str]) -> None:
    """Fit the rigs that ``table`` lacks, and write it after each one."""
    known = json.loads(table.read_text(encoding="utf-8")) if table.exists() else {}
    missing = [name for name in names if name not in known]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        running = {pool.submit(fit_rig, name): name for name in missing}
        for done in as_completed(running):
            name, found = running[done], done.result()
            print(name, found.get("status"), found.get("time"), flush=True)
            if "absent" not in found:
                known[name] = found
                lines = [f"{json.dumps(rig)}: {json.dumps(known[rig])}" for rig in sorted(known)]
                table.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(f"CPU time {used.ru_utime + used.ru_stime:.0f} s")


def compared(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """What differs between two tables, one line each; of the rigs that both hold."""
    lines = []
    both = sorted(before.keys() & after.keys())
    for name in both:
        lines += [f"{name}: {line}" for line in _of_rig(before[name], after[name])]
    ratios = {name: after[name]["time"] / before[name]["time"] for name in both}
    lines += [f"{name}: takes {ratio:.2f} times as long" for name, ratio in ratios.items() if ratio > SLOWER]
    if ratios and median(ratios.values()) > MEDIAN_SLOWER:
        lines.append(f"the median of the times is {median(ratios.values()):.2f} times as long")
    return lines


def _of_rig(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    lines = [f"{key} {before.get(key)} -> {after.get(key)}" for key in ("status",) if before.get(key) != after.get(key)]
    if "failure" in after and "failure" not in before:
        lines.append(f"internal failure: {after['failure']}")
    old, new = before.get("parameters", {}), after.get("parameters", {})
    lines += [f"{symbol} is gone" for symbol in old if symbol not in new]
    lines += [f"{symbol} is new" for symbol in new if symbol not in old]
    for symbol in (symbol for symbol in old if symbol in new):
        lines += [f"{symbol}: {line}" for line in _of_parameter(old[symbol], new[symbol])]
    gone = sorted(set(before.get("findings", [])) - set(after.get("findings", [])))
    come = sorted(set(after.get("findings", [])) - set(before.get("findings", [])))
    return lines + [f"finding {code} is gone" for code in gone] + [f"finding {code} is new" for code in come]


def _of_parameter(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    lines = [f"trust {old['trust']} -> {new['trust']}"] if old["trust"] != new["trust"] else []
    if old["sd"] is None or new["sd"] is None or old["value"] is None or new["value"] is None:
        return lines + ([f"{old['value']} -> {new['value']}"] if old["value"] != new["value"] else [])
    sizes = [max(each["ess"] or 1e9, 1.0) for each in (old, new)]
    noise = sum(each["sd"] ** 2 / size for each, size in zip((old, new), sizes, strict=True)) ** 0.5
    if abs(new["value"] - old["value"]) > max(SHARE * old["sd"], ERRORS * noise):
        lines.append(f"value {old['value']:.6g} -> {new['value']:.6g} (sd {old['sd']:.2g})")
    relative = sum(0.5 / size for size in sizes) ** 0.5
    if abs(new["sd"] - old["sd"]) > max(SD_SHARE, ERRORS * relative) * old["sd"]:
        lines.append(f"sd {old['sd']:.3g} -> {new['sd']:.3g}")
    return lines


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.corpus")
    commands = parser.add_subparsers(dest="command", required=True)
    fit = commands.add_parser("fit")
    fit.add_argument("table", type=Path)
    fit.add_argument("--quick", action="store_true")
    fit.add_argument("--only", default="")
    compare = commands.add_parser("compare")
    compare.add_argument("before", type=Path)
    compare.add_argument("after", type=Path)
    args = parser.parse_args()
    if args.command == "fit":
        fit_all(args.table, [name for name in (QUICK if args.quick else RIGS) if args.only in name])
        return 0
    lines = compared(*(json.loads(path.read_text(encoding="utf-8")) for path in (args.before, args.after)))
    print("\n".join(lines) or "no difference")
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
