#!/usr/bin/env python3
"""Measures inference beside PyTorch in one run, and prints Markdown.

    python benches/inference.py --bin target/release/examples/inference-bench
    python benches/inference.py --bin … --quick        the small network, to see that it works

  sample    one motion of 4 s: steps of DDIM and DPM-Solver++, both engines and PyTorch, eager
  forward   one prediction, both engines, both forms of the file, and a batch of two (guidance)
  bulk      many motions: two workers of one thread beside one worker
  load      how long a session takes, plain and from the optimised copy
  parity    Python's onnx checker and onnxruntime, on the same files

Each program is a process of its own that is asked in lines of JSON; they take turns, and one turn of each
is not counted. Times are medians with their range. The weights are random, which changes no time. The
Python that runs this needs benches/requirements-engine.txt.
"""

import argparse
import importlib.metadata
import pathlib
import statistics
import subprocess
import sys
import tempfile

from bench import HERE, first_line, table, verdict
from engine import Worker, spread
from machine import heading

EAGER, ONNX, TORCH = "motiongen, eager", "motiongen, onnxruntime", "PyTorch, eager"
# Of the reference, on its own machine: 20, 10 and 5 steps for 4 s of motion.
REFERENCE_S = {20: 18.5, 10: 9.8, 5: 5.2}


def median(answers: list[dict]) -> float:
    return statistics.median(answer["wall_s"] for answer in answers)


