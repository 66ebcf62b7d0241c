#!/usr/bin/env python3
"""Measures tempo, beats and downbeats against songs whose beats are known, beside librosa.

    python benches/beats.py --bin target/release/motiongen

Packages of Debian are fetched with apt-get into build/bench-beats and unpacked there, nothing is installed:
game music of one steady tempo (which makes the seamless loop a whole number of 16 beats), charted songs of
Frets on Fire (the chart's tempo from 0 s, bars of four), and MIDI files of Simutrans, which fluidsynth renders
(it has to be installed; --no-midi goes without). Needs librosa, soundfile, mido and mir_eval.
"""

import argparse
import collections
import csv
import hashlib
import io
import pathlib
import shutil
import subprocess
import sys

import librosa
import mido
import mir_eval
import numpy as np
import soundfile

from bench import table
from machine import heading

ROOT = pathlib.Path(__file__).resolve().parent.parent
OUT = ROOT / "build" / "bench-beats"
RATE_HZ, HOP, N_FFT = 44_100, 1_470, 2_048
TOLERANCE = 0.04
WINDOW_S = 0.07
SOUNDFONT = ("fluidr3mono-gm-soundfont", "usr/share/sounds/sf3/FluidR3Mono_GM.sf3")
# Beats/min of the game music, by package and file.
GAMES = {
    "gunroar-data": {"gr0": 146, "gr1": 140, "gr2": 150},
    "mu-cade-data": {"mcd1": 150, "mcd2": 150},
    "noiz2sa-data": {"stg0": 150, "stg00": 154},
    "parsec47-data": {"ptn0": 160, "ptn1": 160},
    "rrootage-data": {"stg_a": 145, "stg_b": 155},
    "titanion-data": {"ttn1": 150},
    "torus-trooper-data": {"tt1": 160, "tt2": 160, "tt3": 160},
}
CHARTS = ["fretsonfire-songs-sectoid", "fretsonfire-songs-muldjord"]

Song = collections.namedtuple("Song", "name group file bpm beats")


def unpacked(package: str) -> pathlib.Path:
    """Fetches and unpacks a package of Debian."""
    folder = OUT / "packages" / package
    if not folder.is_dir():
        (OUT / "packages").mkdir(parents=True, exist_ok=True)
        subprocess.run(["apt-get", "download", package], cwd=OUT / "packages", check=True)
        (archive,) = (OUT / "packages").glob(f"{package}_*.deb")
        subprocess.run(["dpkg-deb", "-x", archive, folder], check=True)
    return folder


def grid(bpm: float, file: pathlib.Path) -> np.ndarray:
    """Beats of one tempo from 0 s, numbered in bars of four."""
    times_s = np.arange(0, soundfile.info(file).duration - 0.2, 60 / bpm)
    return np.stack([times_s, np.arange(len(times_s)) % 4 + 1], axis=1)


def game_music(songs: pathlib.Path) -> list[Song]:
    found = []
    for package, tempi in GAMES.items():
        for stem, bpm in tempi.items():
            (path, *_) = sorted(unpacked(package).rglob(f"{stem}.ogg"))
            file = songs / f"game_{stem}.ogg"
            shutil.copy(path, file)
            found.append(Song(file.stem, "game music", file, bpm, grid(bpm, file)))
    return found


def charted(songs: pathlib.Path) -> list[Song]:
    found = []
    for package in CHARTS:
        for chart in sorted(unpacked(package).rglob("notes.mid")):
            tempi = [m.tempo for t in mido.MidiFile(chart, clip=True).tracks for m in t if m.type == "set_tempo"]
            tracks = [soundfile.read(chart.with_name(n), dtype="float32")[0] for n in ("song.ogg", "guitar.ogg")]
            tracks = [t.mean(axis=1) if t.ndim == 2 else t for t in tracks]
            mix = np.zeros(max(map(len, tracks)), np.float32)
            for track in tracks:
                mix[: len(track)] += 0.5 * track
            file = songs / f"chart_{chart.parent.name.replace(' ', '_')}.wav"
            soundfile.write(file, mix, RATE_HZ)
            bpm = 60e6 / tempi[0]
            found.append(Song(file.stem, "charted songs", file, bpm, grid(bpm, file)))
    return found


