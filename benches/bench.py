#!/usr/bin/env python3
"""Measures motiongen beside its peers in one run, and prints the ratios as Markdown.

    make bench                                  optimised build, full size
    make bench BENCH_ARGS=--quick               small sizes, to see that it works
    python bench.py --bin target/release --profile release

  ingest   10,000 phrases into tables, against plain-read: one thread that reads the same files and
           writes all their bytes through zstd level 1, and does nothing else.
  scan     the mean of one column through `motiongen query`, against Python polars on the same
           Parquet files.
  kill     two processes at the same ingest, 20 times killed at random moments, then one run to the
           end: the tables must be those of an ingest that nobody disturbed, byte for byte.

Runs of the programs alternate, files are read once before (page cache warm for all), and times are
medians. The Python that runs this needs NumPy and polars (benches/requirements.txt).
"""

import argparse
import hashlib
import importlib.metadata
import json
import os
import pathlib
import random
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass

from machine import heading

HERE = pathlib.Path(__file__).resolve().parent
QUERY = "select avg(velocity_x) as mean from motion"
# Small batches give the kills more commits to fall between.
KILL_FLAGS = ["--batch-phrases", "64"]
INGEST_TARGET = 1.5
SCAN_TARGET = 3.0

# The peer: prints the mean, and how long the query took once polars was imported.
POLARS = """
import sys, time
import polars
start = time.perf_counter()
motion = polars.scan_parquet(sys.argv[1] + "/motion/*.parquet")
mean = motion.select(polars.col("velocity_x").mean()).collect().item()
print(mean, time.perf_counter() - start)
"""


@dataclass
class Run:
    wall_s: float
    cpu_s: float
    peak_mb: float
    output: str


def run(command: list[str | pathlib.Path], good: tuple[int, ...] = (0,)) -> Run:
    """Runs a program to its good end and measures the whole process."""
    with tempfile.TemporaryFile() as output:
        start = time.perf_counter()
        # Not polled by subprocess: wait4 alone tells the peak memory of this very child.
        child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        _, status, usage = os.wait4(child.pid, 0)
        wall_s = time.perf_counter() - start
        child.returncode = os.waitstatus_to_exitcode(status)
        output.seek(0)
        text = output.read().decode(errors="replace")
    if child.returncode not in good:
        sys.exit(f"{' '.join(map(str, command))} ended with {child.returncode}:\n{text}")
    return Run(wall_s, usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e6, text)


def interleaved(programs: dict[str, Callable[[], Run]], repeats: int) -> dict[str, list[Run]]:
    """Runs every program `repeats` times, taking turns."""
    runs: dict[str, list[Run]] = {name: [] for name in programs}
    for _ in range(repeats):
        for name, program in programs.items():
            runs[name].append(program())
    return runs


def median_s(runs: list[Run]) -> float:
    return statistics.median(r.wall_s for r in runs)


def median_cpu_s(runs: list[Run]) -> float:
    return statistics.median(r.cpu_s for r in runs)


def spread(runs: list[Run]) -> str:
    times = sorted(r.wall_s for r in runs)
    return f"{statistics.median(times):.3f} ({times[0]:.3f}–{times[-1]:.3f})"


def table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def verdict(ratio: float, target: float) -> str:
    return f"{ratio:.2f}, target ≤ {target:g}: {'met' if ratio <= target else 'MISSED'}"


