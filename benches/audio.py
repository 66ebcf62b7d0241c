#!/usr/bin/env python3
"""Measures `motiongen extract` beside librosa in one run, and prints the ratios as Markdown.

    make bench-audio                            optimised build, full size
    make bench-audio BENCH_ARGS=--quick         small sizes, to see that it works
    python audio.py --bin target/release --profile release

  songs    a song of three minutes as WAV, FLAC, MP3 and OGG, in one thread: CPU time, wall time,
           times real time
  phrases  48 WAV files of four seconds in one process
  two      both again with two workers, against two processes of librosa
  memory   peak memory for the song, and ours for an MP3 file of two hours
  bulk     2,000 files of four seconds in four formats, with one worker and with two

The two take turns, and files are read once before (page cache warm for both). For us, the whole
process counts: start, decoding, features and the files written. For librosa (librosa_peer.py, the
same features), time starts when it is imported and compiled, and nothing is written. Ratios are of
CPU time, librosa / us, unless they say wall. The Python that runs this needs
benches/requirements.txt.
"""

import argparse
import importlib.metadata
import json
import os
import pathlib
import shutil
import statistics
import subprocess
import sys
import time
from dataclasses import asdict, dataclass

from bench import HERE, Run, first_line, run, table
from machine import heading

SONG_RATIO_TARGET, SONG_RATIO_AIM = 20, 30
REAL_TIME_TARGET = 200
PHRASE_RATIO_TARGET = 25
SONG_PEAK_TARGET_MB = 150
LONG_PEAK_TARGET_MB = 400
SCALING_TARGET = 1.85
PHRASE_S = 4
FORMATS = ["wav", "flac", "mp3", "ogg"]
OURS, PEER = "motiongen", "librosa"


@dataclass
class Sizes:
    song_s: int
    phrases: int
    long_s: int
    bulk: int
    repeats: int


FULL = Sizes(song_s=180, phrases=48, long_s=7200, bulk=2000, repeats=3)
QUICK = Sizes(song_s=20, phrases=6, long_s=300, bulk=100, repeats=2)


def spread(values: list[float]) -> str:
    digits = 3 if min(values) < 1 else 2
    return f"{min(values):.{digits}f} / {statistics.median(values):.{digits}f}"


def at_least(value: float, target: float, aim: float | None = None) -> str:
    aimed = f" (aim {aim:g})" if aim else ""
    return f"{value:.1f}, target ≥ {target:g}{aimed}: {'met' if value >= target else 'MISSED'}"


def below(value: float, target: float) -> str:
    return f"{value:.0f} MB, target < {target:g} MB: {'met' if value < target else 'MISSED'}"


