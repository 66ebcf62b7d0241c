#!/usr/bin/env python3
"""Writes the audio that audio.py measures with, cut out of tests/data/music; the same every time.

    python make_audio.py FOLDER [--song-s 180] [--phrases 48] [--long-s 7200] [--bulk 2000]

    songs/song.{wav,flac,mp3,ogg}   cuts of many songs one after the other, 44.1 kHz stereo
    phrases/phrase_00.wav …         cuts of 4 s, WAV, 44.1 kHz stereo
    long/long.mp3                   the song again and again
    bulk/00000.wav …                hard links to 100 cuts of 4 s, in the four formats in turn
"""

import argparse
import os
import pathlib

import numpy as np
import soundfile

MUSIC = pathlib.Path(__file__).resolve().parents[1] / "tests" / "data" / "music"
RATE_HZ = 44_100
SONG_CUT_S = 20
PHRASE_S = 4
N_BULK_CUTS = 100
FORMATS = {
    "wav": {"subtype": "PCM_16"},
    "flac": {"subtype": "PCM_16"},
    "mp3": {"subtype": "MPEG_LAYER_III", "bitrate_mode": "CONSTANT", "compression_level": 0.5},
    "ogg": {"subtype": "VORBIS", "compression_level": 0.5},
}
BLOCK_S = 10


def read(path: pathlib.Path) -> np.ndarray:
    """Returns [samples, 2]; the right channel of a mono file is the left one, a little later."""
    y, rate_hz = soundfile.read(path, dtype="float32", always_2d=True)
    if rate_hz != RATE_HZ:
        raise SystemExit(f"{path} has {rate_hz} Hz; the corpus is made of files of {RATE_HZ} Hz")
    if y.shape[1] == 1:
        y = np.concatenate([y, np.roll(y, RATE_HZ // 200)], axis=1)
    return np.clip(y, -1, 1)


def library() -> list[np.ndarray]:
    paths = [path for path in sorted(MUSIC.rglob("*")) if path.suffix in (".ogg", ".flac", ".mp3")]
    return [read(path) for path in paths]


def cuts(songs: list[np.ndarray], count: int, length_s: int, step_s: float) -> list[np.ndarray]:
    """Takes cuts from the songs in turn, each time further on; all distinct."""
    length = length_s * RATE_HZ
    found: list[np.ndarray] = []
    start = 0
    while len(found) < count:
        round_of = [y[start : start + length] for y in songs if len(y) >= start + length]
        if not round_of:
            raise SystemExit(f"{MUSIC} gives {len(found)} cuts of {length_s} s, not {count}")
        found += round_of
        start += round(step_s * RATE_HZ)
    return found[:count]


def write(path: pathlib.Path, y: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    options = FORMATS[path.suffix[1:]]
    with soundfile.SoundFile(path, "w", RATE_HZ, y.shape[1], **options) as file:
        # In blocks: libsndfile encodes a whole Vorbis file at once on the stack.
        for start in range(0, len(y), BLOCK_S * RATE_HZ):
            file.write(y[start : start + BLOCK_S * RATE_HZ])


def write_long(path: pathlib.Path, song: np.ndarray, length_s: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with soundfile.SoundFile(path, "w", RATE_HZ, 2, **FORMATS["mp3"]) as file:
        for start in range(0, length_s * RATE_HZ, len(song)):
            file.write(song[: length_s * RATE_HZ - start])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--song-s", type=int, default=180)
    parser.add_argument("--phrases", type=int, default=48)
    parser.add_argument("--long-s", type=int, default=7200)
    parser.add_argument("--bulk", type=int, default=2000)
    arguments = parser.parse_args()
    folder = arguments.folder
    songs = library()

    n_cuts = -(-arguments.song_s // SONG_CUT_S)
    song = np.concatenate(cuts(songs, n_cuts, SONG_CUT_S, SONG_CUT_S))
    song = song[: arguments.song_s * RATE_HZ]
    for suffix in FORMATS:
        write(folder / "songs" / f"song.{suffix}", song)
    write_long(folder / "long" / "long.mp3", song, arguments.long_s)
    for i, y in enumerate(cuts(songs, arguments.phrases, PHRASE_S, PHRASE_S)):
        write(folder / "phrases" / f"phrase_{i:02}.wav", y)

    # Half a beat or so away from the phrases, so that no file is among both.
    originals = []
    for i, y in enumerate(cuts(songs, N_BULK_CUTS, PHRASE_S, 1.3)):
        suffix = list(FORMATS)[i % len(FORMATS)]
        originals.append(folder / "bulk-cuts" / f"cut_{i:02}.{suffix}")
        write(originals[-1], y)
    (folder / "bulk").mkdir(parents=True)
    for i in range(arguments.bulk):
        original = originals[i % len(originals)]
        os.link(original, folder / "bulk" / f"{i:05}{original.suffix}")


if __name__ == "__main__":
    main()
