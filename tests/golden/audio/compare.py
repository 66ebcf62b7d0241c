#!/usr/bin/env python3
"""Compares audio features with those of librosa, block by block.

    python3 compare.py REFERENCE CANDIDATE [--tol strict|default|off] [--per-clip] [--json FILE]

Both are folders of NAME.npz files with `features` [163, T]; make.py says what else the reference
holds. Where the candidate has tempo, beat_times or tuning too, they are compared as well: tempo
must be equal to 0.001 bpm, every beat must be within 70 ms of one of the other's, and tunings must
be the same. A manifest.json in the reference folder may exempt rows of a clip (undefined_rows) and
frames of its chroma (undefined_chroma_frames).

Prints the errors of every block over all frames of all clips; ends with 1 if a tolerance is broken.
"""

import argparse
import json
import pathlib
import sys

import numpy as np

N_FEATURES = 163
BLOCKS = {
    "mel": (0, 128),
    "chroma": (128, 140),
    "mfcc": (140, 160),
    "rms": (160, 161),
    "spectral_centroid": (161, 162),
    "onset_strength": (162, 163),
}
# The largest and the mean absolute error that a block may have. All values are of the order of 1.
TOLERANCES = {
    # About four times what an independent double-precision implementation reaches.
    "strict": {
        "mel": (1e-4, 2e-6),
        "chroma": (1e-4, 2e-6),
        "mfcc": (4e-3, 1e-4),
        "rms": (2e-5, 5e-7),
        "spectral_centroid": (1e-3, 2e-5),
        "onset_strength": (2e-4, 5e-6),
    },
    # What a multirate constant-Q transform and an ordinary resampler may need.
    "default": {
        "mel": (1e-3, 2e-5),
        "chroma": (5e-3, 5e-4),
        "mfcc": (2e-2, 1e-3),
        "rms": (1e-4, 1e-5),
        "spectral_centroid": (2e-3, 1e-4),
        "onset_strength": (2e-3, 1e-4),
    },
}
TEMPO_TOLERANCE_BPM = 1e-3
BEAT_WINDOW_S = 0.07
# A tuning is a multiple of 0.01, in single or double precision.
TUNING_TOLERANCE = 1e-6


def load(folder: pathlib.Path) -> dict[str, dict[str, np.ndarray]]:
    """Returns the arrays that are compared, by name of the clip."""
    found = {}
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as archive:
            wanted = ("features", "tempo", "beat_times", "tuning")
            arrays = {key: archive[key].astype(np.float64) for key in wanted if key in archive}
        if "features" not in arrays:
            sys.exit(f"{path} has no `features`; write [163, T] under that name")
        found[path.stem] = arrays
    return found


def manifest_of(folder: pathlib.Path) -> dict[str, dict]:
    """Returns what the manifest says of each clip; nothing if there is none."""
    manifest = folder / "manifest.json"
    if not manifest.exists():
        return {}
    return {clip["name"]: clip for clip in json.loads(manifest.read_text())["clips"]}


def is_defined(shape: tuple[int, int], clip: dict) -> np.ndarray:
    mask = np.ones(shape, dtype=bool)
    mask[clip.get("undefined_rows", [])] = False
    mask[slice(*BLOCKS["chroma"]), clip.get("undefined_chroma_frames", [])] = False
    return mask


