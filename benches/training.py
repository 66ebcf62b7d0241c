#!/usr/bin/env python3
"""Measures training and fine-tuning, beside PyTorch where there is something to stand beside.

    python benches/training.py --bin target/release
    python benches/training.py --bin … --quick      the small network, to see that it works

  finetune  a step end to end: 5 steps of DDIM with gradients, both networks, batch 8; time and memory
  group     a step of training a model of groups, batch 4 of three dancers, `small` and `base`; time and memory
  group_generation   groups by an untrained network, whose speed is that of a trained one
  train     steps of `motiongen train` on the demo library: how long a step waits for its batch, and
            what an epoch of the reference's 5,242 phrases would take

Times are medians with their range, ratios are of medians, theirs / ours. Both programs have the same
number of threads and take turns. The Python that runs this needs benches/requirements-engine.txt.
"""

import argparse
import csv
import importlib.metadata
import io
import os
import pathlib
import shutil
import statistics
import subprocess
import sys

from bench import HERE, first_line, table
from engine import FRAMES, OURS, TORCH, Worker, in_turns, median, spread
from machine import heading

ROOT = HERE.parent
# What the reference trains on, and its and PyTorch's times for an epoch of it (issue and section 13.1).
EPOCH_PHRASES = 5242
REFERENCE_MIN = 35
# Groups of a batch, and their dancers.
GROUPS, DANCERS = 4, 3
# Dancers and frames of generation.
MANY_DANCERS, LONG_FRAMES = 5, 30 * 30


def finetune(arguments: argparse.Namespace) -> str:
    commands = {
        OURS: [arguments.bin / "examples" / "training-bench"],
        TORCH: [sys.executable, HERE / "training_peer.py"],
    }
    workers = {name: Worker(command, arguments.threads) for name, command in commands.items()}
    for name, worker in workers.items():
        worker.ask(
            "init",
            preset=arguments.preset,
            batch=arguments.batch,
            frames=FRAMES,
            threads=arguments.threads,
        )
    answers = in_turns(workers, "step", arguments.repeats)
    rows = []
    for name, own in answers.items():
        ratio = f"{median(answers[TORCH], 'wall_s') / median(own, 'wall_s'):.2f}"
        peak = workers[name].peak_mb()
        share = f"{peak / workers[TORCH].peak_mb():.0%}"
        cpu = f"{median(own, 'cpu_s') * 1e3:,.0f}"
        rows.append([name, spread(own), cpu, ratio, f"{peak:,.0f}", share])
    for worker in workers.values():
        worker.close()
    head = ["program", "step ms", "CPU ms", "theirs / ours", "peak MB", "of PyTorch's"]
    title = (
        f"### End-to-end step of `{arguments.preset}`, batch {arguments.batch}, {FRAMES} frames, "
        f"5 DDIM steps, {arguments.threads} threads"
    )
    return f"{title}\n\n{table(head, rows)}"


def group(arguments: argparse.Namespace) -> str:
    presets = ["small"] if arguments.quick else ["small", "base"]
    parts = []
    for preset in presets:
        workers = {
            OURS: Worker([arguments.bin / "examples" / "training-bench"], arguments.threads),
            TORCH: Worker([sys.executable, HERE / "group_peer.py"], arguments.threads),
        }
        counts = {
            name: worker.ask(
                "init",
                family="group",
                preset=preset,
                batch=GROUPS,
                dancers=DANCERS,
                frames=FRAMES,
                threads=arguments.threads,
                # As `train` does by itself.
                side_by_side=2 if preset == "small" else 1,
            )["parameters"]
            for name, worker in workers.items()
        }
        answers = in_turns(workers, "step", arguments.repeats, lead=1)
        rows = []
        for name, own in answers.items():
            ratio = f"{median(answers[TORCH], 'wall_s') / median(own, 'wall_s'):.2f}"
            peak = workers[name].peak_mb()
            cpu = f"{median(own, 'cpu_s') * 1e3:,.0f}"
            rows.append([name, f"{counts[name]:,}", spread(own), cpu, ratio, f"{peak:,.0f}"])
        for worker in workers.values():
            worker.close()
        head = ["program", "parameters", "step ms", "CPU ms", "theirs / ours", "peak MB"]
        title = (
            f"### Step of a model of groups, `{preset}`, batch {GROUPS} of {DANCERS} dancers, {FRAMES} frames, "
            f"8 mixed groups each, {arguments.threads} threads"
        )
        parts.append(f"{title}\n\n{table(head, rows)}")
    return "\n\n".join(parts)


