#!/usr/bin/env python3
"""Trains a small run twice on the phrases of tests/data: by one process, and by two that mpirun started and of which one is
killed on the way; says whether both runs ended with the same bits.

    pipelines/mpi/demo.py --bin target/debug
    pipelines/mpi/demo.py --bin target/debug --store build/demo/store      phrases of a store that is there already
    … --kills 5                                                            kills at random moments, of any rank

A store is copied, not written to.
"""

import argparse
import os
import pathlib
import random
import shutil
import signal
import subprocess
import tempfile
import time

HERE = pathlib.Path(__file__).resolve().parent
SETTINGS = ["--preset", "tiny", "--side-by-side", "2", "--batch-size", "8", "--steps", "60", "--decoder-steps", "20",
            "--save-every-steps", "5", "--validate-every", "2", "--quiet"]


def ranks_of(motiongen, store):
    """Process numbers of those that train in a store."""
    found = []
    for entry in pathlib.Path("/proc").iterdir():
        try:
            words = (entry / "cmdline").read_bytes().split(b"\0") if entry.name.isdigit() else []
        except OSError:
            continue
        if words[0:1] == [str(motiongen).encode()] and b"train" in words and str(store).encode() in words:
            found.append(int(entry.name))
    return sorted(found)


def newest(store, network):
    """The newest checkpoint of a network: its name, and the bits of its numbers (the header has times)."""
    path = sorted((store / "runs/mpi" / network).glob("step-*.safetensors"))[-1]
    content = path.read_bytes()
    return path.name, content[8 + int.from_bytes(content[:8], "little"):]


def make_store(motiongen, store, like):
    """Puts phrases into a store: those of another, without what was trained there, or constructed ones of tests/data."""
    if like:
        shutil.copytree(like, store, ignore=shutil.ignore_patterns("runs", "models"))
        return
    for stage in (["ingest", "--source", HERE.parent.parent / "tests/data/music"], ["extract"], ["library"]):
        subprocess.run([motiongen, *stage, "--store", store, "--quiet"], check=True, stdout=subprocess.DEVNULL)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bin", type=pathlib.Path, default=pathlib.Path("target/debug"))
    parser.add_argument("--store", type=pathlib.Path, help="store of phrases to train on; made from tests/data otherwise")
    parser.add_argument("--kills", type=int, default=1, help="how often a rank is killed")
    parser.add_argument("--seed", type=int, default=0, help="of which rank is killed, and when")
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    motiongen = (arguments.bin / "motiongen").resolve()
    launcher = [HERE / "mpirun.sh", "--oversubscribe", "--bind-to", "none", "-n", "2"]
    launcher[1:1] = ["--allow-run-as-root"] if os.geteuid() == 0 else []
    with tempfile.TemporaryDirectory(prefix="motiongen-mpi-") as folder:
        stores = {name: pathlib.Path(folder) / name for name in ("one", "two")}
        started = time.monotonic()
        make_store(motiongen, stores["one"], arguments.store)
        shutil.copytree(stores["one"], stores["two"])
        print(f"phrases: {time.monotonic() - started:.0f} s", flush=True)

        def command(store, threads):
            return [motiongen, "train", "--store", store, "--run", "mpi", "--threads", str(threads), *SETTINGS]

        started = time.monotonic()
        subprocess.run(command(stores["one"], 2), check=True, stdout=subprocess.DEVNULL)
        print(f"one process: {time.monotonic() - started:.0f} s", flush=True)

        started = time.monotonic()
        checkpoints = stores["two"] / "runs/mpi/diffusion"
        for _ in range(arguments.kills):
            known = set(checkpoints.glob("step-*"))
            process = subprocess.Popen([*launcher, *command(stores["two"], 1)], stdout=subprocess.DEVNULL)
            try:
                # Each start writes at least one new checkpoint before the kill, so that the run gets on whatever --kills is.
                while process.poll() is None and not set(checkpoints.glob("step-*")) - known:
                    time.sleep(0.01)
                # Up to about as long as five steps take.
                time.sleep(chance.uniform(0, 1))
                ranks = ranks_of(motiongen, stores["two"])
                if len(ranks) != 2:
                    raise SystemExit(f"{len(ranks)} ranks are at work where 2 should be")
                rank = chance.randrange(2)
                os.kill(ranks[rank], signal.SIGKILL)
                code = process.wait()
            finally:
                if process.poll() is None:
                    process.terminate()
                    process.wait()
            after = max(path.name for path in checkpoints.glob("step-*"))
            print(f"two ranks, one killed after {after}, {time.monotonic() - started:.0f} s: exit code {code}", flush=True)
            if code != 75:
                raise SystemExit("a job of which a rank was killed should end with 75")
        subprocess.run([*launcher, *command(stores["two"], 1)], check=True, stdout=subprocess.DEVNULL)
        print(f"the same command again: done after {time.monotonic() - started:.0f} s", flush=True)
        for network in ("diffusion", "decoder"):
            if newest(stores["one"], network) != newest(stores["two"], network):
                raise SystemExit(f"the {network} of two ranks has other bits than that of one process")
    print("both runs have the same bits")


if __name__ == "__main__":
    main()