def midi_beats(path: pathlib.Path) -> np.ndarray | None:
    """Beats of a MIDI file by its tempo map and time signatures; none where notes are not on a grid."""
    midi = mido.MidiFile(path, clip=True)
    per_beat, tick, s, tempo = midi.ticks_per_beat, 0, 0.0, 500_000
    marks, signatures, onsets = [(0, 0.0, tempo)], [], []
    for message in mido.merge_tracks(midi.tracks):
        s += message.time * tempo / 1e6 / per_beat
        tick += message.time
        if message.type == "set_tempo":
            tempo = message.tempo
            marks.append((tick, s, tempo))
        elif message.type == "time_signature":
            signatures.append((tick, message.numerator, message.denominator))
        elif message.type == "note_on" and message.velocity:
            onsets.append(tick)
    ticks = np.array(onsets, dtype=float)
    off = np.minimum(*(np.abs(ticks - np.round(ticks / q) * q) for q in (per_beat / 4, per_beat / 3)))
    if len(ticks) == 0 or np.mean(off < 0.04 * per_beat) < 0.9:
        return None
    starts = np.array([mark[0] for mark in marks])

    def seconds(tick: float) -> float:
        begin, s, tempo = marks[np.searchsorted(starts, tick, side="right") - 1]
        return s + (tick - begin) * tempo / 1e6 / per_beat

    beats, tick, number, (count, unit) = [], 0.0, 1, (4, 4)
    while tick <= ticks.max():
        while signatures and tick >= signatures[0][0]:
            _, count, unit = signatures.pop(0)
            number = 1
        is_compound = unit == 8 and count % 3 == 0
        beats.append((seconds(tick), number))
        tick += per_beat * 4 / unit * (3 if is_compound else 1)
        number = number % (count // 3 if is_compound else count) + 1
    beats = np.array(beats)
    return beats[beats[:, 0] >= seconds(ticks.min()) - 0.01]


def rendered(songs: pathlib.Path) -> list[Song]:
    font = unpacked(SOUNDFONT[0]) / SOUNDFONT[1]
    found = []
    for path in sorted(unpacked("simutrans-data").rglob("*.mid")):
        try:
            beats = midi_beats(path)
        except (OSError, ValueError, mido.KeySignatureError) as error:
            print(f"{path.name}: {error}", file=sys.stderr)
            continue
        if beats is None or beats[-1, 0] < 25:
            continue
        file = songs / f"midi_{path.stem}.wav"
        if not file.exists():
            part = OUT / "part.wav"
            flags = ["-ni", "-g", "0.6", "-r", str(RATE_HZ), "-F", part, font, path]
            # Its output is thrown away: with pipes it was seen to hang when it was done.
            subprocess.run(["fluidsynth", *flags], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            part.rename(file)
        bpm = 60 / np.median(np.diff(beats[:, 0]))
        # The half that the tracker's weights were fitted to.
        is_fitted = int(hashlib.md5(path.stem.encode()).hexdigest(), 16) % 2 == 1
        group = "rendered MIDI, fitted to" if is_fitted else "rendered MIDI"
        found.append(Song(file.stem, group, file, bpm, beats))
    return found


def tracked(binary: pathlib.Path, songs: pathlib.Path) -> dict[str, np.ndarray]:
    """The rows of `beats` that ingest and extract make of the songs: time and number (0: none)."""
    store = OUT / "store"
    shutil.rmtree(store, ignore_errors=True)
    for stage in (["ingest", "--source", songs], ["extract"]):
        subprocess.run([binary, *stage, "--store", store, "--quiet"], check=True)
    sql = "select phrase_id, time_s, number from beats order by phrase_id, beat"
    flags = ["query", "--store", store, sql, "--format", "csv"]
    answer = subprocess.run([binary, *flags], check=True, capture_output=True, text=True).stdout
    found = collections.defaultdict(list)
    for row in csv.DictReader(io.StringIO(answer)):
        name = pathlib.PurePath(row["phrase_id"]).stem
        found[name].append((float(row["time_s"]), int(row["number"] or 0)))
    return {name: np.array(rows) for name, rows in found.items()}


def of_librosa(song: Song) -> tuple[float, np.ndarray]:
    y, _ = librosa.load(song.file, sr=RATE_HZ)
    envelope = librosa.onset.onset_strength(y=y, sr=RATE_HZ, hop_length=HOP, n_fft=N_FFT, aggregate=np.median)
    bpm, times_s = librosa.beat.beat_track(onset_envelope=envelope, sr=RATE_HZ, hop_length=HOP, units="time")
    return float(np.atleast_1d(bpm)[0]), np.stack([times_s, np.zeros(len(times_s))], axis=1)


def scores(song: Song, bpm: float, beats: np.ndarray) -> tuple[bool, float, float]:
    def f_measure(known: np.ndarray, found: np.ndarray) -> float:
        trimmed = map(mir_eval.beat.trim_beats, (known, found))
        return mir_eval.beat.f_measure(*trimmed, WINDOW_S)

    if len(beats) < 2:
        return False, 0.0, 0.0
    numbers = beats[:, 1] if beats[:, 1].any() else np.arange(len(beats)) % 4 + 1
    downbeats = song.beats[song.beats[:, 1] == 1, 0], beats[numbers == 1, 0]
    beat_f = f_measure(song.beats[:, 0], beats[:, 0])
    return abs(bpm / song.bpm - 1) <= TOLERANCE, beat_f, f_measure(*downbeats)


def interval(values: list[float]) -> str:
    """The mean, and 95 % of the means of songs drawn again."""
    values, random = np.array(values), np.random.default_rng(0)
    means = values[random.integers(0, len(values), (4000, len(values)))].mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return f"{values.mean():.2f} ({low:.2f}–{high:.2f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="motiongen, with query")
    parser.add_argument("--no-midi", action="store_true", help="without the MIDI files")
    parser.add_argument("--per-song", action="store_true", help="a line for every song")
    args = parser.parse_args()
    folder = OUT / "songs"
    folder.mkdir(parents=True, exist_ok=True)
    songs = game_music(folder) + charted(folder) + ([] if args.no_midi else rendered(folder))
    ours = tracked(args.bin.resolve(), folder)
    found: dict[tuple[str, str], list] = collections.defaultdict(list)
    for song in songs:
        beats = ours.get(song.name, np.zeros((0, 2)))
        bpm = 60 / np.median(np.diff(beats[:, 0])) if len(beats) > 1 else 0.0
        for name, answer in (("tracker", (bpm, beats)), ("librosa", of_librosa(song))):
            found[song.group, name].append(scores(song, *answer))
            if args.per_song:
                print(song.name, f"{song.bpm:.1f}", name, f"{answer[0]:.1f}", found[song.group, name][-1])
    rows = []
    for (group, name), values in found.items():
        tempo, beat, downbeat = zip(*values)
        rows.append([group, name, f"{sum(tempo)} of {len(tempo)}", interval(beat), interval(downbeat)])
    print(heading("beats", []))
    print(table(["songs", "beats of", "tempo within 4 %", "F of beats", "F of downbeats"], rows))


if __name__ == "__main__":
    main()
