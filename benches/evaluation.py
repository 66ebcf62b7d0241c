#!/usr/bin/env python3
"""Measures evaluation: thousands of short motions, with all baselines.

    python benches/evaluation.py --bin target/debug/motiongen --store build/demo/store --model demo

Makes six motions for each phrase that library constructed in the store (in a copy; what a motion looks like
does not change what measuring it costs, so that four steps are enough), and evaluates them.
"""

import argparse
import pathlib
import shutil
import subprocess
import sys

from bench import table
from generation import run
from machine import heading

ROOT = pathlib.Path(__file__).resolve().parent.parent
OUT = ROOT / "build" / "bench-evaluation"
TARGET_S, TARGET_MB = 90, 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="motiongen, with query")
    parser.add_argument("--store", type=pathlib.Path, default=ROOT / "build/demo/store")
    parser.add_argument("--model", default="demo")
    parser.add_argument("--samples", type=int, default=6, help="for each phrase")
    args = parser.parse_args()
    if not (args.store / "models" / args.model).is_dir():
        sys.exit(f"{args.store} has no model {args.model}; run make demo first")
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    store = OUT / "store"
    shutil.copytree(args.store, store)
    fixed = ["--store", store, "--quiet", "--run", "bench"]
    run([args.bin, "generate", *fixed, "--model", args.model, "--tracks", "constructed",
         "--samples", args.samples, "--steps", 4])  # fmt: skip
    rows = []
    runs = [
        ("checks alone", ["--quick"]),
        ("everything, baselines sampled", ["--force"]),
        ("everything, baselines kept", ["--force"]),
        ("everything but sampled baselines", ["--force", "--baseline-windows", "0"]),
    ]
    for name, more in runs:
        wall_s, peak_mb = run([args.bin, "evaluate", *fixed, *more])
        rows.append([name, f"{wall_s:.1f}", f"{peak_mb:.0f}"])
    sql = "select count(*) as n, sum(n_frames) as frames from generations where run = 'bench' and selected"
    answer = subprocess.run(
        [args.bin, "query", "--store", store, sql, "--format", "csv"],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    n, frames = answer.stdout.splitlines()[1].split(",")
    print(heading("evaluation", []))
    print(f"### {n} motions, {frames} frames\n")
    print(table(["what", "s", "peak MB"], rows))
    print(f"\nTarget for 10,000 motions of 120 frames: {TARGET_S} s and {TARGET_MB} MB.")
    shutil.rmtree(OUT)


if __name__ == "__main__":
    main()