class Bench:
    def __init__(self, arguments: argparse.Namespace) -> None:
        self.motiongen = arguments.bin / "motiongen"
        self.work = arguments.work
        self.sizes = QUICK if arguments.quick else FULL
        if arguments.repeats:
            self.sizes.repeats = arguments.repeats
        self.results: dict[str, dict] = {}
        self.compared: dict[str, dict[str, list[Run]]] = {}
        if not self.motiongen.is_file():
            sys.exit(
                f"{self.motiongen} is missing; build it with: make bench-audio, "
                "or name its --bin folder"
            )

    def corpus(self) -> None:
        """Makes the audio, whole or not at all, and reads it once."""
        sizes = self.sizes
        name = f"corpus-{sizes.song_s}-{sizes.phrases}-{sizes.long_s}-{sizes.bulk}"
        folder = self.work / name
        if not folder.exists():
            print(f"making the audio in {folder}", file=sys.stderr, flush=True)
            partial = folder.with_name(name + ".partial")
            shutil.rmtree(partial, ignore_errors=True)
            # In a process of its own: its memory would count as that of the programs started later.
            command = [sys.executable, HERE / "make_audio.py", partial]
            for option in ("song_s", "phrases", "long_s", "bulk"):
                command += [f"--{option.replace('_', '-')}", str(getattr(sizes, option))]
            run(command)
            partial.rename(folder)
        self.songs = [folder / "songs" / f"song.{suffix}" for suffix in FORMATS]
        self.phrases = sorted((folder / "phrases").iterdir())
        self.long = folder / "long" / "long.mp3"
        self.bulk = sorted((folder / "bulk").iterdir())
        for path in [*self.songs, *self.phrases, self.long, *(folder / "bulk-cuts").iterdir()]:
            with path.open("rb", buffering=0) as file:
                while file.read(1 << 20):
                    pass

    def ours(self, files: list[pathlib.Path], workers: int) -> Run:
        output = self.work / "extracted"
        shutil.rmtree(output, ignore_errors=True)
        flags = ["--output", output, "--workers", str(workers), "--quiet"]
        done = run([self.motiongen, "extract", "--audio", *files, *flags])
        n_written = len(list(output.glob("*.npz")))
        n_expected = len({path.stem for path in files})
        if n_written != n_expected:
            sys.exit(f"extract wrote {n_written} files instead of {n_expected}:\n{done.output}")
        return done

    def peers(self, files: list[pathlib.Path], workers: int) -> Run:
        """Runs librosa in as many processes, each with its share of the files."""
        warm_up = ["--warm-up", self.phrases[0]]
        children = [
            subprocess.Popen(
                [sys.executable, HERE / "librosa_peer.py", *warm_up, *files[i::workers]],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for i in range(workers)
        ]
        for child in children:
            if child.stdout.readline() != "ready\n":
                sys.exit("librosa_peer.py did not get ready; see its message above")
        start = time.perf_counter()
        for child in children:
            child.stdin.write("go\n")
            child.stdin.flush()
        answers = [child.stdout.readline() for child in children]
        wall_s = time.perf_counter() - start
        peak_mb = 0.0
        for child in children:
            _, status, usage = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
            child.stdin.close()
            child.stdout.close()
            if child.returncode != 0:
                sys.exit(f"librosa_peer.py ended with {child.returncode}; see its message above")
            peak_mb += usage.ru_maxrss * 1024 / 1e6
        cpu_s = sum(json.loads(answer)["cpu_s"] for answer in answers)
        return Run(wall_s, cpu_s, peak_mb, "".join(answers))

    def compare(
        self, name: str, files: list[pathlib.Path], audio_s: float, workers: int = 1
    ) -> list[list[str]]:
        """Measures both in turns and returns their lines of a table."""
        runs: dict[str, list[Run]] = {OURS: [], PEER: []}
        for _ in range(self.sizes.repeats):
            runs[OURS].append(self.ours(files, workers))
            runs[PEER].append(self.peers(files, workers))
        self.compared[name] = runs
        cpu_s = {who: statistics.median(r.cpu_s for r in own) for who, own in runs.items()}
        wall_s = {who: statistics.median(r.wall_s for r in own) for who, own in runs.items()}
        least_s = {who: min(r.cpu_s for r in own) for who, own in runs.items()}
        self.results[name] = {
            "audio_s": audio_s,
            "workers": workers,
            "runs": {who: [measured(r) for r in own] for who, own in runs.items()},
            "cpu_ratio": cpu_s[PEER] / cpu_s[OURS],
            "cpu_ratio_of_minima": least_s[PEER] / least_s[OURS],
            "wall_ratio": wall_s[PEER] / wall_s[OURS],
            "real_time_per_core": audio_s / cpu_s[OURS],
        }
        return [
            [
                name,
                who,
                spread([r.cpu_s for r in own]),
                spread([r.wall_s for r in own]),
                f"{audio_s / cpu_s[who]:.0f}",
                f"{audio_s / wall_s[who]:.0f}",
                f"{max(r.peak_mb for r in own):.0f}",
                f"{cpu_s[PEER] / cpu_s[OURS]:.1f}" if who == OURS else "",
                f"{wall_s[PEER] / wall_s[OURS]:.1f}" if who == OURS else "",
            ]
            for who, own in runs.items()
        ]

    HEAD = [
        "audio",
        "program",
        "CPU s, min / median",
        "wall s, min / median",
        "× real time, CPU",
        "× real time, wall",
        "peak MB",
        "ratio, CPU",
        "ratio, wall",
    ]

    def measure_songs(self) -> str:
        rows, notes = [], []
        for path in self.songs:
            name = f"song, {path.suffix[1:].upper()}"
            rows += self.compare(name, [path], self.sizes.song_s)
            ratio = self.results[name]["cpu_ratio"]
            notes.append(
                f"- {name}: librosa / us = {at_least(ratio, SONG_RATIO_TARGET, SONG_RATIO_AIM)}\n"
            )
        speed = self.results["song, MP3"]["real_time_per_core"]
        notes.append(f"- MP3, × real time per core: {at_least(speed, REAL_TIME_TARGET)}\n")
        title = f"### A song of {self.sizes.song_s} s, one thread\n\n"
        return title + table(self.HEAD, rows) + "\n" + "".join(notes)

    def measure_phrases(self) -> str:
        count = len(self.phrases)
        rows = self.compare("phrases", self.phrases, PHRASE_S * count)
        ratio = self.results["phrases"]["cpu_ratio"]
        return (
            f"### {count} phrases of {PHRASE_S} s (WAV), one process, one thread\n\n"
            f"{table(self.HEAD, rows)}\n- librosa / us = {at_least(ratio, PHRASE_RATIO_TARGET)}\n"
        )

    def measure_two(self) -> str:
        # Every file gives an output of its own name.
        folder = self.work / "songs-two"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        songs = []
        for path in self.songs:
            songs.append(folder / f"song_{path.suffix[1:]}{path.suffix}")
            os.link(path, songs[-1])
        rows = self.compare("four songs", songs, self.sizes.song_s * len(songs), workers=2)
        rows += self.compare("phrases, two", self.phrases, PHRASE_S * len(self.phrases), workers=2)
        text = (
            "`--workers 2` against two processes of librosa that share the files; "
            "the peak of librosa is that of both processes together.\n\n"
        )
        return f"### Two threads or processes\n\n{text}{table(self.HEAD, rows)}"

    def measure_memory(self) -> str:
        rows, notes = [], []
        for name in [f"song, {suffix.upper()}" for suffix in FORMATS]:
            if name not in self.compared:
                self.compare(name, [self.songs[FORMATS.index(name[6:].lower())]], self.sizes.song_s)
            peaks = {who: max(r.peak_mb for r in own) for who, own in self.compared[name].items()}
            ratio = peaks[PEER] / peaks[OURS]
            rows.append([name, f"{peaks[OURS]:.0f}", f"{peaks[PEER]:.0f}", f"{ratio:.1f}"])
            notes.append(f"- {name}: {below(peaks[OURS], SONG_PEAK_TARGET_MB)}\n")
        long = self.ours([self.long], 1)
        self.results["long"] = {"audio_s": self.sizes.long_s, "run": measured(long)}
        name = f"MP3 of {self.sizes.long_s / 3600:.2g} h"
        rows.append([name, f"{long.peak_mb:.0f}", "", ""])
        notes.append(
            f"- {name}: {below(long.peak_mb, LONG_PEAK_TARGET_MB)}; "
            f"{long.cpu_s:.1f} CPU s, {self.sizes.long_s / long.cpu_s:.0f} × real time\n"
        )
        head = ["audio", "motiongen, peak MB", "librosa, peak MB", "ratio"]
        return f"### Peak memory, one thread\n\n{table(head, rows)}\n{''.join(notes)}"

    def measure_bulk(self) -> str:
        runs: dict[int, list[Run]] = {1: [], 2: []}
        for _ in range(self.sizes.repeats):
            for workers, own in runs.items():
                own.append(self.ours(self.bulk, workers))
        wall_s = {
            workers: statistics.median(r.wall_s for r in own) for workers, own in runs.items()
        }
        scaling = wall_s[1] / wall_s[2]
        least_s = {workers: min(r.wall_s for r in own) for workers, own in runs.items()}
        self.results["bulk"] = {
            "n_files": len(self.bulk),
            "runs": {str(workers): [measured(r) for r in own] for workers, own in runs.items()},
            "scaling": scaling,
            "scaling_of_minima": least_s[1] / least_s[2],
        }
        rows = [
            [
                str(workers),
                spread([r.wall_s for r in own]),
                spread([r.cpu_s for r in own]),
                f"{len(self.bulk) / wall_s[workers]:.0f}",
                f"{max(r.peak_mb for r in own):.0f}",
            ]
            for workers, own in runs.items()
        ]
        head = ["workers", "wall s, min / median", "CPU s, min / median", "files/s", "peak MB"]
        met = "met" if scaling >= SCALING_TARGET else "MISSED"
        return (
            f"### Bulk: {len(self.bulk):,} files of {PHRASE_S} s, a quarter each of WAV, FLAC, MP3 "
            f"and OGG\n\n{table(head, rows)}\n"
            f"- scaling from one worker to two: {scaling:.2f}, target ≥ {SCALING_TARGET:g}: {met} "
            f"(of the minima: {least_s[1] / least_s[2]:.2f})\n"
        )


def measured(done: Run) -> dict[str, float]:
    return {key: value for key, value in asdict(done).items() if key != "output"}


def machine(bench: Bench, profile: str) -> str:
    packages = ["librosa", "numpy", "scipy", "numba", "soxr", "soundfile"]
    return heading(
        "audio features",
        [
            f"{first_line([bench.motiongen, '--version'])} (profile {profile})",
            *[f"{name} {importlib.metadata.version(name)}" for name in packages],
            f"{bench.sizes.repeats} runs of each, taking turns",
        ],
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="folder of the executable")
    parser.add_argument("--profile", default="not told", help="how it was built, for the record")
    parser.add_argument("--work", type=pathlib.Path, default=pathlib.Path("build/bench-audio"))
    sections = ["songs", "phrases", "two", "memory", "bulk"]
    parser.add_argument("--only", choices=sections, action="append", default=[])
    parser.add_argument("--quick", action="store_true", help="20 s, 6 phrases, 100 files, 2 runs")
    parser.add_argument("--repeats", type=int, help="runs of each program (default 3)")
    parser.add_argument("--json", type=pathlib.Path, help="write every measurement to this file")
    arguments = parser.parse_args()

    arguments.work.mkdir(parents=True, exist_ok=True)
    bench = Bench(arguments)
    bench.corpus()
    parts = [machine(bench, arguments.profile)]
    print(parts[0], flush=True)
    for name in sections:
        if not arguments.only or name in arguments.only:
            parts.append(getattr(bench, f"measure_{name}")())
            print(parts[-1], flush=True)
    results = arguments.work / "results.md"
    with results.open("a") as file:
        file.write("\n".join(parts) + "\n")
    if arguments.json:
        found = {"sizes": asdict(bench.sizes), "results": bench.results}
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")
    print(f"added to {results}; audio and features stay in {arguments.work} until you remove them")


if __name__ == "__main__":
    main()
