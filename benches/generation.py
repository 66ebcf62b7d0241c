#!/usr/bin/env python3
"""Measures generation: a whole song, bulk on one thread and on two, seams, memory.

    python benches/generation.py --bin target/release/motiongen
    python benches/generation.py --bin … --model STORE/models/demo     seams of a trained model too

Makes a store with the project's songs and, for each preset, a model of hardly trained weights: what a
motion costs does not depend on them. Needs NumPy.
"""

import argparse
import math
import pathlib
import shutil
import subprocess
import sys
import wave

import numpy
import polars

from bench import table
from machine import heading

ROOT = pathlib.Path(__file__).resolve().parent.parent
OUT = ROOT / "build" / "bench-generation"
FPS, WINDOW, OVERLAP = 30, 120, 30
SONG_S = 180
N_PHRASES = 200


# A child begins with the memory of its parent, which counts as its own: a small parent in between.
MEASURE = """
import os, subprocess, sys, time
started = time.perf_counter()
child = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, usage = os.wait4(child.pid, 0)
print(status, time.perf_counter() - started, usage.ru_maxrss * 1024 / 1e6)
"""


def run(command: list) -> tuple[float, float]:
    """Runs a command; returns seconds and the peak of its memory in MB."""
    words = [sys.executable, "-c", MEASURE, *map(str, command)]
    status, wall_s, peak_mb = subprocess.run(words, capture_output=True, text=True).stdout.split()
    if status != "0":
        sys.exit(f"{' '.join(map(str, command))} ended with {status}")
    return float(wall_s), float(peak_mb)


def make_song(path: pathlib.Path) -> None:
    """Three minutes of a kick, a hat and a chord at 124 beats a minute."""
    rate, beat_s = 44100, 60 / 124
    t = numpy.arange(SONG_S * rate) / rate
    in_beat = t % beat_s
    kick = numpy.sin(2 * numpy.pi * 55 * in_beat) * numpy.exp(-in_beat * 18)
    hat = numpy.random.default_rng(1).normal(size=t.size) * numpy.exp(-((t + beat_s / 2) % beat_s) * 60)
    root = 220 * 2 ** (numpy.floor(t / (4 * beat_s)) % 4 * 3 / 12)
    chord = sum(numpy.sin(2 * numpy.pi * root * step * t) for step in (1, 1.25, 1.5)) / 3
    samples = 0.5 * kick + 0.1 * hat + 0.2 * chord
    with wave.open(str(path), "wb") as out:
        out.setnchannels(1)
        out.setsampwidth(2)
        out.setframerate(rate)
        out.writeframes((numpy.clip(samples, -1, 1) * 32767).astype("<i2").tobytes())


def prepare(motiongen: pathlib.Path, presets: list[str]) -> pathlib.Path:
    store = OUT / "store"
    if not (store / "models" / presets[-1]).exists():
        shutil.rmtree(OUT, ignore_errors=True)
        OUT.mkdir(parents=True)
        for source in ("phrases", "music"):
            run([motiongen, "ingest", "--source", ROOT / "tests/data" / source, "--store", store,
                 "--limits", "wide", "--quiet"])
        run([motiongen, "extract", "--store", store, "--quiet"])
        run([motiongen, "library", "--store", store, "--takes", 2, "--quiet"])
        for preset in presets:
            run([motiongen, "train", "--store", store, "--run", preset, "--preset", preset, "--steps", 1,
                 "--decoder-steps", 1, "--batch-size", 2, "--quiet"])
            run([motiongen, "export", "--store", store, "--run", preset, "--model", preset, "--quiet"])
        make_song(OUT / "song.wav")
    return store


