#!/usr/bin/env python3
"""Measures the training engine beside PyTorch and onnxruntime in one run, and prints Markdown.

    python benches/engine.py --bin target/release/engine-bench
    python benches/engine.py --bin … --quick        the small network, to see that it works
    python benches/engine.py --bin … --parity       compares every gradient, and measures nothing

  step     a training step (forward with dropout, backward, clipping, AdamW), each size of batch
  forward  one motion without gradients, beside PyTorch and onnxruntime
  memory   the peak of a training run, beyond weights, gradients and the moments of AdamW
  gemm     products of matrices alone, of the shapes that the network has

Each program is a process of its own that is asked in lines of JSON (engine_peer.py); all have the
same number of threads. They take turns, with a pause after which idle threads have gone to sleep;
two turns of each are not counted. Times are medians with their range, ratios are of medians, theirs
/ ours. The Python that runs this needs benches/requirements-engine.txt.
"""

import argparse
import importlib.metadata
import json
import os
import pathlib
import re
import statistics
import subprocess
import sys
import time

from bench import HERE, first_line, table
from engine_parity import parity
from machine import heading

OURS, TORCH, ONNX = "motiongen", "PyTorch", "onnxruntime"
FRAMES = 120
WARM_UP = 2
PAUSE_S = 0.3
# From here on half the repeats are enough.
LARGE_BATCH = 32
MEMORY_BATCH = 8
MEMORY_STEPS = 3
PACKAGES = ["torch", "onnxruntime", "numpy"]
Answers = list[dict[str, float]]


class Worker:
    """A program that answers requests."""

    def __init__(self, command: list[str | pathlib.Path], threads: int) -> None:
        # No OMP_WAIT_POLICY: threads sleep within the pause, and PASSIVE slows PyTorch.
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
        # Which instructions OpenBLAS uses is for it to find out.
        environment.pop("OPENBLAS_CORETYPE", None)
        self.name = " ".join(str(part) for part in command)
        self.child = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True
        )

    def ask(self, cmd: str, **request: object) -> dict:
        try:
            self.child.stdin.write(json.dumps({"cmd": cmd, **request}) + "\n")
            self.child.stdin.flush()
            line = self.child.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            sys.exit(f"{self.name} ended at {cmd}; see its message above")
        answer = json.loads(line)
        if "error" in answer:
            sys.exit(f"{self.name} refused {cmd}: {answer['error']}")
        return answer

    def peak_mb(self) -> float:
        """Returns the largest resident size up to now."""
        status = pathlib.Path(f"/proc/{self.child.pid}/status").read_text()
        return int(re.search(r"VmHWM:\s*(\d+)", status).group(1)) * 1024 / 1e6

    def close(self) -> None:
        self.child.stdin.write('{"cmd": "quit"}\n')
        self.child.stdin.close()
        self.child.wait()
        self.child.stdout.close()


def in_turns(
    workers: dict[str, Worker], cmd: str, repeats: int, lead: int = 0
) -> dict[str, Answers]:
    """Asks every program for the same, in turns; `lead` answers of each turn are not counted."""
    answers: dict[str, Answers] = {name: [] for name in workers}
    for i in range(WARM_UP + repeats):
        for name, worker in workers.items():
            time.sleep(PAUSE_S)
            answer = [worker.ask(cmd) for _ in range(lead + 1)][-1]
            if i >= WARM_UP:
                answers[name].append(answer)
    return answers


def median(answers: Answers, key: str) -> float:
    return statistics.median(answer[key] for answer in answers)


def spread(answers: Answers, key: str = "wall_s") -> str:
    """Returns median and range in milliseconds."""
    times = [answer[key] * 1e3 for answer in answers]
    digits = 1 if max(times) < 1000 else 0
    low, mid, high = (f"{f(times):,.{digits}f}" for f in (min, statistics.median, max))
    return f"{mid} ({low}–{high})"