def group_generation(arguments: argparse.Namespace) -> str:
    rows = []
    for preset in ["small"] if arguments.quick else ["small", "base"]:
        for consistency in (0.0, 0.5):
            worker = Worker([arguments.bin / "examples" / "training-bench"], arguments.threads)
            worker.ask(
                "init",
                family="group_generation",
                preset=preset,
                dancers=MANY_DANCERS,
                frames=LONG_FRAMES,
                threads=arguments.threads,
                consistency=consistency,
            )
            answers = in_turns({OURS: worker}, "step", 1 if preset == "base" else arguments.repeats)[OURS]
            length_s = LONG_FRAMES / 30
            factor = f"{median(answers, 'wall_s') / length_s:.2f}"
            cpu = f"{median(answers, 'cpu_s') / length_s:.2f}"
            rows.append([preset, f"{consistency:g}", spread(answers), factor, cpu, f"{worker.peak_mb():,.0f}"])
            worker.close()
    head = ["preset", "γ", "ms", "real-time factor", "CPU s a second", "peak MB"]
    title = f"### {MANY_DANCERS} dancers, {LONG_FRAMES / 30:.0f} s, 20 steps, {arguments.threads} threads"
    return f"{title}\n\n{table(head, rows)}"


def run(*command: object) -> str:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MOTIONGEN_")}
    done = subprocess.run(
        [str(part) for part in command], env=environment, capture_output=True, text=True
    )
    if done.returncode not in (0, 1):
        sys.exit(f"{command[0]} ended with {done.returncode}: {done.stderr}")
    return done.stdout


def train(arguments: argparse.Namespace) -> str:
    motiongen, store = arguments.bin / "motiongen", arguments.work / "training-store"
    if arguments.bin.name == "release":
        # Built without `query`; the dev executable reads the log.
        asker = ROOT / "target" / "debug" / "motiongen"
    else:
        asker = motiongen
    shutil.rmtree(store, ignore_errors=True)
    for source in ("music", "phrases"):
        run(motiongen, "ingest", "--source", ROOT / "tests" / "data" / source, "--store", store)
    run(motiongen, "extract", "--store", store)
    run(motiongen, "library", "--store", store)
    common = ["--store", store, "--preset", arguments.preset, "--batch-size", 32]
    steps = arguments.train_steps
    run(
        motiongen, "train", "--run", "bench", *common, "--steps", steps, "--decoder-steps", 1,
        "--threads", arguments.threads, "--validate-every", 0, "--save-every", 0, "--quiet",
    )  # fmt: skip
    sql = (
        "select step, samples_per_s, data_wait_s, rss_bytes from training_log "
        "where stage = 'diffusion' and kind = 'step' order by step"
    )
    rows = list(csv.DictReader(io.StringIO(run(asker, "query", "--store", store, sql, "--format", "csv"))))
    # The first step asks the system for its memory.
    step_s = [32 / float(row["samples_per_s"]) for row in rows[2:]]
    wait_s = [float(row["data_wait_s"]) for row in rows[2:]]
    share = sum(wait_s) / (sum(step_s) + sum(wait_s))
    mid = statistics.median(step_s)
    epoch_min = EPOCH_PHRASES / 32 * (mid + statistics.mean(wait_s)) / 60
    peak = max(int(row["rss_bytes"]) for row in rows) / 1e6
    cells = [
        f"{mid * 1e3:,.0f} ({min(step_s) * 1e3:,.0f}–{max(step_s) * 1e3:,.0f})",
        f"{statistics.median(wait_s) * 1e3:.2f}",
        f"{share:.2%}",
        f"{epoch_min:.1f}",
        f"{REFERENCE_MIN}",
        f"{peak:,.0f}",
    ]
    head = ["step ms", "wait ms", "share of waiting", f"epoch of {EPOCH_PHRASES:,} min",
            "reference (A100) min", "memory MB"]  # fmt: skip
    title = f"### `motiongen train`, `{arguments.preset}`, batch 32, {len(step_s)} steps"
    return f"{title}\n\n{table(head, [cells])}"


def machine(arguments: argparse.Namespace) -> str:
    return heading(
        "training",
        [
            f"profile {arguments.profile}",
            first_line(["rustc", "--version"]),
            f"PyTorch {importlib.metadata.version('torch')}",
            f"{arguments.repeats} runs of each, taking turns",
        ],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="folder of the executables")
    parser.add_argument("--profile", default="release")
    parser.add_argument("--quick", action="store_true", help="the small network, few steps")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--only", choices=["finetune", "group", "group_generation", "train"])
    arguments = parser.parse_args()
    arguments.bin = arguments.bin.resolve()
    arguments.preset = "small" if arguments.quick else "base"
    arguments.batch, arguments.train_steps = 8, 14
    arguments.work = ROOT / "build"
    arguments.work.mkdir(exist_ok=True)
    parts = {"finetune": finetune, "group": group, "group_generation": group_generation, "train": train}
    print(machine(arguments))
    for name, part in parts.items():
        if arguments.only in (None, name):
            print(part(arguments), end="\n\n", flush=True)


if __name__ == "__main__":
    main()