def starts(n_frames: int) -> list[int]:
    """Where windows begin: as few as share at least the overlap, evenly spaced."""
    last = n_frames - WINDOW
    steps = math.ceil(last / (WINDOW - OVERLAP))
    return [i * last // steps for i in range(steps + 1)]


def seams(motion: numpy.ndarray) -> list[list[str]]:
    """Changes from frame to frame where windows meet, beside the 95th percentile of all others."""
    speed = numpy.linalg.norm(motion[:, 3:6], axis=1)
    acceleration = numpy.linalg.norm(motion[:, 6:9], axis=1)
    turn = numpy.linalg.norm(motion[:, 13:16], axis=1)
    begins = starts(len(motion))
    at = sorted({frame for i in range(1, len(begins))
                 for frame in (begins[i] - 1, begins[i], begins[i - 1] + WINDOW - 1)})
    at = [frame for frame in at if frame < len(motion) - 1]
    rows = []
    for name, x in (("speed, m/s", speed), ("acceleration, m/s²", acceleration), ("turn, rad/s", turn)):
        jumps = numpy.abs(numpy.diff(x))
        inside = numpy.delete(jumps, at)
        rows.append([name, f"{jumps[at].mean():.4f}", f"{numpy.percentile(jumps[at], 95):.4f}",
                     f"{inside.mean():.4f}", f"{numpy.percentile(inside, 95):.4f}"])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="motiongen")
    parser.add_argument("--presets", nargs="+", default=["small", "base"])
    parser.add_argument("--phrases", type=int, default=N_PHRASES, help="of the bulk job")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--model", type=pathlib.Path, help="folder of a trained model, for its seams")
    arguments = parser.parse_args()
    motiongen = arguments.bin.resolve()
    store = prepare(motiongen, arguments.presets)
    print(heading("generation", []))
    rows = []
    for preset in arguments.presets:
        weights_mb = sum(f.stat().st_size for f in (store / "models" / preset).glob("*")) / 1e6
        for engine in ("eager", "onnx"):
            command = [motiongen, "generate", "--model", store / "models" / preset, "--audio",
                       OUT / "song.wav", "--output", OUT / "out", "--format", "npy", "--engine", engine,
                       "--force", "--quiet"]
            wall_s, peak_mb = min(run(command) for _ in range(arguments.repeats))
            rows.append([preset, engine, f"{wall_s:.1f}", f"{wall_s / SONG_S:.3f}", f"{peak_mb:,.0f}",
                         f"{2 * weights_mb + 300:,.0f}"])
    print(f"### A song of {SONG_S} s, features included, 10 steps of DPM-Solver++, guidance\n")
    print(table(["model", "engine", "s", "real-time factor", "peak MB", "allowed MB"], rows))
    rows = []
    ids = phrase_ids(store)[: arguments.phrases]
    for preset in arguments.presets:
        for engine in ("eager", "onnx"):
            seconds = []
            for threads in (1, 2):
                command = [motiongen, "generate", "--store", store, "--model", preset, "--engine", engine,
                           "--threads", threads, "--run", f"{preset}-{engine}-{threads}", "--force",
                           "--quiet", "--tracks", "constructed", "--phrase", *ids]
                seconds.append(min(run(command)[0] for _ in range(arguments.repeats)))
            rows.append([preset, engine, *[f"{s:.1f}" for s in seconds], f"{seconds[0] / seconds[1]:.2f}"])
    print(f"\n### {len(ids)} phrases of 4 s into tables\n")
    print(table(["model", "engine", "one thread, s", "two threads, s", "gain"], rows))
    if arguments.model:
        run([motiongen, "generate", "--model", arguments.model, "--audio", OUT / "song.wav", "--output",
             OUT / "seams", "--format", "npy", "--force", "--quiet"])
        motion = numpy.load(OUT / "seams" / "song.npy")
        print("\n### Seams of a trained model: changes from one frame to the next\n")
        print(table(["", "at seams, mean", "at seams, 95 %", "elsewhere, mean", "elsewhere, 95 %"], seams(motion)))


def phrase_ids(store: pathlib.Path) -> list[str]:
    phrases = polars.read_parquet(store / "phrases" / "*.parquet")
    constructed = phrases.filter(polars.col("motion_format") == "constructed", polars.col("n_frames") == WINDOW)
    return sorted(constructed["phrase_id"])[:N_PHRASES]


if __name__ == "__main__":
    main()
