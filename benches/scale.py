#!/usr/bin/env python3
"""Measures what planning costs as a store grows: the same commands on N, 2 N, 4 N … songs that nobody has.

    make bench-scale                                              1, 2 and 4 million songs
    make bench-scale BENCH_ARGS='--songs 250000 --doublings 1'
    python benches/scale.py --bin target/debug

The songs are rows of `phrases` and `extractions` with manifests and catalogues (benches/synthetic_store.rs), 4,096 to a
commit; there is no audio behind them. On each store, as whole programs:

  status             what is done, by stage
  extract --dry-run  the plan of all songs, and of one shard of 64
  generate --dry-run the same, by the model that ships
  query              count(*) from phrases

Figures are wall and CPU seconds and peak memory. The last column is the ratio of CPU seconds to those at half the songs; what
grows linearly has 2.
"""

import argparse
import pathlib
import shutil
import sys
import tempfile

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))

from bench import Run, run
from machine import heading

SHARDS = 64
COMMANDS = {
    "`status`": ["status"],
    "`extract --dry-run`": ["extract", "--dry-run"],
    f"`extract --dry-run --shard 3/{SHARDS}`": ["extract", "--dry-run", "--shard", f"3/{SHARDS}"],
    "`generate --dry-run`": ["generate", "--dry-run"],
    f"`generate --dry-run --shard 3/{SHARDS}`": ["generate", "--dry-run", "--shard", f"3/{SHARDS}"],
    "`select count(*) from phrases`": ["query", "select count(*) from phrases", "--format", "csv"],
}


def size_mb(folder: pathlib.Path) -> float:
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="folder of the programs")
    parser.add_argument("--songs", type=int, default=1_000_000, help="(default %(default)s)")
    parser.add_argument("--doublings", type=int, default=2, help="(default %(default)s)")
    parser.add_argument("--work", type=pathlib.Path, help="folder for the store (default: temporary)")
    arguments = parser.parse_args()
    motiongen = (arguments.bin / "motiongen").resolve()
    synthetic = (arguments.bin / "examples/synthetic-store").resolve()
    print(heading("scale", [f"program {motiongen}"]))
    work = pathlib.Path(tempfile.mkdtemp(prefix="scale-", dir=arguments.work))
    store = work / "store"
    before: dict[str, Run] = {}
    n_before = 0
    try:
        for doubling in range(arguments.doublings + 1):
            n = arguments.songs << doubling
            made = run([synthetic, store, str(n_before), str(n)])
            n_before = n
            newest = [max(stage.iterdir()) for stage in store.glob("catalogue/*")]
            catalogues_mb = sum(f.stat().st_size for f in newest) / 1e6
            print(f"\n{n:,} songs: {size_mb(store / 'commits'):,.0f} MB of manifests, {catalogues_mb:,.0f} MB of")
            print(f"catalogues, {size_mb(store / 'phrases'):,.0f} MB of `phrases`; committed in {made.wall_s:.0f} s\n")
            print("| | wall | CPU | peak memory | CPU beside half |")
            print("|---|---|---|---|---|")
            for name, command in COMMANDS.items():
                stage, *rest = command
                where = ["--store", store]
                # status ends with 75 while anything is left to do.
                done = run([motiongen, stage, *where, *rest], good=(0, 75))
                ratio = f"{done.cpu_s / before[name].cpu_s:.2f}" if name in before else "–"
                before[name] = done
                print(
                    f"| {name} | {done.wall_s:.2f} s | {done.cpu_s:.2f} s | {done.peak_mb:,.0f} MB | {ratio} |",
                    flush=True,
                )
    finally:
        shutil.rmtree(work)


if __name__ == "__main__":
    main()