class Bench:
    def __init__(self, arguments: argparse.Namespace) -> None:
        self.bin = arguments.bin.resolve()
        self.preset = arguments.preset
        self.threads = arguments.threads
        self.repeats = arguments.repeats
        self.batches = arguments.batches
        self.work = arguments.work
        if not self.bin.is_file():
            sys.exit(f"{self.bin} is missing; build it, or name it with --bin")

    def start(self, name: str) -> Worker:
        peer = [sys.executable, HERE / "engine_peer.py", name.lower()]
        return Worker([self.bin, "serve"] if name == OURS else peer, self.threads)

    def init(self, name: str, worker: Worker, batch: int, **options: object) -> dict:
        """Has a network made, of the size that is measured unless the options say otherwise."""
        request = {"batch": batch, "frames": FRAMES, "threads": self.threads, **options}
        if name != ONNX:
            request = {"preset": self.preset, **request}
        if name == OURS:
            request = {"checkpoint": False, "accumulate": 1, **request}
        return worker.ask("init", **request)

    def pair(self, batch: int) -> dict[str, Worker]:
        """Starts our engine and PyTorch with the same network."""
        workers = {name: self.start(name) for name in (OURS, TORCH)}
        counts = {
            name: self.init(name, worker, batch)["parameters"] for name, worker in workers.items()
        }
        if counts[OURS] != counts[TORCH]:
            sys.exit(f"the networks differ in their numbers of parameters: {counts}")
        return workers

    def step(self) -> str:
        rows = []
        for batch in self.batches:
            workers = self.pair(batch)
            n = self.repeats if batch < LARGE_BATCH else (self.repeats + 1) // 2
            answers = in_turns(workers, "step", n)
            for worker in workers.values():
                worker.close()
            for name, own in answers.items():
                parts = ("forward_s", "backward_s", "optimizer_s")
                row = [str(batch), name, spread(own)]
                row += [spread(own, part) for part in parts]
                row += [f"{median(own, 'cpu_s') * 1e3:,.0f}"]
                keys = ("wall_s", *parts) if name == OURS else ()
                ratios = [f"{median(answers[TORCH], k) / median(own, k):.2f}" for k in keys]
                rows.append([*row, *(ratios or [""] * 4)])
        times = ["step", "forward", "backward", "optimizer"]
        head = ["batch", "program", *(f"{what} ms" for what in times), "CPU ms"]
        head += [f"ratio, {what}" for what in times]
        title = f"### Training step of `{self.preset}`, {FRAMES} frames"
        return f"{title}, {self.threads} threads\n\n{table(head, rows)}"

    def forward(self) -> str:
        workers = self.pair(1)
        path = self.work / f"engine-{self.preset}.onnx"
        # In a process of its own, as the exporter leaves much behind.
        exporter = self.start(TORCH)
        self.init(TORCH, exporter, 1)
        exporter.ask("export", path=str(path))
        exporter.close()
        workers[ONNX] = self.start(ONNX)
        self.init(ONNX, workers[ONNX], 1, path=str(path))
        # One after the other as in sampling: right after a pause, threads wake up slowly.
        answers = in_turns(workers, "forward", self.repeats, lead=1)
        for worker in workers.values():
            worker.close()
        ours_s = median(answers[OURS], "wall_s")
        rows = []
        for name, own in answers.items():
            ratio = f"{median(own, 'wall_s') / ours_s:.2f}"
            rows.append([name, spread(own), f"{median(own, 'cpu_s') * 1e3:,.1f}", ratio])
        title = f"### Forward of `{self.preset}`, batch 1, {FRAMES} frames, {self.threads} threads"
        head = ["program", "wall ms", "CPU ms", "theirs / ours"]
        return f"{title}\n\n{table(head, rows)}"

    def memory(self) -> str:
        rows = []
        cases = {
            TORCH: (TORCH, {}),
            OURS: (OURS, {"checkpoint": False}),
            f"{OURS}, checkpoints": (OURS, {"checkpoint": True}),
        }
        for name, (program, options) in cases.items():
            worker = self.start(program)
            if program == TORCH:
                # Its libraries are there before any network is.
                worker.ask("gemm", m=1, n=1, k=1)
            start_mb = worker.peak_mb()
            made = self.init(program, worker, MEMORY_BATCH, **options)
            answers = [worker.ask("step") for _ in range(MEMORY_STEPS)]
            peak_mb = worker.peak_mb()
            arena = worker.ask("memory")["arena_mb"] if program == OURS else None
            worker.close()
            state_mb = 4 * made["parameters"] * 4 / 1e6
            sizes = [start_mb, peak_mb, peak_mb - state_mb, peak_mb - state_mb - start_mb, arena]
            written = ["" if size is None else f"{size:,.0f}" for size in sizes]
            rows.append([name, *written, spread(answers[1:])])
        head = ["program", "before the network, MB", "peak MB", "beyond the state, MB"]
        head += ["– without the program itself, MB", "of that in the arena, MB", "step ms"]
        title = f"### Memory of training `{self.preset}`, batch {MEMORY_BATCH}, {FRAMES} frames"
        text = f"The state is weights, gradients and two moments, {state_mb:,.0f} MB."
        return f"{title}\n\n{text}\n\n{table(head, rows)}"

    def gemm(self) -> str:
        command = [self.bin, "gemm", "--threads", str(self.threads)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        found = [json.loads(line) for line in done.stdout.splitlines()]
        peer = self.start(TORCH)
        self.init(TORCH, peer, 1, preset="tiny")
        rows = []
        for ours in (line for line in found if "shape" in line):
            m, n, k = (int(size) for size in ours["shape"].split("x"))
            theirs = peer.ask("gemm", m=m, n=n, k=k)["gflops"]
            ratio = f"{ours['gflops'] / theirs:.2f}"
            rows.append([ours["shape"], f"{ours['gflops']:.0f}", f"{theirs:.0f}", ratio])
        peer.close()
        peak = next((line["peak_fma_gflops"] for line in found if "peak_fma_gflops" in line), 0)
        text = f"m × n × k, the fastest of many. Multiplying and adding alone: {peak:.0f} GFLOP/s."
        head = ["shape", f"{OURS}, GFLOP/s", f"{TORCH}, GFLOP/s", "ours / theirs"]
        title = f"### Products of matrices, {self.threads} threads"
        return f"{title}\n\n{text}\n\n{table(head, rows)}"


def machine(bench: Bench, profile: str) -> str:
    return heading(
        "training engine",
        [
            f"engine-bench (profile {profile})",
            first_line(["rustc", "--version"]),
            *[f"{name} {importlib.metadata.version(name)}" for name in PACKAGES],
            f"{bench.repeats} runs of each, taking turns",
        ],
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="the program engine-bench")
    parser.add_argument("--profile", default="not told", help="how it was built, for the record")
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("build/bench"))
    sections = ["step", "forward", "memory", "gemm"]
    parser.add_argument("--only", choices=sections, action="append", default=[])
    parser.add_argument("--preset", help="size of the network (default base)")
    parser.add_argument("--threads", type=int, default=2, help="of every program (default 2)")
    parser.add_argument("--repeats", type=int, help="runs of each program (default 7)")
    parser.add_argument("--batches", help="sizes of the training batch (default 1,8,32)")
    parser.add_argument("--quick", action="store_true", help="small, 2 runs, batches 1 and 8")
    parser.add_argument("--parity", action="store_true", help="compare gradients, and only that")
    arguments = parser.parse_args()
    defaults = ("small", 2, "1,8") if arguments.quick else ("base", 7, "1,8,32")
    for name, value in zip(["preset", "repeats", "batches"], defaults, strict=True):
        if getattr(arguments, name) is None:
            setattr(arguments, name, value)
    arguments.batches = [int(batch) for batch in arguments.batches.split(",")]

    arguments.work.mkdir(parents=True, exist_ok=True)
    bench = Bench(arguments)
    measured = [name for name in sections if name in (arguments.only or sections)]
    found = [lambda: machine(bench, arguments.profile)]
    found += [lambda: parity(bench)] if arguments.parity else [getattr(bench, n) for n in measured]
    parts = []
    for section in found:
        parts.append(section())
        print(parts[-1], flush=True)
    results = arguments.work / "engine.md"
    with results.open("a") as file:
        file.write("\n".join(parts) + "\n")
    print(f"added to {results}")
    if any("MISSED" in part for part in parts):
        sys.exit(1)


if __name__ == "__main__":
    main()