class Bench:
    def __init__(self, arguments: argparse.Namespace) -> None:
        self.motiongen = arguments.bin / "motiongen"
        self.plain_read = arguments.bin / "examples" / "plain-read"
        self.work = arguments.work
        self.count = arguments.count
        self.repeats = arguments.repeats
        self.n_kills = arguments.kills
        self.seed = arguments.seed
        for program in (self.motiongen, self.plain_read):
            if not program.is_file():
                sys.exit(
                    f"{program} is missing; build it with: make bench, or name its --bin folder"
                )

    def phrases(self, with_features: bool) -> pathlib.Path:
        """Returns the folder of phrases, made whole or not at all, and read once."""
        folder = self.work / f"phrases-{self.count}{'-features' if with_features else ''}"
        if not folder.exists():
            partial = folder.with_suffix(".partial")
            shutil.rmtree(partial, ignore_errors=True)
            flags = ["--features"] if with_features else []
            run(
                [
                    sys.executable,
                    HERE / "make_phrases.py",
                    partial,
                    "--count",
                    str(self.count),
                    *flags,
                ]
            )
            partial.rename(folder)
        for path in folder.rglob("*.np[yz]"):
            path.read_bytes()
        return folder

    def ingest_command(self, source: pathlib.Path, store: pathlib.Path, *flags: str) -> list:
        return [self.motiongen, "ingest", "--quiet", "--source", source, "--store", store, *flags]

    def fresh_store(self, name: str) -> pathlib.Path:
        store = self.work / name
        shutil.rmtree(store, ignore_errors=True)
        return store

    def ingest(self) -> str:
        rows, notes = [], []
        for title, with_features in [("motion", False), ("motion and features", True)]:
            source = self.phrases(with_features)
            n_bytes = sum(path.stat().st_size for path in source.rglob("*.np[yz]"))

            def ours(*flags: str) -> Run:
                return run(self.ingest_command(source, self.fresh_store("store-ingest"), *flags))

            def plain() -> Run:
                output = self.work / "plain.zst"
                output.unlink(missing_ok=True)
                return run([self.plain_read, source, output])

            programs = {
                "plain-read, 1 thread": plain,
                "ingest --workers 1": lambda: ours("--workers", "1"),
                "ingest": ours,
            }
            runs = interleaved(programs, self.repeats)
            base_s = median_s(runs["plain-read, 1 thread"])
            for name, own in runs.items():
                ratio = median_s(own) / base_s
                rows.append(
                    [
                        f"{title}, {n_bytes / 1e6:.0f} MB",
                        name,
                        spread(own),
                        f"{median_cpu_s(own):.2f}",
                        f"{self.count / median_s(own):,.0f}",
                        f"{max(r.peak_mb for r in own):.0f}",
                        f"{ratio:.2f}",
                    ]
                )
            ratio = median_s(runs["ingest"]) / base_s
            notes.append(f"- {title}: ingest / plain-read = {verdict(ratio, INGEST_TARGET)}\n")
        head = [
            "phrases",
            "program",
            "wall s, median (range)",
            "CPU s",
            "phrases/s",
            "peak MB",
            "ratio",
        ]
        text = (
            "plain-read does not parse, check, digest or sync anything; ingest does all of that. "
            f"`ingest` alone uses a worker per core ({os.cpu_count()} here). Peaks under about 25 "
            "MB are those of the measuring process, from which the programs are started.\n\n"
        )
        return (
            f"### Ingest of {self.count:,} phrases of 120 frames\n\n{text}{table(head, rows)}\n"
            + "".join(notes)
        )

    def scan(self) -> str:
        store = self.fresh_store("store-scan")
        run(self.ingest_command(self.phrases(False), store))
        in_process_s = []

        def ours() -> Run:
            return run([self.motiongen, "query", "--store", store, QUERY, "--format", "csv"])

        def peer() -> Run:
            done = run([sys.executable, "-c", POLARS, store])
            in_process_s.append(float(done.output.split()[1]))
            return done

        runs = interleaved({"motiongen query": ours, "Python polars": peer}, self.repeats)
        own = float(runs["motiongen query"][0].output.split()[1])
        other = float(runs["Python polars"][0].output.split()[0])
        if abs(own - other) > 1e-5 * max(abs(own), abs(other), 1e-3):
            sys.exit(f"the scans disagree: motiongen says {own}, polars {other}")
        ours_s, peer_s = median_s(runs["motiongen query"]), median_s(runs["Python polars"])
        alone_s = statistics.median(in_process_s)
        rows = [
            [
                name,
                spread(own_runs),
                f"{median_cpu_s(own_runs):.2f}",
                f"{max(r.peak_mb for r in own_runs):.0f}",
            ]
            for name, own_runs in runs.items()
        ]
        rows.append(["Python polars, query alone (after import)", f"{alone_s:.3f}", "", ""])
        notes = (
            f"- whole process / whole process = {verdict(ours_s / peer_s, SCAN_TARGET)}\n"
            f"- whole process / polars' query alone = {verdict(ours_s / alone_s, SCAN_TARGET)}\n"
        )
        n_parts = len(list((store / "motion").glob("*.parquet")))
        title = f"### Scan of one column: {self.count * 120:,} rows in {n_parts} parts\n\n"
        says = f"`{QUERY}`; both answer {own:.6g}.\n\n"
        return (
            title
            + says
            + table(["program", "wall s, median (range)", "CPU s", "peak MB"], rows)
            + "\n"
            + notes
        )

    def kill(self) -> str:
        source = self.phrases(False)
        rng = random.Random(self.seed)
        reference = self.fresh_store("store-undisturbed")
        whole_s = run(self.ingest_command(source, reference, *KILL_FLAGS)).wall_s
        start_s = run([*self.ingest_command(source, reference, *KILL_FLAGS), "--dry-run"]).wall_s
        expected = committed(reference)

        n_kills = n_rounds = n_stores = 0
        store = self.fresh_store("store-killed")
        while n_kills < self.n_kills:
            # In turn: two shards that share the work, and two that race for all of it.
            shards = ["0/2", "1/2"] if n_rounds % 2 == 0 else ["0/1", "0/1"]
            n_rounds += 1
            racers = [
                subprocess.Popen(
                    [*self.ingest_command(source, store, *KILL_FLAGS), "--shard", shard],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                )
                for shard in shards
            ]
            # From before the first commit to well into the work.
            longest_s = start_s + (whole_s - start_s) / 4
            delays_s = sorted(rng.uniform(0, longest_s) for _ in racers)
            began = time.perf_counter()
            for racer, delay_s in zip(rng.sample(racers, len(racers)), delays_s, strict=True):
                time.sleep(max(0.0, began + delay_s - time.perf_counter()))
                if n_kills < self.n_kills and racer.poll() is None:
                    racer.kill()
                    n_kills += 1
            codes = [racer.wait() for racer in racers]
            if any(code not in (0, -9) for code in codes):
                sys.exit(f"an ingest ended with {codes} while the other was killed")
            parts_are_whole(store)
            if committed(store).keys() == expected.keys():
                # Nothing is left to disturb: judge this store and disturb another.
                same_as(expected, store)
                n_stores += 1
                store = self.fresh_store("store-killed")
        run(self.ingest_command(source, store, *KILL_FLAGS))
        same_as(expected, store)
        n_stores += 1
        lost = [
            path
            for path in store.rglob("*")
            if path.is_file() and not is_live(path, store, expected)
        ]
        n_lost = sum(path.stat().st_size for path in lost)
        return (
            f"### Kills during the ingest of {self.count:,} phrases\n\n"
            f"{n_kills} × `kill -9` at random moments (seed {self.seed}) in {n_rounds} rounds of "
            f"two processes; stores driven to the end: {n_stores}. Each has the {len(expected)} "
            "committed files (parts and manifests) of an ingest that nobody disturbed, byte for "
            "byte; after every round, every committed part was there and whole. Left behind in "
            f"the last store, invisible to readers: {len(lost)} files, {n_lost / 1e6:.2f} MB.\n"
        )


