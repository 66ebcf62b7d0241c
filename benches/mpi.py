#!/usr/bin/env python3
"""Steps of `motiongen train` by 2 ranks of 1 thread against 1 rank of 2 threads: time of a step, and memory of a rank.

    benches/mpi.py --motiongen target/debug/motiongen --store build/demo/store --preset base --steps 12

The store is copied; runs go into the copy. Both train with the same parts (--side-by-side 2), so they end with the same bits,
which is checked. Times are medians over the steps behind the first three, from the table of training, as is the memory of the first
rank behind each of these steps. The second only waits behind the last step, so that its memory is the median of the greater
half of VmRSS in /proc. "At most" is VmHWM of the whole run, validation and checkpoints included.
"""

import argparse
import os
import pathlib
import shutil
import statistics
import subprocess
import tempfile
import time

HERE = pathlib.Path(__file__).resolve().parent.parent


def ranks_of(motiongen, store):
    """Processes of motiongen that train in a store: rank → (VmRSS, VmHWM) in bytes."""
    found = {}
    for entry in pathlib.Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0")
            if words[0] != str(motiongen).encode() or str(store).encode() not in words:
                continue
            environment = (entry / "environ").read_bytes().split(b"\0")
            lines = (entry / "status").read_text().splitlines()
        except OSError:
            continue
        sizes = {line.split(":")[0]: line.split()[1] for line in lines if line.startswith("Vm")}
        if "VmRSS" in sizes:
            # Open MPI says it so; a process by itself is the first.
            rank = next((line.split(b"=")[1] for line in environment if line.startswith(b"OMPI_COMM_WORLD_RANK=")), b"0")
            found[int(rank)] = (int(sizes["VmRSS"]) * 1024, int(sizes["VmHWM"]) * 1024)
    return found


def run(motiongen, command, store):
    """Runs a training; returns its wall time and the memory of its ranks: [(median VmRSS, VmHWM)]."""
    started = time.monotonic()
    process = subprocess.Popen(command)
    seen = {}
    while process.poll() is None:
        for rank, sizes in ranks_of(motiongen, store).items():
            seen.setdefault(rank, []).append(sizes)
        time.sleep(0.25)
    if process.returncode != 0:
        raise SystemExit(f"{' '.join(map(str, command))} ended with {process.returncode}")
    # The greater half: while steps are taken, not while phrases are read.
    def memory(sizes):
        resident = sorted(rss for rss, _ in sizes)
        return statistics.median(resident[len(resident) // 2:]), max(peak for _, peak in sizes)
    return time.monotonic() - started, [memory(seen[rank]) for rank in sorted(seen)]


def steps(motiongen, store, name, batch_size):
    """Each step but the first three: (seconds, resident bytes of the first rank)."""
    sql = ("SELECT samples_per_s, rss_bytes FROM training_log "
           f"WHERE run = '{name}' AND stage = 'diffusion' AND kind = 'step' ORDER BY step")
    told = subprocess.run([motiongen, "query", "--store", store, sql, "--format", "csv"], check=True,
                          capture_output=True, text=True).stdout.split()
    rows = [line.split(",") for line in told[1:]]
    return [(batch_size / float(rate), int(rss)) for rate, rss in rows][3:]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motiongen", type=pathlib.Path, default=HERE / "target/debug/motiongen")
    parser.add_argument("--store", type=pathlib.Path, default=HERE / "build/demo/store")
    parser.add_argument("--preset", default="base")
    parser.add_argument("--batch-size", type=int, default=32)
    parser.add_argument("--accumulate", type=int, default=1)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--repeat", type=int, default=1, help="pairs of runs, by turns")
    arguments = parser.parse_args()
    motiongen = arguments.motiongen.resolve()
    with tempfile.TemporaryDirectory() as folder:
        store = pathlib.Path(folder) / "store"
        shutil.copytree(arguments.store, store, ignore=shutil.ignore_patterns("runs", "models"))
        usual = ["train", "--store", store, "--preset", arguments.preset, "--side-by-side", "2", "--accumulate",
                 arguments.accumulate, "--batch-size", arguments.batch_size, "--steps", arguments.steps, "--decoder-steps", 1,
                 "--validate-every", 0, "--quiet"]
        launcher = ["mpirun", "--oversubscribe", "--bind-to", "none"]
        launcher += ["--allow-run-as-root"] if os.geteuid() == 0 else []
        weights = {}
        for turn in range(arguments.repeat):
            for what, start, threads in [("1 rank of 2 threads", [], 2), ("2 ranks of 1 thread", [*launcher, "-n", "2"], 1)]:
                name = f"{what[0]}-{turn}"
                command = [*start, motiongen, *usual, "--run", name, "--threads", threads]
                wall_s, memory = run(motiongen, list(map(str, command)), store)
                taken = steps(motiongen, store, name, arguments.batch_size)
                times = [seconds for seconds, _ in taken]
                memory[0] = statistics.median(rss for _, rss in taken), memory[0][1]
                told = ", ".join(f"{rss / 1e6:.0f} MB (at most {peak / 1e6:.0f})" for rss, peak in memory)
                print(f"{what}: step {statistics.median(times):.3f} s (of {len(times)}, {min(times):.3f} to {max(times):.3f}), "
                      f"memory {told}, whole run {wall_s:.0f} s", flush=True)
                newest = sorted((store / "runs" / name / "diffusion").glob("step-*"))[-1].read_bytes()
                header = int.from_bytes(newest[:8], "little")
                weights.setdefault("bits", newest[8 + header:])
                if newest[8 + header:] != weights["bits"]:
                    raise SystemExit(f"{what}: the checkpoint has other bits than that of one rank")
        print("all checkpoints have the same bits")


if __name__ == "__main__":
    main()