class Bench:
    def __init__(self, arguments: argparse.Namespace, folder: pathlib.Path) -> None:
        self.bin, self.preset = arguments.bin.resolve(), arguments.preset
        self.threads, self.repeats = arguments.threads, arguments.repeats
        self.folder = folder
        if not self.bin.is_file():
            sys.exit(f"{self.bin} is missing; build it, or name it with --bin")
        command = [self.bin, "export", "--preset", self.preset, "--output", folder]
        subprocess.run(command, check=True)

    def ours(self, engine: str, workers: int = 1, threads: int | None = None, **more) -> tuple:
        worker = Worker([self.bin, "serve"], threads or self.threads)
        request = {"engine": engine, "folder": str(self.folder), "preset": self.preset}
        request |= {"workers": workers, "threads": threads or self.threads, **more}
        return worker, worker.ask("init", **request)

    def torch(self) -> Worker:
        worker = Worker([sys.executable, HERE / "inference_peer.py"], self.threads)
        worker.ask("init", preset=self.preset, threads=self.threads)
        return worker

    def sample(self) -> str:
        workers = {
            EAGER: self.ours("eager")[0],
            ONNX: self.ours("onnx", optimized=True)[0],
            TORCH: self.torch(),
        }
        rows = []
        for sampler, steps in [("ddim", 20), ("ddim", 10), ("ddim", 5), ("dpm", 10)]:
            answers = {name: [] for name in workers}
            for i in range(1 + self.repeats):
                for name, worker in workers.items():
                    answer = worker.ask("sample", sampler=sampler, steps=steps)
                    if i:
                        answers[name].append(answer)
            best = min(median(answers[EAGER]), median(answers[ONNX]))
            ratio = median(answers[TORCH]) / best
            reference = REFERENCE_S.get(steps) if sampler == "ddim" else None
            title = {"ddim": "DDIM", "dpm": "DPM-Solver++"}[sampler]
            rows.append([f"{steps} steps of {title}", *(spread(own) for own in answers.values())])
            rows[-1] += [f"{ratio:.2f}", f"{reference:.1f} s" if reference else ""]
        for worker in workers.values():
            worker.close()
        head = ["one motion of 4 s", *(f"{name}, ms" for name in workers)]
        head += ["PyTorch / our best", "the reference's"]
        return f"### Sampling with `{self.preset}`, {self.threads} threads\n\n{table(head, rows)}"

    def forward(self) -> str:
        workers = {
            EAGER: self.ours("eager")[0],
            f"{ONNX}, image, optimised copy": self.ours("onnx", optimized=True)[0],
            f"{ONNX}, image": self.ours("onnx")[0],
            f"{ONNX}, line": self.ours("onnx", file="unet-line.onnx")[0],
            TORCH: self.torch(),
        }
        rows = []
        answers = {batch: {name: [] for name in workers} for batch in (1, 2)}
        for i in range(2 + 2 * self.repeats):
            for batch, own in answers.items():
                for name, worker in workers.items():
                    answer = worker.ask("predict", batch=batch)
                    if i > 1:
                        own[name].append(answer)
        for name, worker in workers.items():
            worker.close()
            one, two = (median(answers[batch][name]) for batch in (1, 2))
            row = [name, spread(answers[1][name]), spread(answers[2][name])]
            rows.append([*row, f"{two / one:.2f}"])
        eager = median(answers[1][EAGER])
        onnx = min(median(own) for name, own in answers[1].items() if name.startswith(ONNX))
        head = ["program", "batch of one, ms", "batch of two, ms", "two / one"]
        title = f"### One prediction of `{self.preset}`, 120 frames, {self.threads} threads"
        text = f"Eager / the fastest of onnxruntime: {verdict(eager / onnx, 1.5)}."
        return f"{title}\n\n{table(head, rows)}\n{text}\n"

    def bulk(self) -> str:
        rows = []
        for name, engine in [(EAGER, "eager"), (ONNX, "onnx")]:
            plans = {"one worker": 1, f"{self.threads} workers": self.threads}
            workers = {
                plan: self.ours(engine, workers=n, threads=1, optimized=True)[0]
                for plan, n in plans.items()
            }
            n = 4 if self.preset == "base" else 16
            answers = {plan: [] for plan in plans}
            for i in range(1 + self.repeats):
                for plan, worker in workers.items():
                    answer = worker.ask("bulk", samples=n, steps=10, sampler="dpm")
                    if i:
                        answers[plan].append(answer)
            for worker in workers.values():
                worker.close()
            one, many = (n / median(own) for own in answers.values())
            memory = [f"{max(a['peak_mb'] for a in own):,.0f}" for own in answers.values()]
            row = [name, f"{one:.2f}", f"{many:.2f}", f"{many / one:.2f}", " / ".join(memory)]
            rows.append(row)
        head = ["engine", "one worker, motions/s", f"{self.threads} workers, motions/s", "gain"]
        head += ["peak MB"]
        title = f"### Bulk with `{self.preset}`: 10 steps of DPM-Solver++, one thread a worker"
        return f"{title}\n\n{table(head, rows)}"

    def load(self) -> str:
        rows = []
        kinds = {
            "eager": ("eager", {}),
            "onnxruntime, plain": ("onnx", {}),
            "onnxruntime, plain, line": ("onnx", {"file": "unet-line.onnx"}),
            "onnxruntime, optimised copy": ("onnx", {"optimized": True}),
        }
        for name, (engine, more) in kinds.items():
            times, memory = [], []
            for _ in range(self.repeats):
                worker, made = self.ours(engine, **more)
                worker.close()
                times.append({"wall_s": made["load_s"]})
                memory.append(made["rss_mb"])
            rows.append([name, spread(times), f"{statistics.median(memory):,.0f}"])
        head = ["engine", "ready after, ms", "resident MB"]
        return f"### Start-up with `{self.preset}`\n\n{table(head, rows)}"

    def parity(self) -> str:
        worker, _ = self.ours("eager")
        worker.ask("predict", write=str(self.folder))
        worker.close()
        peer = Worker([sys.executable, HERE / "inference_peer.py"], self.threads)
        found = peer.ask("check", folder=str(self.folder), threads=self.threads)
        peer.close()
        text = (
            "Python's onnx checker passes all files. Its onnxruntime against the eager interpreter, one "
            f"prediction: {found['max_abs']:.1e} at most (spread {found['spread']:.2f}), allowed 1e-4: "
            f"{'met' if found['max_abs'] <= 1e-4 else 'MISSED'}."
        )
        return f"### Parity of `{self.preset}`\n\n{text}\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="inference-bench")
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("build/bench"))
    sections = ["sample", "forward", "bulk", "load", "parity"]
    parser.add_argument("--only", choices=sections, action="append", default=[])
    parser.add_argument("--preset", help="size of the network (default base)")
    parser.add_argument("--threads", type=int, default=2, help="of every program (default 2)")
    parser.add_argument("--repeats", type=int, help="runs of each program (default 5)")
    parser.add_argument("--quick", action="store_true", help="small, 2 runs")
    arguments = parser.parse_args()
    for name, value in zip(["preset", "repeats"], ("small", 2) if arguments.quick else ("base", 5)):
        if getattr(arguments, name) is None:
            setattr(arguments, name, value)
    arguments.work.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=arguments.work) as folder:
        bench = Bench(arguments, pathlib.Path(folder))
        facts = [f"{name} {importlib.metadata.version(name)}" for name in ("torch", "onnxruntime")]
        facts += [first_line(["rustc", "--version"]), f"{arguments.repeats} runs, taking turns"]
        parts = [heading("inference", facts)]
        print(parts[-1], flush=True)
        for section in arguments.only or sections:
            parts.append(getattr(bench, section)())
            print(parts[-1], flush=True)
    with (arguments.work / "inference.md").open("a") as file:
        file.write("\n".join(parts) + "\n")
    if any("MISSED" in part for part in parts):
        sys.exit(1)


if __name__ == "__main__":
    main()
