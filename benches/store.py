#!/usr/bin/env python3
"""Measures a store of a million phrases, and one that was updated every day for a year.

    make bench-store                                     1,000,000 phrases, a year of 100,000
    make bench-store BENCH_ARGS='--phrases 20000 --days 28 --daily-phrases 2000'
    make bench-store BENCH_PROFILE=release
    python benches/store.py --bin target/release/motiongen --skip-year

  million  phrases of 32 frames, synthesised: ingest, ingest again, count(*), one phrase looked up, compact.
  year     every day 1 % of the phrases change and are ingested; every week compact and vacuum. At the end: parts
           beside those of a store that was ingested at once, the time of a scan beside that of a scan of it, and the
           rows of both, which must be the same.

Motion is drawn once for 1,000 phrases and linked, so that the disk holds names rather than copies. Times are those of
the whole program, memory is its peak.
"""

import argparse
import json
import os
import pathlib
import random
import shutil
import statistics
import sys
import tempfile

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))

import make_phrases
from bench import Run, run
from machine import heading

N_FRAMES = 32
N_DISTINCT = 1000
SCAN = "select avg(velocity_x) as mean from motion"


def distinct(folder: pathlib.Path, seed: int) -> list[pathlib.Path]:
    """Writes the motions that phrases share."""
    make_phrases.N_FRAMES = N_FRAMES
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    files = []
    for i, motion in enumerate(make_phrases.motions(rng, N_DISTINCT)):
        path = folder / f"{i}.npy"
        np.save(path, motion)
        files.append(path)
    return files


def link(source: pathlib.Path, i: int, motion: pathlib.Path) -> None:
    place = source / "motion" / f"phrase_{i:07}"
    file = place / "trajectory.npy"
    if file.exists():
        file.unlink()
    else:
        place.mkdir(parents=True)
    os.link(motion, file)


def make_source(source: pathlib.Path, files: list[pathlib.Path], n: int) -> None:
    for i in range(n):
        link(source, i, files[i % len(files)])


def n_parts(store: pathlib.Path) -> int:
    return sum(1 for _ in store.glob("*/*.parquet"))


def line(what: str, done: Run, n: int | None = None) -> None:
    rate = f" | {n / done.wall_s:,.0f}/s" if n else " | "
    print(f"| {what} | {done.wall_s:.2f} s | {done.cpu_s:.2f} s | {done.peak_mb:.0f} MB{rate} |", flush=True)


def million(motiongen: pathlib.Path, work: pathlib.Path, n: int, has_query: bool) -> None:
    files = distinct(work / "distinct", 1)
    source, store = work / "source", work / "store"
    make_source(source, files, n)
    print(f"\n## {n:,} phrases of {N_FRAMES} frames\n")
    print("| | wall | CPU | peak memory | rate |\n|---|---|---|---|---|")
    ingest = [motiongen, "ingest", "--source", source, "--store", store, "--quiet"]
    line("ingest", run(ingest), n)
    line("ingest again, nothing to do", run(ingest), n)
    page = work / "page.html"
    phrase = f"phrase_{n // 3:07}"
    view = [motiongen, "view", "--store", store, "--phrase", phrase, "--output", page, "--quiet"]
    count = [motiongen, "query", "--store", store, "select count(*) from phrases", "--format", "csv"]
    for when in ("", ", compacted"):
        if when:
            line("compact", run([motiongen, "compact", "--store", store, "--quiet"]), n)
            line("vacuum", run([motiongen, "vacuum", "--store", store, "--older-than", "0s"]))
        if has_query:
            done = run(count)
            assert done.output.split() == ["len", str(n)], done.output
            line(f"`select count(*) from phrases`{when}", done)
        line(f"`view --phrase`{when}", run(view))
    n_commits = sum(1 for _ in (store / "commits/ingest").iterdir())
    print(f"\n{n_parts(store):,} parts, {n_commits:,} commits after that.")


def year(motiongen: pathlib.Path, work: pathlib.Path, n: int, days: int, has_query: bool) -> None:
    files = distinct(work / "distinct", 2)
    source, store, fresh = work / "source", work / "store", work / "fresh"
    make_source(source, files, n)
    ingest = [motiongen, "ingest", "--source", source, "--quiet", "--store"]
    run([*ingest, store])
    rng = random.Random(3)
    ingests, compactions, most_parts = [], [], 0
    for day in range(1, days + 1):
        for i in rng.sample(range(n), n // 100):
            link(source, i, files[rng.randrange(len(files))])
        ingests.append(run([*ingest, store]).wall_s)
        most_parts = max(most_parts, n_parts(store))
        if day % 7 == 0 or day == days:
            compactions.append(run([motiongen, "compact", "--store", store, "--quiet"]).wall_s)
            run([motiongen, "vacuum", "--store", store, "--older-than", "0s", "--quiet"])
    run([*ingest, fresh])
    run([motiongen, "compact", "--store", fresh, "--quiet"])
    run([motiongen, "vacuum", "--store", fresh, "--older-than", "0s", "--quiet"])
    print(f"\n## {n:,} phrases, {days} daily updates of 1 %, compacted weekly\n")
    print(f"- parts: {n_parts(store)} in the end, {n_parts(fresh)} in a fresh store; at most {most_parts:,}")
    print(f"- ingest of a day: {statistics.median(ingests):.2f} s; compact: {statistics.median(compactions):.2f} s")
    size = lambda folder: sum(f.stat().st_size for f in folder.glob("*/*.parquet")) / 1e6
    print(f"- bytes of the tables: {size(store):.0f} MB, fresh {size(fresh):.0f} MB")
    if not has_query:
        return
    ask = lambda folder, sql: run([motiongen, "query", "--store", folder, sql, "--format", "json"])
    times = {folder: [] for folder in (store, fresh)}
    for _ in range(5):
        for folder, of_folder in times.items():
            of_folder.append(ask(folder, SCAN).wall_s)
    worn, new = (statistics.median(times[folder]) for folder in (store, fresh))
    print(f"- scan: {worn:.2f} s, fresh {new:.2f} s: {worn / new:.2f} ×")
    sql = "select phrase_id, content_hash from phrases order by phrase_id"
    rows = [json.loads(ask(folder, sql).output) for folder in (store, fresh)]
    print(f"- rows are {'the same' if rows[0] == rows[1] else 'DIFFERENT'}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="the program")
    parser.add_argument("--phrases", type=int, default=1_000_000, help="(default %(default)s)")
    parser.add_argument("--daily-phrases", type=int, default=100_000, help="(default %(default)s)")
    parser.add_argument("--days", type=int, default=365, help="(default %(default)s)")
    parser.add_argument("--work", type=pathlib.Path, help="folder for the stores (default: temporary)")
    parser.add_argument("--no-query", action="store_true", help="the program was built without query")
    parser.add_argument("--skip-million", action="store_true")
    parser.add_argument("--skip-year", action="store_true")
    arguments = parser.parse_args()
    motiongen = arguments.bin.resolve()
    print(heading("store", [f"program {motiongen}"]))
    has_query = not arguments.no_query
    for name, skipped in (("million", arguments.skip_million), ("year", arguments.skip_year)):
        if skipped:
            continue
        work = pathlib.Path(tempfile.mkdtemp(prefix=f"store-{name}-", dir=arguments.work))
        try:
            if name == "million":
                million(motiongen, work, arguments.phrases, has_query)
            else:
                year(motiongen, work, arguments.daily_phrases, arguments.days, has_query)
        finally:
            shutil.rmtree(work)


if __name__ == "__main__":
    main()
