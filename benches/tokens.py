#!/usr/bin/env python3
"""Measures motion by tokens beside PyTorch in one run, and prints Markdown.

    python benches/tokens.py --bin target/release/examples/tokens-bench
    python benches/tokens.py --bin … --presets tiny,small      without the largest

  plan     the tokens of 4 s of motion: 10 iterations of the masked planner, 30 tokens of the autoregressive one
  decode   4 s of motion of 30 tokens: the signal, and 27 steps of the diffusion decoder

Each program is a process of its own that is asked in lines of JSON; they take turns, and one turn of each is not
counted. Times are medians with their range. The weights are random, which changes no time. The Python that runs this
needs benches/requirements-engine.txt.
"""

import argparse
import importlib.metadata
import pathlib
import statistics
import sys
import tempfile

from bench import HERE, first_line, table
from engine import Worker, spread
from machine import heading

EAGER, ONNX, TORCH = "motiongen, eager", "motiongen, onnxruntime", "PyTorch, eager"
KINDS = ("masked", "autoregressive")


def median(answers: list[dict]) -> float:
    return statistics.median(answer["wall_s"] for answer in answers)


class Bench:
    def __init__(self, arguments: argparse.Namespace, folder: pathlib.Path) -> None:
        self.bin, self.threads, self.repeats = (
            arguments.bin.resolve(),
            arguments.threads,
            arguments.repeats,
        )
        self.folder, self.engines = folder, arguments.engines.split(",")
        if not self.bin.is_file():
            sys.exit(f"{self.bin} is missing; build it, or name it with --bin")

    def workers(self, preset: str, kind: str) -> dict[str, Worker]:
        folder = self.folder / f"{preset}-{kind}"
        found = {}
        for name, engine in [(EAGER, "eager"), (ONNX, "onnx"), (TORCH, "torch")]:
            if engine not in self.engines:
                continue
            command = [self.bin, "serve"]
            if engine == "torch":
                command = [sys.executable, HERE / "tokens_peer.py"]
            found[name] = Worker(command, self.threads)
            request = {"preset": preset, "kind": kind, "threads": self.threads}
            if engine != "torch":
                request |= {"engine": engine, "folder": str(folder)}
            found[name].ask("init", **request)
        return found

    def times(self, preset: str) -> str:
        rows, ratios = [], []
        for kind in KINDS:
            workers = self.workers(preset, kind)
            commands = [("plan, one answer", "plan", {"answers": 1})]
            commands += [("plan, guided", "plan", {"answers": 2})]
            if kind == KINDS[0]:
                commands.append(("decode, 27 steps", "decode", {}))
            for title, command, more in commands:
                answers = {name: [] for name in workers}
                for i in range(1 + self.repeats):
                    for name, worker in workers.items():
                        answer = worker.ask(command, **more)
                        if i:
                            answers[name].append(answer)
                own = [median(answers[name]) for name in (EAGER, ONNX) if name in answers]
                row = [title if command == "decode" else f"{kind} {title}"]
                row += [spread(found) for found in answers.values()]
                if TORCH in answers:
                    ratios.append(median(answers[TORCH]) / min(own))
                    row.append(f"{ratios[-1]:.2f}")
                rows.append(row)
            for worker in workers.values():
                worker.close()
        head = ["4 s of motion", *(f"{name}, ms" for name in workers)]
        head += ["PyTorch / our best"] if TORCH in workers else []
        title = f"### `{preset}`, {self.threads} threads"
        least = min(ratios, default=0.0)
        text = f"PyTorch / our best: at least {least:.2f}, target of `base` ≥ 2: "
        text += "met" if least >= 2 else "MISSED"
        found = f"{title}\n\n{table(head, rows)}"
        return f"{found}\n{text}.\n" if preset == "base" and ratios else found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="tokens-bench")
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("build/bench"))
    parser.add_argument("--presets", default="tiny,small,base")
    parser.add_argument("--engines", default="eager,onnx,torch")
    parser.add_argument("--threads", type=int, default=2, help="of every program (default 2)")
    parser.add_argument("--repeats", type=int, default=5, help="runs of each program (default 5)")
    arguments = parser.parse_args()
    arguments.work.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=arguments.work) as folder:
        bench = Bench(arguments, pathlib.Path(folder))
        facts = [f"torch {importlib.metadata.version('torch')}"]
        facts += [first_line(["rustc", "--version"]), f"{arguments.repeats} runs, taking turns"]
        parts = [heading("motion by tokens", facts)]
        print(parts[-1], flush=True)
        for preset in arguments.presets.split(","):
            parts.append(bench.times(preset))
            print(parts[-1], flush=True)
    with (arguments.work / "tokens.md").open("a") as file:
        file.write("\n".join(parts) + "\n")
    if any("MISSED" in part for part in parts):
        sys.exit(1)


if __name__ == "__main__":
    main()
