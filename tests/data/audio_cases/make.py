"""Writes expected.json: what libsndfile, FFmpeg and opusdec read of the files beside it.

    python -m venv venv && venv/bin/pip install numpy soundfile && venv/bin/python make.py

libsndfile 1.2.2 (of soundfile), FFmpeg 5.1, opusdec 0.2 (libopus 1.3). Samples are the mean of the channels at the file's rate.
"""

import io
import json
import pathlib
import subprocess
import tempfile

import numpy as np
import soundfile

HERE = pathlib.Path(__file__).parent
# Files that libsndfile does not read, or of which it drops a part without a word.
WITH_FFMPEG = {
    "a03b_lame_without_frames.mp3", "a04_concatenated.mp3", "a12_data_size_0.wav",
    "a12b_riff36_data0.wav", "a31_adts.aac", "a33c_mp3.m4a",
    "a47_asc_core_coder.m4a", "a55_vbri.mp3", "aac_96k.m4a", "alac.caf", "alac.m4a", "half_flac.flac",
    "mov_f32be.mov", "mov_f32le.mov", "mov_f64be.mov", "mov_s24be.mov", "mov_s32be.mov",
}
REFUSED = {"a08_vorbis_in.wav", "a34c_gsm.wav"}
N_PLACES, N_VALUES = 40, 6


def with_ffmpeg(path):
    probe = ["ffprobe", "-v", "error", "-select_streams", "a", "-show_entries",
             "stream=channels,sample_rate", "-of", "csv=p=0", path]
    rate_hz, n_channels = subprocess.check_output(probe, text=True).split()[0].strip(",").split(",")
    decode = ["ffmpeg", "-v", "quiet", "-i", path, "-f", "f32le", "-acodec", "pcm_f32le", "-"]
    samples = np.frombuffer(subprocess.run(decode, capture_output=True).stdout, "<f4")
    return samples.reshape(-1, int(n_channels)), int(rate_hz)


def with_libsndfile(path):
    # libsndfile does not look for the audio behind zeros, and stops behind the first link of a chain.
    content = path.read_bytes().lstrip(b"\0")
    starts = [at for at in range(len(content)) if content.startswith(b"OggS\0\2", at)] or [0]
    links = [content[start:end] for start, end in zip(starts, [*starts[1:], None])]
    read = [soundfile.read(io.BytesIO(link), dtype="float32", always_2d=True) for link in links]
    return np.concatenate([samples for samples, _ in read]), read[0][1]


def with_libopus(path):
    with tempfile.NamedTemporaryFile(suffix=".wav") as wav:
        command = ["opusdec", "--quiet", "--float", "--no-dither", "--rate", "48000", path, wav.name]
        subprocess.run(command, check=True)
        return soundfile.read(wav.name, dtype="float32", always_2d=True)


READERS = {"ffmpeg": with_ffmpeg, "libopus": with_libopus, "libsndfile": with_libsndfile}


def reference(path):
    if path.name.startswith("opus"):
        return "libopus"
    return "ffmpeg" if path.name in WITH_FFMPEG else "libsndfile"


expected = {}
for path in sorted(HERE.iterdir()):
    if path.suffix in {".py", ".json"} or path.name in REFUSED:
        continue
    by = reference(path)
    # FFmpeg 5.1 does not cut the end of Opus in MP4; the packets are those of the Ogg file.
    source = path.with_name("opus_stereo.opus") if path.name == "opus.mp4" else path
    samples, rate_hz = READERS[by](source)
    mono = samples.mean(axis=1)
    starts = np.linspace(0, len(mono) - N_VALUES, N_PLACES).astype(int).tolist()
    expected[path.name] = {
        "by": by,
        "sample_rate_hz": rate_hz,
        "n_channels": samples.shape[1],
        "n_samples": len(mono),
        "places": [[at, [float(x) for x in mono[at : at + N_VALUES]]] for at in starts],
    }
(HERE / "expected.json").write_text(json.dumps(expected, indent=None, separators=(",", ":")) + "\n")
