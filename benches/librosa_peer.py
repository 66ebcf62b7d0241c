#!/usr/bin/env python3
"""The peer of audio.py: computes the features of files with librosa, in one thread, and times it.

    python librosa_peer.py --warm-up FILE FILE…

Imports librosa and runs it over one short file, so that everything is compiled, then prints `ready`
and waits for a line: so that several can be started at the same moment. Then does the work and
prints wall and CPU seconds of that alone, as JSON. Nothing is written to disk.
"""

import argparse
import json
import os
import pathlib
import sys
import time
import warnings

# Before NumPy and its libraries are loaded.
for name in ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB_MAXIMUM"):
    os.environ[f"{name}_NUM_THREADS"] = "1"

GOLDEN = pathlib.Path(__file__).resolve().parents[1] / "tests" / "golden" / "audio"
sys.path.insert(0, str(GOLDEN))
import reference  # noqa: E402


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--warm-up", type=pathlib.Path, required=True)
    parser.add_argument("files", type=pathlib.Path, nargs="+")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    reference.features(reference.load(arguments.warm_up))
    print("ready", flush=True)
    sys.stdin.readline()
    wall_s, cpu_s, n_frames = time.perf_counter(), time.process_time(), 0
    for path in arguments.files:
        n_frames += reference.features(reference.load(path))["features"].shape[1]
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    print(json.dumps({"wall_s": wall_s, "cpu_s": cpu_s, "n_frames": n_frames}), flush=True)


if __name__ == "__main__":
    main()