def committed(store: pathlib.Path) -> dict[str, str]:
    """Returns path and digest of every manifest and of every part that a manifest names."""
    found = {}
    for manifest in (store / "commits").rglob("*.json"):
        parts = [part["path"] for part in json.loads(manifest.read_bytes())["parts"]]
        for name in [manifest.relative_to(store).as_posix(), *parts]:
            found[name] = hashlib.sha256((store / name).read_bytes()).hexdigest()
    return found


def parts_are_whole(store: pathlib.Path) -> None:
    for manifest in (store / "commits").rglob("*.json"):
        for part in json.loads(manifest.read_bytes())["parts"]:
            path = store / part["path"]
            if not path.is_file() or path.stat().st_size != part["n_bytes"]:
                sys.exit(f"{manifest} was committed without the whole of {path}")


def same_as(expected: dict[str, str], store: pathlib.Path) -> None:
    actual = committed(store)
    differing = sorted(
        name for name in expected.keys() | actual.keys() if expected.get(name) != actual.get(name)
    )
    if differing:
        sys.exit(
            f"{store} differs from an undisturbed ingest in {len(differing)} files: {differing[:5]}"
        )


def is_live(path: pathlib.Path, store: pathlib.Path, expected: dict[str, str]) -> bool:
    return path.relative_to(store).as_posix() in expected


def first_line(command: list[str | pathlib.Path]) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[
        0
    ]


def machine(bench: Bench, profile: str) -> str:
    return heading(
        "ingest and query",
        [
            f"{first_line([bench.motiongen, '--version'])} (profile {profile})",
            first_line(["rustc", "--version"]),
            f"polars {importlib.metadata.version('polars')}",
        ],
    )


def builds(log: pathlib.Path) -> str:
    """Returns what cargo said of its build times in a log."""
    found = re.findall(r"Finished .*", log.read_text())
    return "### Builds\n\n" + "".join(f"- {line.strip()}\n" for line in found)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="folder of the executables")
    parser.add_argument("--profile", required=True, help="how they were built, for the record")
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("build/bench"))
    parser.add_argument("--only", choices=["ingest", "scan", "kill"], action="append", default=[])
    parser.add_argument("--quick", action="store_true", help="500 phrases, 3 runs, 6 kills")
    parser.add_argument("--count", type=int, help="phrases (default 10000)")
    parser.add_argument("--repeats", type=int, help="runs of each program (default 5)")
    parser.add_argument("--kills", type=int, help="(default 20)")
    parser.add_argument("--seed", type=int, default=1, help="of the kills' moments")
    parser.add_argument("--build-log", type=pathlib.Path, help="cargo's output, for build times")
    arguments = parser.parse_args()
    full, quick = (10_000, 5, 20), (500, 3, 6)
    sizes = quick if arguments.quick else full
    for name, value in zip(["count", "repeats", "kills"], sizes, strict=True):
        if getattr(arguments, name) is None:
            setattr(arguments, name, value)

    arguments.work.mkdir(parents=True, exist_ok=True)
    bench = Bench(arguments)
    sections = {"ingest": bench.ingest, "scan": bench.scan, "kill": bench.kill}
    parts = [machine(bench, arguments.profile)]
    print(parts[0], flush=True)
    for name, section in sections.items():
        if not arguments.only or name in arguments.only:
            parts.append(section())
            print(parts[-1], flush=True)
    if arguments.build_log:
        parts.append(builds(arguments.build_log))
        print(parts[-1])
    results = arguments.work / "results.md"
    with results.open("a") as file:
        file.write("\n".join(parts) + "\n")
    print(f"added to {results}; phrases and stores stay in {arguments.work} until you remove them")


if __name__ == "__main__":
    main()
