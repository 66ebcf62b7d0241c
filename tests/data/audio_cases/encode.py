"""Writes the Opus, ALAC, AAC and QuickTime files beside it, with opusenc 1.4 (opus-tools 0.2) and FFmpeg 5.1.

    venv/bin/python encode.py
"""

import pathlib
import struct
import subprocess
import tempfile

import numpy as np
import soundfile

HERE = pathlib.Path(__file__).parent


def music(seconds, rate_hz, n_channels):
    """Two tones, clicks and noise."""
    rng = np.random.default_rng(5)
    t = np.arange(int(seconds * rate_hz)) / rate_hz
    tones = 0.2 * np.sin(2 * np.pi * 440 * t) + 0.1 * np.sin(2 * np.pi * 1333 * t)
    clicks = 0.3 * np.exp(-200 * (t % 0.47)) * np.sin(2 * np.pi * 2500 * t)
    channels = [tones + clicks * (1 + c) / 2 + 0.01 * rng.standard_normal(len(t)) for c in range(n_channels)]
    return np.stack(channels, axis=1).astype("float32")


def checksum(page):
    """CRC-32 of an Ogg page (RFC 3533 section 6), polynomial 0x04c11db7."""
    crc = 0
    for byte in page[:22] + b"\0\0\0\0" + page[26:]:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ 0x04C11DB7 if crc & 0x80000000 else crc << 1) & 0xFFFFFFFF
    return struct.pack("<I", crc)


def with_gain(content, gain_q8):
    """Sets the output gain in the identification header, the content of the first page."""
    first = bytearray(content[: 28 + content[27]])
    first[28 + 16 : 28 + 18] = struct.pack("<h", gain_q8)
    first[22:26] = checksum(bytes(first))
    return bytes(first) + content[len(first) :]


def run(*command):
    subprocess.run([str(part) for part in command], check=True, capture_output=True)


with tempfile.TemporaryDirectory() as folder:
    wav = pathlib.Path(folder) / "a.wav"

    def opus(name, seconds, rate_hz, n_channels, *options, serial=7):
        soundfile.write(wav, music(seconds, rate_hz, n_channels), rate_hz, subtype="PCM_16")
        run("opusenc", "--serial", serial, *options, wav, HERE / name)

    opus("opus_stereo.opus", 2.01, 44_100, 2, "--bitrate", 64)
    opus("opus_speech.opus", 2.03, 16_000, 1, "--bitrate", 14, "--speech")
    opus("opus_six_channels.opus", 0.51, 48_000, 6, "--bitrate", 128)
    (HERE / "opus_gain.opus").write_bytes(with_gain((HERE / "opus_speech.opus").read_bytes(), -1536))
    opus("second.opus", 1.37, 44_100, 2, "--bitrate", 64, serial=8)
    first, second = HERE / "opus_stereo.opus", HERE / "second.opus"
    (HERE / "opus_chained.opus").write_bytes(first.read_bytes() + second.read_bytes())
    second.unlink()
    run("ffmpeg", "-y", "-i", first, "-c:a", "copy", HERE / "opus.mp4")
    soundfile.write(wav, music(1.01, 22_050, 2), 22_050, subtype="PCM_16")
    for name in ["alac.m4a", "alac.caf"]:
        run("ffmpeg", "-y", "-i", wav, "-c:a", "alac", "-bitexact", HERE / name)
    # QuickTime's samples of more than 16 bits, high byte first unless the file says otherwise.
    soundfile.write(wav, music(0.101, 8_000, 2), 8_000, subtype="FLOAT")
    for name in ["s24be", "s32be", "f32be", "f64be", "f32le"]:
        run("ffmpeg", "-y", "-i", wav, "-c:a", f"pcm_{name}", "-bitexact", HERE / f"mov_{name}.mov")
    # A sample rate for which an MP4 header has no room.
    soundfile.write(wav, music(0.31, 96_000, 1), 96_000, subtype="PCM_16")
    run("ffmpeg", "-y", "-i", wav, "-c:a", "aac", "-aac_pns", "0", "-bitexact", HERE / "aac_96k.m4a")
