"""Writes expected.json: what libsndfile and FFmpeg decode from files of this project.

    apt-get install ffmpeg && pip install librosa==0.11.0 soundfile==0.14.0 && python make.py

Each file has its rate, its length, and N_SAMPLES mono samples at each of three places. MP4 files
are FFmpeg's, which cuts the start as the edit list says, up to the track's stated duration. The
length of MP3 files of variable bit rate without a tag is that of all their packets, because
libsndfile stops at an estimate.
"""

import json
import pathlib
import subprocess

import librosa
import numpy as np
import soundfile

HERE = pathlib.Path(__file__).parent
TESTS = HERE.parent.parent
N_SAMPLES = 64

FILES = [
    *(f"golden/audio_header/{name}" for name in [
        "aac.aac", "aac.m4a", "aac_48k_stereo.m4a", "cbr_lame.mp3", "cbr_no_xing.mp3", "cover.mp3",
        "extensible_6ch.wav", "float.wav", "mpeg2_22k.mp3", "pcm16.aiff", "pcm16.wav",
        "pcm24_stereo.wav", "pcm8_8k.wav", "piped.wav", "sine.flac", "vbr_no_xing.mp3",
        "vorbis.ogg",
    ]),
    *(f"data/music/{name}" for name in [
        "beatnet/kick_120bpm.mp3", "gunroar/gr0.ogg", "kevin-macleod/vibe_ace.ogg",
        "parsec47/ptn1.ogg", "sonic-pi/compus.flac", "sonic-pi/tabla.flac",
    ]),
]
WITHOUT_TAG = ["cover.mp3", "vbr_no_xing.mp3"]


def probe(path, *entries):
    answer = subprocess.run(
        ["ffprobe", "-v", "error", "-select_streams", "a:0", "-count_packets", "-of", "json",
         "-show_entries", "stream=" + ",".join(entries), str(path)],
        check=True, capture_output=True,
    )
    stream = json.loads(answer.stdout)["streams"][0]
    return [int(stream[entry]) for entry in entries]


def by_ffmpeg(path):
    rate_hz, n_channels, n_samples = probe(path, "sample_rate", "channels", "duration_ts")
    raw = subprocess.run(
        ["ffmpeg", "-v", "error", "-i", str(path), "-f", "f32le", "-c:a", "pcm_f32le", "-"],
        check=True, capture_output=True,
    ).stdout
    channels = np.frombuffer(raw, "<f4").reshape(-1, n_channels).T
    # ADTS files state no duration of their own.
    n_samples = n_samples if path.suffix == ".m4a" else channels.shape[1]
    return librosa.to_mono(channels[:, :n_samples]), rate_hz


def expect(path):
    if path.suffix in (".m4a", ".aac"):
        y, rate_hz = by_ffmpeg(path)
    else:
        y, rate_hz = soundfile.read(path, dtype="float32")
        y = librosa.to_mono(y.T)
    n_samples = len(y)
    if path.name in WITHOUT_TAG:
        n_samples = 1152 * probe(path, "nb_read_packets")[0]
    starts = [0, len(y) // 3, len(y) - N_SAMPLES]
    # 9 digits tell all float32 apart.
    places = [[start, [float(f"{x:.9g}") for x in y[start : start + N_SAMPLES]]] for start in starts]
    return {"sample_rate_hz": rate_hz, "n_samples": n_samples, "places": places}


def main():
    files = {name: expect(TESTS / name) for name in FILES}
    lines = ",\n".join(f" {json.dumps(name)}: {json.dumps(value)}" for name, value in files.items())
    (HERE / "expected.json").write_text("{\n" + lines + "\n}\n")


if __name__ == "__main__":
    main()
