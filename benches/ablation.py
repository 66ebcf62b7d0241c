#!/usr/bin/env python3
"""Measures what each choice of the pipeline brings on songs that nothing was learned from.

    make bench-ablation                                        builds first; hours
    python benches/ablation.py --bin target/release/motiongen --seeds 0 --only 'clock;default'

Each row trains the preset `tiny` anew for every seed through the commands that a user has: ingest, extract,
library, train, export, generate, evaluate. By steps, so that a busy machine measures the same. What is done is
not done again; --out keeps it. Tunes come from the wheel of music21 (melodies of 1883), which pip fetches.
"""

import argparse
import collections
import csv
import io
import pathlib
import statistics
import subprocess
import sys
import zipfile

from machine import heading

ROOT = pathlib.Path(__file__).resolve().parent.parent
CONFIG = ROOT / "pipelines" / "demo.toml"
MUSIC21 = "music21==10.5.1"
LOSSES = ["--velocity-loss", "0.03", "--acceleration-loss", "0.03", "--difference-losses", "0.03,0.003,0.0003"]

Row = collections.namedtuple("Row", "songs clock losses fuse")
ROWS = {
    "nothing": Row("plain", False, False, False),
    "clock": Row("plain", True, False, False),
    "losses": Row("plain", False, True, False),
    "fuse": Row("plain", False, False, True),
    "composer": Row("composed", False, False, False),
    "tunes": Row("tunes", False, False, False),
    "clock, fuse (the default)": Row("plain", True, False, True),
    "default, losses": Row("plain", True, True, True),
    "default, composer": Row("composed", True, False, True),
    "default, tunes": Row("tunes", True, False, True),
    "everything": Row("everything", True, True, True),
}
# Heading, metric, variant, and how it is shown.
NUMBERS = [
    ("R²", "locking_r2", "per_song", "{:.2f}"),
    ("amplitude", "coupling_ratio", "constructed", "{:.2f}"),
    ("speed x", "speed_ratio", "x", "{:.2f}"),
    ("y", "speed_ratio", "y", "{:.2f}"),
    ("z", "speed_ratio", "z", "{:.2f}"),
    ("jerk", "jerk_ratio", "", "{:.2f}"),
    ("fid_k", "fid_k", "axes", "{:.1f}"),
    ("sound as decoded", "pass_rate", "strict_raw", "{:.0%}"),
    ("sound", "pass_rate", "strict", "{:.0%}"),
]
# What a network hears by itself: its clock withheld.
DEAF = ("R², clock withheld", "locking_r2", "per_song", "{:.2f}")