def pearson(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    norm = np.sqrt((a * a).sum() * (b * b).sum())
    return float((a * b).sum() / norm) if norm > 0 else float(np.allclose(a, b))


def beat_f1(reference: np.ndarray, candidate: np.ndarray) -> float:
    """Returns the F-measure of beats matched one to one within the window."""
    if len(reference) + len(candidate) == 0:
        return 1.0
    free, n_hits = set(range(len(candidate))), 0
    for time_s in reference:
        near = [(abs(candidate[i] - time_s), i) for i in free]
        near = [item for item in near if item[0] <= BEAT_WINDOW_S]
        if near:
            free.remove(min(near)[1])
            n_hits += 1
    return 2 * n_hits / (len(reference) + len(candidate))


class Comparison:
    """What `compare` found; `failures` is empty if every tolerance was kept."""

    def __init__(self) -> None:
        self.clips: list[dict] = []
        self.blocks: dict[str, dict] = {}
        self.failures: list[str] = []

    def text(self, per_clip: bool) -> str:
        lines = []
        if per_clip:
            head = "".join(f" {name[:10]:>10s}" for name in BLOCKS)
            lines.append(f"{'largest error':32s}{head} {'tempo':>9s} {'beats F1':>8s} tuning")
            for clip in self.clips:
                errors = "".join(f" {clip['blocks'][name]['max']:10.2e}" for name in BLOCKS)
                tempo = f"{clip['tempo_error_bpm']:.2e}" if "tempo_error_bpm" in clip else "-"
                beats = f"{clip['beat_f1']:.3f}" if "beat_f1" in clip else "-"
                tuning = "-"
                if "tuning" in clip:
                    ours, theirs = clip["tuning"]
                    tuning = f"{ours:+.2f}"
                    if abs(ours - theirs) > TUNING_TOLERANCE:
                        tuning += f" instead of {theirs:+.2f}"
                lines.append(f"{clip['name']:32s}{errors} {tempo:>9s} {beats:>8s} {tuning}")
            lines.append("")
        head = f"{'largest':>10s} {'mean':>10s} {'99.9 %':>10s} {'Pearson r':>11s}  values"
        lines.append(f"{'block':18s} {head}")
        for name, block in self.blocks.items():
            lines.append(
                f"{name:18s} {block['max']:10.3e} {block['mean']:10.3e} {block['p999']:10.3e} "
                f"{block['pearson']:11.8f}  {block['n']:,}"
            )
        timed = [clip for clip in self.clips if "tempo_error_bpm" in clip]
        beaten = [clip["beat_f1"] for clip in self.clips if "beat_f1" in clip]
        tuned = [clip["tuning"] for clip in self.clips if "tuning" in clip]
        n_equal = sum(clip["tempo_error_bpm"] <= TEMPO_TOLERANCE_BPM for clip in timed)
        n_tuned = sum(abs(ours - theirs) <= TUNING_TOLERANCE for ours, theirs in tuned)
        lines.append(
            f"tempo equal in {n_equal} of {len(timed)} clips, tuning in {n_tuned} of {len(tuned)}; "
            f"mean F1 of the beats {np.mean(beaten) if beaten else float('nan'):.4f}"
        )
        lines += [f"FAILED {failure}" for failure in self.failures]
        return "\n".join(lines)


def compare(
    reference_folder: pathlib.Path, candidate_folder: pathlib.Path, tolerance: str
) -> Comparison:
    done = Comparison()
    reference, candidate = load(reference_folder), load(candidate_folder)
    manifest = manifest_of(reference_folder)
    pairs: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {name: [] for name in BLOCKS}
    if not reference:
        sys.exit(f"{reference_folder} holds no .npz files; name the folder of the references")
    for clip, theirs in reference.items():
        ours = candidate.get(clip)
        if ours is None:
            done.failures.append(f"{clip}: not in {candidate_folder}")
            continue
        expected, actual = theirs["features"], ours["features"]
        if actual.shape != expected.shape:
            done.failures.append(f"{clip}: shape {actual.shape} instead of {expected.shape}")
            continue
        if not np.isfinite(actual).all():
            done.failures.append(f"{clip}: values that are not finite")
            continue
        entry: dict = {"name": clip, "blocks": {}}
        defined = is_defined(expected.shape, manifest.get(clip, {}))
        for name, (first, end) in BLOCKS.items():
            kept = defined[first:end]
            a, b = expected[first:end][kept], actual[first:end][kept]
            pairs[name].append((a, b))
            error = np.abs(a - b)
            entry["blocks"][name] = {"max": float(error.max()), "mean": float(error.mean())}
        if "tempo" in ours and "tempo" in theirs:
            tempi = (float(ours["tempo"].ravel()[0]), float(theirs["tempo"].ravel()[0]))
            entry["tempo_error_bpm"] = abs(tempi[0] - tempi[1])
            if not entry["tempo_error_bpm"] <= TEMPO_TOLERANCE_BPM:
                done.failures.append(f"{clip}: tempo {tempi[0]:.3f} instead of {tempi[1]:.3f}")
        if "beat_times" in ours and "beat_times" in theirs:
            entry["beat_f1"] = beat_f1(theirs["beat_times"], ours["beat_times"])
            if entry["beat_f1"] < 1:
                done.failures.append(f"{clip}: F1 of the beats is {entry['beat_f1']:.3f}")
        if "tuning" in ours and "tuning" in theirs:
            tunings = (float(ours["tuning"].ravel()[0]), float(theirs["tuning"].ravel()[0]))
            entry["tuning"] = tunings
            if not abs(tunings[0] - tunings[1]) <= TUNING_TOLERANCE:
                done.failures.append(f"{clip}: tuning {tunings[0]:+.2f}, not {tunings[1]:+.2f}")
        done.clips.append(entry)
    for name, arrays in pairs.items():
        if not arrays:
            continue
        a, b = (np.concatenate(side) for side in zip(*arrays, strict=True))
        error = np.abs(a - b)
        largest, mean = float(error.max()), float(error.mean())
        done.blocks[name] = {
            "max": largest,
            "mean": mean,
            "p999": float(np.quantile(error, 0.999)),
            "pearson": pearson(a, b),
            "n": error.size,
        }
        if tolerance != "off":
            most, most_mean = TOLERANCES[tolerance][name]
            if largest > most:
                done.failures.append(f"{name}: largest error {largest:.3e}, allowed {most:g}")
            if mean > most_mean:
                done.failures.append(f"{name}: mean error {mean:.3e}, allowed {most_mean:g}")
    if tolerance == "off":
        done.failures = []
    return done


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--tol", choices=[*TOLERANCES, "off"], default="strict")
    parser.add_argument("--per-clip", action="store_true", help="a line for every clip, too")
    parser.add_argument("--json", type=pathlib.Path, help="write what was found to this file")


def report(done: Comparison, arguments: argparse.Namespace) -> None:
    """Prints what was found, and ends the program."""
    print(done.text(arguments.per_clip))
    if arguments.json:
        found = {"blocks": done.blocks, "clips": done.clips, "failures": done.failures}
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")
    verdict = "FAILED" if done.failures else "all within tolerance"
    print(f"{len(done.clips)} clips compared, {verdict}")
    sys.exit(1 if done.failures else 0)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("reference", type=pathlib.Path)
    parser.add_argument("candidate", type=pathlib.Path)
    add_arguments(parser)
    arguments = parser.parse_args()
    report(compare(arguments.reference, arguments.candidate, arguments.tol), arguments)


if __name__ == "__main__":
    main()
