#!/usr/bin/env python3
"""Runs `motiongen extract` over clips and compares the features with those of librosa.

    make bench-parity                           the golden clips, strict tolerances
    python parity.py --bin target/release --clips FOLDER [--reference FOLDER] [--per-clip]

The reference folder (that of the clips if not given) holds a NAME.npz for every clip;
tests/golden/audio/compare.py says what is compared. Ends with 1 if anything is out of tolerance.
Needs NumPy; librosa is not run.
"""

import argparse
import pathlib
import subprocess
import sys
import tempfile

GOLDEN = pathlib.Path(__file__).resolve().parents[1] / "tests" / "golden" / "audio"
sys.path.insert(0, str(GOLDEN))
import compare  # noqa: E402

NO_CLIPS = {".npz", ".json", ".py", ".md", ".txt"}


def clips(folder: pathlib.Path, reference: pathlib.Path) -> list[pathlib.Path]:
    """Returns the clip of every reference; a reference without a clip is an error."""
    by_name = {
        path.stem: path
        for path in sorted(folder.iterdir())
        if path.is_file() and path.suffix not in NO_CLIPS
    }
    names = sorted(path.stem for path in reference.glob("*.npz"))
    missing = [name for name in names if name not in by_name]
    if missing or not names:
        sys.exit(f"{folder} has no clip for {', '.join(missing) or 'any reference'}")
    return [by_name[name] for name in names]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="folder of the executable")
    parser.add_argument("--clips", type=pathlib.Path, default=GOLDEN)
    parser.add_argument("--reference", type=pathlib.Path, help="(default: the folder of the clips)")
    parser.add_argument("--workers", type=int, default=1)
    compare.add_arguments(parser)
    arguments = parser.parse_args()
    reference = arguments.reference or arguments.clips
    files = clips(arguments.clips, reference)
    motiongen = arguments.bin / "motiongen"
    if not motiongen.is_file():
        sys.exit(
            f"{motiongen} is missing; build it with: make bench-parity, or name its --bin folder"
        )
    with tempfile.TemporaryDirectory() as output:
        flags = ["--output", output, "--workers", str(arguments.workers), "--quiet"]
        command = [motiongen, "extract", "--audio", *files, *flags]
        code = subprocess.run(command, stdin=subprocess.DEVNULL).returncode
        done = compare.compare(reference, pathlib.Path(output), arguments.tol)
    if code != 0:
        done.failures.append(f"motiongen extract ended with {code}; see its message above")
    untuned = [clip["name"] for clip in done.clips if "tuning" not in clip]
    if untuned and arguments.tol != "off":
        done.failures.append(f"no tuning to compare in {len(untuned)} clips: {untuned[:5]}")
    compare.report(done, arguments)


if __name__ == "__main__":
    main()