def run(*command: object) -> str:
    """Runs a command, and ends the program with what it wrote when it could not run.

    Exit code 1 tells of single items that failed: some tunes of the collection are written wrongly.
    """
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode not in (0, 1):
        sys.exit(f"{' '.join(words)}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def tunes(out: pathlib.Path, n: int) -> pathlib.Path:
    """Takes n tunes out of music21's collection of 1883, evenly spread over it."""
    folder = out / "abc"
    if not folder.is_dir():
        run(sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", out, MUSIC21)
        (wheel,) = out.glob("music21-*.whl")
        partial = out / "abc.partial"
        partial.mkdir(exist_ok=True)
        with zipfile.ZipFile(wheel) as archive:
            names = sorted(
                name for name in archive.namelist() if "ryansMammoth" in name and name.endswith(".abc")
            )
            for i in range(n):
                name = names[i * len(names) // n]
                (partial / pathlib.Path(name).name).write_bytes(archive.read(name))
        partial.rename(folder)
    return folder


class Bench:
    def __init__(self, args: argparse.Namespace):
        self.args = args
        self.motiongen = args.bin.resolve()

    def stage(self, name: str, *flags: object) -> str:
        return run(self.motiongen, name, *flags)

    def store(self, library: str) -> pathlib.Path:
        """Makes the phrases of a library, and returns the store that has them."""
        args, store = self.args, self.args.out / library
        done = store / "library.done"
        if not done.exists():
            for source in ("phrases", "music"):
                source = ROOT / "tests" / "data" / source
                self.stage("ingest", "--config", CONFIG, "--source", source, "--store", store)
            self.stage("extract", "--config", CONFIG, "--store", store)
            flags = []
            if library in ("composed", "everything"):
                flags += ["--compose", args.compose]
            if library in ("tunes", "everything"):
                flags += ["--tunes", tunes(args.out, args.tunes)]
            self.stage("library", "--config", CONFIG, "--store", store, *flags)
            done.touch()
        return store

    def train(self, row: Row, seed: int) -> tuple[pathlib.Path, str]:
        """Trains the networks of a row, and returns their store and run."""
        args, store = self.args, self.store(row.songs)
        name = "-".join(["clock" if row.clock else "deaf", "losses" if row.losses else "plain", str(seed)])
        flags = [] if row.clock else ["--no-clock"]
        flags += LOSSES if row.losses else []
        done = store / f"train-{name}.done"
        if not done.exists():
            self.stage("train", "--store", store, "--run", name, "--preset", "tiny", "--steps", args.steps,
                       "--decoder-steps", args.decoder_steps, "--style-weight", "0.125", "--seed", seed, *flags)
            done.touch()
        return store, name

    def measure(self, row: Row, seed: int) -> list[float]:
        """Generates and evaluates with the networks of a row, and returns the numbers of the held-out songs."""
        store, name = self.train(row, seed)
        model = f"{name}-{'fuse' if row.fuse else 'derive'}"
        done = store / f"measure-{model}.done"
        if not done.exists():
            self.stage("export", "--store", store, "--run", name, "--model", model, "--force",
                       *([] if row.fuse else ["--no-fusion"]))
            self.evaluated(row, store, model, model)
            done.touch()
        numbers = self.numbers(store, model, NUMBERS)
        if not row.clock:
            return [*numbers, numbers[0]]
        done = store / f"measure-{model}-withheld.done"
        if not done.exists():
            self.evaluated(row, store, model, f"{model}-withheld", "--no-clock")
            done.touch()
        return [*numbers, *self.numbers(store, f"{model}-withheld", [DEAF])]

    def evaluated(self, row: Row, store: pathlib.Path, model: str, name: str, *flags: str) -> None:
        self.stage("generate", "--store", store, "--model", model, "--run", name, "--samples", self.args.samples,
                   "--overlap", "30", "--coherence", "fuse" if row.fuse else "derive", *flags)
        # Baselines are no part of the table, and take longer than all else.
        self.stage("evaluate", "--store", store, "--run", name, "--baseline-windows", "0")

    def numbers(self, store: pathlib.Path, name: str, wanted: list[tuple]) -> list[float]:
        query = f"select metric, variant, value from metrics where run = '{name}' " \
                "and split = 'held_out' and subject = 'generated'"
        answer = self.stage("query", "--store", store, "--format", "csv", "--limit", "0", query)
        values = {(r["metric"], r["variant"]): r["value"] for r in csv.DictReader(io.StringIO(answer))}
        # A number that could not be measured is null.
        return [float(values[metric, variant] or "nan") for _, metric, variant, _ in wanted]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="the executable")
    parser.add_argument("--out", type=pathlib.Path, default=ROOT / "build" / "bench-ablation")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--only", help="rows, by the beginnings of their names, separated by semicolons")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--decoder-steps", type=int, default=600)
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--compose", type=int, default=48, help="songs that are composed")
    parser.add_argument("--tunes", type=int, default=48, help="tunes that are arranged")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    bench = Bench(args)
    seeds = [int(seed) for seed in args.seeds.split(",")]
    wanted = args.only.split(";") if args.only else [""]
    rows = {name: row for name, row in ROWS.items() if any(name.startswith(w) for w in wanted)}
    measured = collections.defaultdict(list)
    for seed in seeds:
        for name, row in rows.items():
            numbers = bench.measure(row, seed)
            measured[name].append(numbers)
            shown = ", ".join(f"{h} {f.format(x)}" for (h, *_, f), x in zip([*NUMBERS, DEAF], numbers))
            print(f"seed {seed}, {name}: {shown}", file=sys.stderr, flush=True)
    facts = [f"{args.steps} steps of `tiny`, {args.decoder_steps} of the decoder", f"seeds {args.seeds}",
             f"{args.samples} samples", f"{args.compose} composed songs", f"{args.tunes} tunes"]
    print(heading("ablation, held-out songs, mean (least to greatest)", facts))
    columns = [*NUMBERS, DEAF]
    print("| | " + " | ".join(h for h, *_ in columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for name, runs in measured.items():
        cells = []
        for (*_, form), column in zip(columns, zip(*runs)):
            ends = "" if len(column) == 1 else f" ({form.format(min(column))} to {form.format(max(column))})"
            cells.append(form.format(statistics.fmean(column)) + ends)
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
