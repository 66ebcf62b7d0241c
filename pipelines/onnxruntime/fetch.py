"""Obtains the library of onnxruntime that motiongen loads, once, with its checksum.

    python3 pipelines/onnxruntime/fetch.py [--into .runtime/onnxruntime]

The library is taken out of the wheel that the Python package index has: pip honours the mirror and the
proxy that this machine is set to, and refuses a wheel whose SHA-256 is not in onnxruntime.lock. The
wheel is always that of CPython 3.12, so that it is the same file whichever Python runs this. Nothing is
installed into any Python.
"""

import argparse
import os
import platform
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

LOCK = Path(__file__).parent / "onnxruntime.lock"

# Python's names of the system and the machine, pip's name of the platform, what the library is called.
PLATFORMS = {
    ("Linux", "x86_64"): ("manylinux_2_28_x86_64", "libonnxruntime.so.{version}"),
    ("Linux", "aarch64"): ("manylinux_2_28_aarch64", "libonnxruntime.so.{version}"),
    ("Darwin", "arm64"): ("macosx_14_0_arm64", "libonnxruntime.{version}.dylib"),
    ("Windows", "AMD64"): ("win_amd64", "onnxruntime.dll"),
}


def fail(sentence):
    print(f"onnxruntime: {sentence}", file=sys.stderr)
    raise SystemExit(1)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--into", type=Path, default=Path(".runtime/onnxruntime"))
    into = parser.parse_args().into

    version = re.search(r"^onnxruntime==([\d.]+)", LOCK.read_text(), re.MULTILINE)[1]
    machine = (platform.system(), platform.machine())
    if machine not in PLATFORMS:
        known = ", ".join(" ".join(pair) for pair in PLATFORMS)
        fail(
            f"there is no build for {' '.join(machine)} (there are: {known}); build onnxruntime "
            "yourself and name it by ORT_DYLIB_PATH, or use --engine eager"
        )
    tag, name = PLATFORMS[machine]
    name = name.format(version=version)
    library = into / version / name
    if library.exists():
        return

    library.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent, prefix=".partial-") as folder:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"]
        command += ["--require-hashes", "--no-deps", "--only-binary=:all:"]
        command += ["--platform", tag, "--python-version", "3.12"]
        command += ["--implementation", "cp", "--abi", "cp312"]
        command += ["--dest", folder, "--requirement", str(LOCK)]
        done = subprocess.run(command, text=True, stderr=subprocess.PIPE)
        wheels = list(Path(folder).glob("*.whl"))
        if done.returncode != 0 or len(wheels) != 1:
            said = " ".join(done.stderr.split())[-400:]
            fail(f"version {version} could not be downloaded by pip: {said}")
        with zipfile.ZipFile(wheels[0]) as wheel:
            partial = Path(folder) / name
            partial.write_bytes(wheel.read(f"onnxruntime/capi/{name}"))
        # A rename: the library is there whole or not at all.
        os.replace(partial, library)
    print(f"onnxruntime {version} is in {library}")


if __name__ == "__main__":
    main()
